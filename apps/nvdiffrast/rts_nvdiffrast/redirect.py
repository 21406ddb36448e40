"""Scripts that were written for nvdiffrast on a GPU, run as they are on the CPU.

The one place where names of others are replaced, for the run of the script alone. `nvdiffrast.torch` becomes
`rts_nvdiffrast.torch`. Functions of torch that take a CUDA device take the CPU in its place: in every thread, and in
the `backward` of a function of the script's own, since the names are replaced, not the calls of one thread. Waiting for
a GPU does nothing. Compiling an extension ends the script with one line.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import importlib.util
import os
import runpy
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any, NoReturn
from unittest import mock

import torch

import rts_nvdiffrast.torch

MISSING = {
    "nvdiffrast.tensorflow": "nvdiffrast's TensorFlow module",
    "torch.utils.cpp_extension": "compiling an extension (torch.utils.cpp_extension)",
}
"""Modules that cannot be had, and how to say so."""
IGNORED = (
    "synchronize empty_cache ipc_collect set_device set_stream init reset_peak_memory_stats reset_max_memory_allocated "
    "reset_max_memory_cached reset_accumulated_memory_stats set_per_process_memory_fraction is_current_stream_capturing"
)
"""Functions of `torch.cuda` that do nothing here, separated by spaces."""
FACTORIES = (
    "arange as_tensor asarray bartlett_window blackman_window empty empty_like empty_permuted empty_strided eye full "
    "full_like hamming_window hann_window kaiser_window linspace logspace normal ones ones_like rand rand_like randint "
    "randint_like randn randn_like randperm range scalar_tensor sparse_bsc_tensor sparse_bsr_tensor "
    "sparse_compressed_tensor sparse_coo_tensor sparse_csc_tensor sparse_csr_tensor tensor tril_indices triu_indices "
    "zeros zeros_like"
)
"""Functions of torch that take a device, separated by spaces."""
FREQUENCIES = "fftfreq rfftfreq"
"""Functions of `torch.fft` that do."""
METHODS = "new_empty new_empty_strided new_full new_ones new_tensor new_zeros"
"""Methods of tensors that do."""
CAPABILITY = 7, 0
"""Compute capability: nvdiffrast needs no more, and scripts take no way that is meant for GPUs of 8.0 or later."""


def _cpu(x: Any) -> Any:
    """The CPU in place of a GPU, as a device, its name or its number, or a name of a type; anything else as it is."""
    if type(x) is int:
        return torch.device("cpu")
    if isinstance(x, torch.device):
        return torch.device("cpu") if x.type == "cuda" else x
    if isinstance(x, str) and x.startswith("torch.cuda."):
        return x.replace("cuda.", "", 1)
    return "cpu" if isinstance(x, str) and x.partition(":")[0] == "cuda" else x


def _redirected(function: Callable, places: tuple[int, ...] = ()) -> Callable:
    """A function of torch on the CPU, whose arguments at some `places` may be devices, too."""

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        kwargs |= {name: _cpu(kwargs[name]) for name in ("device", "dtype") if name in kwargs}
        kwargs.pop("pin_memory", None)
        return function(*(_cpu(x) if i in places else x for i, x in enumerate(args)), **kwargs)

    return call


def _itself(x: Any, *_: Any, **__: Any) -> Any:
    """A tensor, moved to where it is already; or a function, not compiled."""
    return x


_device: Any = torch.Tensor.device


def _numbered_device(x: torch.Tensor) -> torch.device:
    """The device of a tensor; the CPU has the number 0, as a GPU would."""
    device = _device.__get__(x)
    return torch.device("cpu", 0) if device.type == "cpu" else device


@dataclasses.dataclass(frozen=True)
class _Properties:
    """Properties of the device, as `torch.cuda.get_device_properties` names them."""

    total_memory: int
    name: str = "CPU (rts_nvdiffrast)"
    major: int = CAPABILITY[0]
    minor: int = CAPABILITY[1]
    multi_processor_count: int = os.cpu_count() or 1


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
    """`torch.cuda.device` or `torch.cuda.stream`, which change nothing."""


class _Stream(contextlib.nullcontext):
    """A stream of `torch.cuda`, in which nothing is ever left to do."""

    def synchronize(self, *_: Any) -> None:
        pass

    wait_stream = wait_event = record_event = synchronize


class _Generator(torch.Generator):
    """`torch.Generator` on the CPU; a class, since scripts name it in annotations, too."""

    def __new__(cls, device: Any = "cpu") -> _Generator:
        return super().__new__(cls, device=_cpu(device))  # pyright: ignore[reportCallIssue]


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


def _modules() -> dict[str, ModuleType]:
    """Our modules, where scripts import nvdiffrast's."""
    package: Any = ModuleType("nvdiffrast")
    package.torch, package.__path__, package.__version__ = rts_nvdiffrast.torch, [], "0.4.0"
    modules: dict[str, ModuleType] = {"nvdiffrast": package, "nvdiffrast.torch": rts_nvdiffrast.torch}
    modules.update((name, _Missing(name)) for name in MISSING)
    return modules


def _names(pretend: bool) -> list[tuple[Any, dict[str, Any]]]:
    """Modules and classes of torch, with what some of their names are for a script."""
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") if hasattr(os, "sysconf") else 1 << 34
    properties = _Properties(memory)
    of_torch = {name: _redirected(getattr(torch, name)) for name in FACTORIES.split()} | {
        "Generator": _Generator,
        "load": functools.partial(_on_the_cpu, torch.load),
        "set_default_tensor_type": _set_default_tensor_type,
        "set_default_device": lambda device: None,
    }
    of_tensors = {name: _redirected(getattr(torch.Tensor, name), (1,)) for name in ("to", "type")}
    of_tensors |= {name: _redirected(getattr(torch.Tensor, name)) for name in METHODS.split()}
    of_tensors |= {"cuda": _itself, "pin_memory": _itself, "device": property(_numbered_device)}
    of_cuda: dict[str, Any] = dict.fromkeys(IGNORED.split(), lambda *_, **__: None) | {
        "Event": _Event,
        "Stream": lambda *_, **__: _Stream(),
        "current_stream": lambda device=None: _Stream(),
        "default_stream": lambda device=None: _Stream(),
        "device": _Nothing,
        "stream": _Nothing,
        "current_device": lambda: 0,
        "get_device_name": lambda device=None: properties.name,
        "get_device_properties": lambda device=None: properties,
        "get_device_capability": lambda device=None: CAPABILITY,
        "mem_get_info": lambda device=None: (memory, memory),
    }
    of_cuda |= {name: getattr(torch, name) for name in dir(torch.cuda) if name.endswith("Tensor")}
    if pretend:
        of_cuda |= {"is_available": lambda: True, "device_count": lambda: 1}
    compiling = {"cpp_extension": sys.modules["torch.utils.cpp_extension"]}
    return [
        (torch, of_torch),
        (torch.Tensor, of_tensors),
        (torch.fft, {name: _redirected(getattr(torch.fft, name)) for name in FREQUENCIES.split()}),
        (torch.cuda, of_cuda),
        (torch.jit, {"script": _itself}),
        (torch.utils, compiling),
    ]


def _on_the_cpu(load: Callable, f: Any, map_location: Any = None, **options: Any) -> Any:
    """`torch.load`, whose tensors come to the CPU."""
    return load(f, map_location="cpu", **options)


def _set_default_tensor_type(kind: Any) -> None:
    """`torch.set_default_tensor_type`, of which the precision is kept."""
    torch.set_default_dtype(torch.float64 if "Double" in str(kind) else torch.float32)


def _names_of_films() -> list[tuple[Any, dict[str, Any]]]:
    """As `_names`, of imageio, where it cannot write films; it would fail at the first frame, and not say why."""
    if importlib.util.find_spec("imageio") is None or importlib.util.find_spec("imageio_ffmpeg") is not None:
        return []
    import imageio
    import imageio.v2

    get_writer = imageio.get_writer

    def checked(uri: Any, *args: Any, **kwargs: Any) -> Any:
        if str(uri).endswith(".mp4"):
            sys.exit(f"rts_nvdiffrast: imageio-ffmpeg, which writes {uri}, is missing: pip install imageio-ffmpeg")
        return get_writer(uri, *args, **kwargs)

    return [(module, {"get_writer": checked}) for module in (imageio, imageio.v2)]


@contextlib.contextmanager
def redirected(pretend: bool = False) -> Iterator[None]:
    """While it is entered, CUDA is the CPU in all threads, and nvdiffrast's modules are ours.

    Args:
        pretend: whether `torch.cuda.is_available()` is true.
    """
    # The first optimizer has torch import modules that read its names, which must be torch's own then.
    torch.optim.SGD([torch.zeros(1)], lr=1.0)
    modules = _modules()
    before = {name: sys.modules.pop(name) for name in modules if name in sys.modules}
    sys.modules.update(modules)
    try:
        with contextlib.ExitStack() as stack:
            for owner, names in [*_names(pretend), *_names_of_films()]:
                stack.enter_context(mock.patch.multiple(owner, create=True, **names))
            yield
    finally:
        for name in modules:
            sys.modules.pop(name, None)
        sys.modules.update(before)


def run(script: str, arguments: list[str], pretend: bool = False) -> None:
    """Run a script with arguments, as `python script …` would, on the CPU and with nvdiffrast's names.

    Args:
        script: path of a script in Python.
        arguments: its arguments.
        pretend: see `redirected`.

    Raises:
        SystemExit: the script ends so; or, with one line, there is no such file, or it needs a GPU, or a package that
            writes mp4.
    """
    if not Path(script).is_file():
        sys.exit(f"rts_nvdiffrast: no file {script!r}; expected a script in Python")
    folder, argv = str(Path(script).resolve().parent), [script, *arguments]
    with mock.patch.object(sys, "argv", argv), mock.patch.object(sys, "path", [folder, *sys.path]), redirected(pretend):
        runpy.run_path(script, run_name="__main__")
