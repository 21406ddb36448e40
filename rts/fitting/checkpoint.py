"""Checkpoints: the state of a fit in one file, from which it goes on bit for bit."""

from __future__ import annotations

import contextlib
import io
import json
import math
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rts.arrays.argument_checks import quoted
from rts.arrays.engine_base import Engine
from rts.arrays.trees import Tree, leaves, map_leaves
from rts.contracts.checks import is_count
from rts.errors import InputError, RtsWarning, warn
from rts.fitting.parameter_names import named_leaves, one_line
from rts.fitting.processes import Processes
from rts.fitting.run import fault_of

FORMAT = 1


class State(NamedTuple):
    """The state of a fit between two steps.

    Attributes:
        about: numbers and texts, as JSON holds them.
        parameters: the parameters at which the next loss is computed.
        best: the best parameters so far, or None.
        method: the state of the method, as its own bytes.
    """

    about: dict[str, Any]
    parameters: Tree
    best: Tree
    method: bytes


class Checkpoint:
    """A file that holds the last state of a fit.

    It is NumPy's .npz, without pickles. It is written beside its place and then renamed, so that there is always a
    whole one. Where it cannot be written, for lack of space say, a warning says so, and the fit goes on.

    Args:
        path: the file.
        every: the number of steps between two states.
        like: the parameters of the fit.
        engine: their engine.
        method: the name of the method.
        processes: the job in which the first process alone reads and writes; None for a single process.

    Raises:
        InputError: no such folder, or wrong arguments.
    """

    def __init__(self, path: Any, every: Any, like: Tree, engine: Engine, method: str, processes: Processes | None):
        if not isinstance(path, (str, os.PathLike)) or not str(path):
            raise InputError(f"checkpoint is {quoted(path)}; expected the path of a file, such as 'fit.npz', or None")
        if not is_count(every):
            raise InputError(f"checkpoint_every is {quoted(every)}; expected a number of steps, at least 1")
        self.path, self.every = Path(path), int(every)
        try:
            with contextlib.suppress(FileNotFoundError):
                self.path.lstat()
            possible = self.path.parent.is_dir() and not self.path.is_dir()
        except (OSError, ValueError):  # Of names that are too long, or that no file can have.
            possible = False
        if not possible:
            raise InputError(f"checkpoint is {str(self.path)[:200]}; expected a file in a folder that exists")
        self._like, self._engine, self._processes = like, engine, processes
        self._identity = {
            "format": FORMAT,
            "method": method,
            "parameters": [[name, list(x.shape), str(x.dtype)] for name, x in named_leaves(like)],
        }

    def read(self, stages: int) -> State | None:
        """The state in the file; None if there is no file.

        Args:
            stages: the number of stages of the fit, which has ended fewer.

        Raises:
            InputError: the file cannot be read, is damaged, or is of another fit.
        """
        content, fault = None, ""
        if self._processes is None or self._processes.rank == 0:
            try:
                content = self.path.read_bytes()
            except FileNotFoundError:
                pass
            except OSError as error:
                fault = error.strerror or type(error).__name__
        if self._processes is not None:
            content, fault = self._processes.agreed((content, fault))
        if fault:
            raise InputError(f"checkpoint {self.path} cannot be read ({fault}); check the file, or give another path")
        return None if content is None else self._parsed(content, stages)

    def _parsed(self, content: bytes, stages: int) -> State:
        known = arrays_in(content)
        if known is None:
            raise self.refused("it is no .npz of arrays, or is cut short")
        try:
            about = json.loads(known["about"].tobytes())
        except (KeyError, ValueError, RecursionError):
            about = None
        if not isinstance(about, dict) or not isinstance(about.get("identity"), dict):
            raise self.refused("its entry about is no JSON of a fit")
        for key, expected in self._identity.items():
            if about["identity"].get(key) != expected:
                raise InputError(
                    f"{self.path} is the checkpoint of another fit: its {key} is "
                    f"{one_line(str(about['identity'].get(key)))}, and here {one_line(str(expected))}; delete it, or "
                    "give another path"
                )
        before, count = about.get("stages"), len(list(leaves(self._like)))
        if not isinstance(before, list) or len(before) >= stages:
            raise self.refused(f"its stages are no list of the ends of fewer than {stages}")
        for numbers in (*before, about.get("run")):
            if fault := fault_of(numbers, count):
                raise self.refused(f"its {fault} is missing, or of another kind")
        if "method" not in known:
            raise self.refused("it lacks the state of the method")
        # Nothing is the best before a loss is known.
        best = None if about["run"]["best_loss"] == math.inf else self._tree(known, "best")
        return State(about, self._tree(known, "parameters"), best, known["method"].tobytes())

    def _tree(self, known: dict[str, np.ndarray], name: str) -> Tree:
        numbers = iter(range(len(known)))
        xp = self._engine.namespace

        def leaf(x: Any) -> Any:
            entry = f"{name}.{next(numbers)}"
            if entry not in known or not is_like(known[entry], self._engine.to_numpy(x)):
                raise self.refused(f"its {entry} is missing, of another shape or dtype, or not finite")
            return xp.astype(self._engine.constant(known[entry], x), x.dtype, copy=False)

        return map_leaves(leaf, self._like)

    def refused(self, fault: str) -> InputError:
        """The error of a file with a fault."""
        return InputError(f"{self.path} is no checkpoint of rts.fit ({fault}); delete it, or give another path")

    def write(self, state: State) -> None:
        """Replace the file by a state, in the first process alone; a fit gone astray keeps its last sound state."""
        if self._processes is not None and self._processes.rank:
            return
        both = zip(leaves(state.parameters), leaves(self._like), strict=True)
        if not all(is_like(*map(self._engine.to_numpy, pair)) for pair in both):
            return
        about = json.dumps({**state.about, "identity": self._identity}).encode()
        arrays: dict[str, Any] = {
            "about": np.frombuffer(about, np.uint8),
            "method": np.frombuffer(state.method, np.uint8),
        }
        arrays |= dict(self._numbered("parameters", state.parameters))
        if state.best is not None:
            arrays |= dict(self._numbered("best", state.best))
        part = self.path.with_name(f"{self.path.name}.{os.getpid()}.part")
        try:
            with part.open("wb") as file:
                np.savez(file, **arrays)
                file.flush()
                os.fsync(file.fileno())
            os.replace(part, self.path)
        except OSError as error:
            with contextlib.suppress(OSError):
                part.unlink(missing_ok=True)
            warn(f"checkpoint {self.path} could not be written ({error.strerror}); the fit goes on", RtsWarning)

    def _numbered(self, name: str, tree: Tree) -> Iterator[tuple[str, np.ndarray]]:
        for i, x in enumerate(leaves(tree)):
            yield f"{name}.{i}", self._engine.to_numpy(x)


def arrays_in(content: bytes) -> dict[str, np.ndarray] | None:
    """The arrays of an .npz; None where these bytes are none, or hold pickles."""
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as file:
            return {name: file[name] for name in file.files}
    except Exception:  # Of which damaged archives raise many kinds, some with the advice to load pickles.
        return None


def is_like(x: np.ndarray, like: np.ndarray) -> bool:
    """True if an array has the shape and dtype of another one, and is finite where that one is."""
    return (x.shape, x.dtype) == (like.shape, like.dtype) and bool((np.isfinite(x) | ~np.isfinite(like)).all())
