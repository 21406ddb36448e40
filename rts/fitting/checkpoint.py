"""Checkpoints: the state of a fit in one file, from which it goes on bit for bit."""

from __future__ import annotations

import contextlib
import io
import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rts.arrays.argument_checks import quoted
from rts.arrays.engines import Engine
from rts.arrays.trees import Tree, leaves, map_leaves
from rts.contracts.checks import is_count
from rts.errors import InputError, RtsWarning, warn
from rts.fitting.parameter_names import named_leaves, one_line
from rts.fitting.processes import Processes

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
        if self.path.is_dir() or not self.path.parent.is_dir():
            raise InputError(f"checkpoint is {self.path}; expected a file in a folder that exists")
        self._like, self._engine, self._processes = like, engine, processes
        self._identity = {
            "format": FORMAT,
            "method": method,
            "parameters": [[name, list(x.shape), str(x.dtype)] for name, x in named_leaves(like)],
        }

    def read(self) -> State | None:
        """The state in the file; None if there is no file.

        Raises:
            InputError: the file is damaged, or of another fit.
        """
        told = None
        if self._processes is None or self._processes.rank == 0:
            with contextlib.suppress(FileNotFoundError):
                told = self.path.read_bytes()
        return self._parsed(told if self._processes is None else self._processes.agreed(told))

    def _parsed(self, content: bytes | None) -> State | None:
        if content is None:
            return None
        try:
            with np.load(io.BytesIO(content), allow_pickle=False) as file:
                known = {name: file[name] for name in file.files}
            about = json.loads(known["about"].tobytes())
            identity = about.pop("identity")
            method = known["method"].tobytes()
        except Exception as error:  # Of which damaged archives raise many kinds.
            raise InputError(
                f"{self.path} is no checkpoint of rts.fit ({one_line(str(error), 80)}); delete it, or give another path"
            ) from error
        for key, expected in self._identity.items():
            if identity.get(key) != expected:
                raise InputError(
                    f"{self.path} is the checkpoint of another fit: its {key} is {one_line(str(identity.get(key)))}, "
                    f"and here {one_line(str(expected))}; delete it, or give another path"
                )
        best = self._tree(known, "best") if "best.0" in known else None
        return State(about, self._tree(known, "parameters"), best, method)

    def _tree(self, known: dict[str, np.ndarray], name: str) -> Tree:
        numbers = iter(range(len(known)))
        xp = self._engine.namespace

        def leaf(x: Any) -> Any:
            return xp.astype(self._engine.constant(known[f"{name}.{next(numbers)}"], x), x.dtype, copy=False)

        return map_leaves(leaf, self._like)

    def write(self, state: State) -> None:
        """Replace the file by a state, in the first process alone."""
        if self._processes is not None and self._processes.rank:
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
