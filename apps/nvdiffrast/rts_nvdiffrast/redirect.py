"""Scripts that were written for nvdiffrast on a GPU, run as they are on the CPU.

The one place where names of others are replaced. `nvdiffrast.torch` becomes `rts_nvdiffrast.torch`. Calls of torch that
name a CUDA device get the CPU in its place. Waiting for a GPU does nothing. Compiling an extension ends the script
with one line.
"""

from __future__ import annotations

import contextlib
import runpy
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any, NoReturn

import torch
from torch.overrides import TorchFunctionMode

import rts_nvdiffrast.torch

MISSING = {
    "nvdiffrast.tensorflow": "nvdiffrast's TensorFlow module",
    "torch.utils.cpp_extension": "compiling an extension (torch.utils.cpp_extension)",
}
"""Modules that cannot be had, and how to say so."""
IGNORED = ("synchronize", "empty_cache", "set_device", "reset_peak_memory_stats", "init")
"""Functions of `torch.cuda` that do nothing here."""


class _OnTheCpu(TorchFunctionMode):
    """While it is entered, CUDA devices in calls of torch are the CPU, and memory is never pinned."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        name = getattr(func, "__name__", "")
        if name in ("cuda", "pin_memory") and args and isinstance(args[0], torch.Tensor):
            return args[0]
        kwargs = {k: _cpu(v) if k == "device" else v for k, v in (kwargs or {}).items()}
        kwargs.pop("pin_memory", None)
        if name == "to" and len(args) > 1:
            args = (args[0], _cpu(args[1]), *args[2:])
        return func(*args, **kwargs)


def _cpu(x: Any) -> Any:
    """A device as an argument of torch: the CPU in place of a GPU, also by its number; anything else as it is."""
    if type(x) is int:
        return torch.device("cpu")
    if isinstance(x, torch.device):
        return torch.device("cpu") if x.type == "cuda" else x
    return "cpu" if isinstance(x, str) and x.partition(":")[0] == "cuda" else x


class _Event:
    """An event of `torch.cuda` that takes the time of the host."""

    def __init__(self, *_: Any, **__: Any):
        self._time = 0.0

    def record(self, *_: Any) -> None:
        self._time = time.perf_counter()

    def synchronize(self) -> None:
        pass

    def elapsed_time(self, end: _Event) -> float:
        """Milliseconds from this event to another."""
        return 1e3 * (end._time - self._time)


class _Nothing(contextlib.nullcontext):
    """`torch.cuda.device`, which changes nothing."""


class _Generator(torch.Generator):
    """`torch.Generator` on the CPU; a class, since scripts name it in annotations, too."""

    def __new__(cls, device: Any = "cpu") -> _Generator:
        return super().__new__(cls, device=_cpu(device))  # pyright: ignore[reportCallIssue]


_load = torch.load


class _Missing(ModuleType):
    """A module whose attributes end the script with one line."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return _refusal(f"{MISSING[self.__name__]} cannot run without a GPU; {name} was asked for")


def _refusal(message: str) -> Callable[..., NoReturn]:
    """A function that ends the script with one line."""

    def refuse(*_: Any, **__: Any) -> NoReturn:
        sys.exit(f"rts_nvdiffrast: {message}")

    return refuse


def _replace_modules() -> None:
    """Put our modules where scripts import nvdiffrast's, and take the GPU out of `torch.cuda`."""
    package = ModuleType("nvdiffrast")
    package.torch = rts_nvdiffrast.torch  # pyright: ignore[reportAttributeAccessIssue]
    package.__path__ = []
    package.__version__ = "0.4.0"  # pyright: ignore[reportAttributeAccessIssue]
    sys.modules.update({"nvdiffrast": package, "nvdiffrast.torch": rts_nvdiffrast.torch})
    for name in MISSING:
        sys.modules[name] = _Missing(name)
    torch.utils.cpp_extension = sys.modules["torch.utils.cpp_extension"]  # pyright: ignore[reportAttributeAccessIssue]
    for name in IGNORED:
        setattr(torch.cuda, name, lambda *_, **__: None)
    torch.cuda.Event = _Event  # pyright: ignore[reportAttributeAccessIssue]
    torch.cuda.current_device = lambda: 0
    torch.cuda.device = _Nothing  # pyright: ignore[reportAttributeAccessIssue]
    torch.Generator = _Generator
    torch.load = lambda f, map_location=None, **options: _load(f, map_location="cpu", **options)
    torch.set_default_tensor_type = _set_default_tensor_type
    torch.set_default_device = lambda device: None


def _set_default_tensor_type(kind: Any) -> None:
    """`torch.set_default_tensor_type`, of which the precision is kept."""
    torch.set_default_dtype(torch.float64 if "Double" in str(kind) else torch.float32)


def run(script: str, arguments: list[str]) -> None:
    """Run a script with arguments, as `python script …` would, on the CPU and with nvdiffrast's names.

    Raises:
        SystemExit: the script ends so; or, with one line, there is no such file, or it needs a GPU.
    """
    if not Path(script).is_file():
        sys.exit(f"rts_nvdiffrast: no file {script!r}; expected a script in Python")
    _replace_modules()
    sys.argv = [script, *arguments]
    sys.path.insert(0, str(Path(script).resolve().parent))
    with _OnTheCpu():
        runpy.run_path(script, run_name="__main__")
