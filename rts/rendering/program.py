"""`rts.program`: shading and splatting as one program of torch or jax, for devices that wait for every operator."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from typing import Any

from rts.arrays.argument_checks import quoted
from rts.arrays.array_functions import shape_of
from rts.arrays.engines import context_of
from rts.arrays.trees import Tree, map_leaves
from rts.contracts.records import Sampled
from rts.errors import InputError


def program(f: Callable[..., Tree], **options: Any) -> Callable[..., Tree]:
    """A function like `f` that runs as one program, which the engine of its arguments compiles at the first call.

    For a GPU, where torch otherwise launches hundreds of small operators one by one. Call `rts.sample` before, and pass
    what it gives: numbers of samples and of edge crossings may change from call to call. So may values of arguments,
    which have their derivatives. For other shapes, dtypes or settings a further program is compiled; by torch also
    where there is no sample or crossing, or one. Arrays that `f` closes over are those of the first call.

    torch compiles for a minute or two, jax for seconds. By NumPy `f` runs as it is.

    Args:
        f: a function of arrays, parts, cameras, and the results of `rts.sample`, such as `loss(pose, sampled)`. It
            returns arrays.
        **options: options of the compiler: of `torch.compile` or `jax.jit`.

    Returns:
        The function. It takes positional arguments alone.

    Raises:
        InputError: `f` is no function. When called: torch is older than 2.6; by torch, `f` samples, or closes over a
            tensor that requires a gradient.
        EngineError: when called, with torch and jax arrays at once, or arrays on two devices.
    """
    if not callable(f):
        raise InputError(f"rts.program was given {quoted(f)}; expected a function, such as loss(pose, sampled)")
    programs: dict[str, Callable[..., Tree]] = {}

    @functools.wraps(f)
    def call(*args: Tree) -> Tree:
        engine = context_of(args).engine
        if engine.name not in programs:
            programs[engine.name] = engine.program(f, _varying, options)
        return programs[engine.name](*args)

    return call


def _varying(tree: Tree) -> Tree:
    """A tree with, for each array, the axis whose length may vary: the number of samples, or of crossings. −1 for none.

    Arrays of the result of `rts.sample` have one, but for those (·, H, W) of its cells.
    """
    if isinstance(tree, Sampled):
        cells = tree.row.shape[-2:]
        return map_leaves(lambda x: _axis_of_samples(shape_of(x), cells), tree)
    if isinstance(tree, (list, tuple)):
        items = [_varying(x) for x in tree]
        return type(tree)(*items) if hasattr(tree, "_fields") else type(tree)(items)
    if isinstance(tree, Mapping):
        return {name: _varying(x) for name, x in tree.items()}
    return map_leaves(lambda _: -1, tree)


def _axis_of_samples(shape: tuple[int, ...], cells: tuple[int, ...]) -> int:
    """The axis of samples, or of crossings, of an array of this shape; −1 for one of `cells` (H, W)."""
    if not shape or shape[-2:] == cells:
        return -1
    # Of several parts each has the cells that it is seen in, (·, 1, M).
    return len(shape) - 1 if len(shape) > 2 and shape[-2] == 1 else 0
