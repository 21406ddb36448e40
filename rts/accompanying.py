"""What a companion does: it compiles loops in an order that leaves others to the process that it helps."""

from __future__ import annotations

import contextlib
import itertools
import os
import sys
import threading
from collections.abc import Container, Iterator, Sequence
from queue import Empty, SimpleQueue
from typing import TYPE_CHECKING

from rts import rehearsal
from rts.companion import Claims

if TYPE_CHECKING:
    from rts.compiling import Need

PATIENCE = 30.0
"""Seconds after which a companion without anything to do ends."""


def serve(descriptor: int, everything: bool) -> None:
    """Compile, one loop after another, until there is nothing more to do or the standard input ends.

    Args:
        descriptor: of the file of the claims; −1 if there is none.
        everything: whether to compile all that is known, and let errors through; else what goes with the loops
            whose numbers come in.
    """
    missed: SimpleQueue[int] = SimpleQueue()
    threading.Thread(target=_listen, args=(missed,), daemon=True).start()
    claims = None if descriptor < 0 else Claims(os.fdopen(descriptor, "r+b", buffering=0))
    for key, need in _all() if everything else _asked(missed):
        if claims is None or claims.take(key):
            with contextlib.nullcontext() if everything else contextlib.suppress(Exception):
                need.loop.compile(need.types)
            if claims is not None:
                claims.drop(key)


def _listen(missed: SimpleQueue[int]) -> None:
    from rts.compiling import saving

    # Without a buffer, whose lock a thread that waits would hold as the interpreter ends.
    for line in os.fdopen(sys.stdin.fileno(), "rb", buffering=0, closefd=False):
        missed.put(int(line))
    with saving:
        os._exit(1)


def _all() -> Iterator[tuple[int, Need]]:
    """All that is known, by number, once."""
    done: set[int] = set()
    for route in itertools.chain.from_iterable(rehearsal.routes()):
        yield from ((key, need) for key, need in route.items() if need is not None and key not in done)
        done |= route.keys()


def _asked(missed: SimpleQueue[int]) -> Iterator[tuple[int, Need]]:
    """What to compile next, by number, as long as something is missed now and then."""
    ahead = rehearsal.routes()
    known, seen, done = next(ahead), list[int](), set[int]()
    while True:
        with contextlib.suppress(Empty):
            while True:
                seen.append(missed.get_nowait())
        while seen and not any(route.keys() >= set(seen) for route in known) and (more := next(ahead, None)):
            known += more
        key, need = following(known, seen, done)
        if need is not None:
            done.add(key)
            yield key, need
            continue
        try:
            seen.append(missed.get(timeout=PATIENCE))
        except Empty:
            return


def following(
    routes: Sequence[dict[int, Need | None]], seen: Sequence[int], done: Container[int]
) -> tuple[int, Need | None]:
    """What to compile next of what a process will need last and nobody has begun; (0, None) if there is nothing.

    It is what takes longest of the last half, so that little is left when the two meet, and neither waits for long.

    Args:
        routes: what each kind of call needs, in this order. Where it may be the first, it is taken to be; of the others
            those that may be first have what they share compiled first.
        seen: what that process has missed, in this order, and compiles itself.
        done: what need not be compiled again.
    """
    told = [key for key in seen if any(key in route for route in routes)]
    if not told:
        return 0, None
    # What was missed last is of the call that is going on.
    known = [sum(key in route for key in told) if told[-1] in route else -1 for route in routes]
    route, *others = (route for route, count in zip(routes, known, strict=True) if count == max(known))
    ways = [route] if route is routes[0] else [{k: route[k] for k in route if all(k in r for r in others)}, route]
    for way in ways:
        left = {k: need for k, need in way.items() if need is not None and k not in seen and k not in done}
        if left:
            key = max(_last_half(left), key=lambda k: left[k].effort)
            return key, left[key]
    return 0, None


def _last_half(left: dict[int, Need]) -> list[int]:
    """The last of some needs that are half of the effort, or one, the last of all first."""
    rest, half = sum(need.effort for need in left.values()) / 2, list[int]()
    for key in reversed(left):
        effort = left[key].effort
        if half and rest < effort / 2:
            break
        half.append(key)
        rest -= effort
    return half
