"""Host functions inside compiled jax programs, on the CPU without copies of what they read.

A typed custom call of XLA, whose handler is a Python function: it takes the interpreter lock, looks at the operands
where they lie and fills the results in place. `jax.pure_callback` does the same work through copies. It takes over on
other devices, and where the interface of this jaxlib is not the one that is described here.

Shapes in a program are those of the worst case. What is not used of an array is zero, and made so without touching
its memory (`clear`): where nobody reads it, it takes neither time nor room.
"""

from __future__ import annotations

import atexit
import contextlib
import ctypes
import functools
import itertools
import math
import mmap
import os
import sys
import warnings
import weakref
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numba
import numpy as np
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import batching, mlir, partial_eval
from llvmlite import ir
from numba.extending import intrinsic

TARGET = "rts_host_call"

HostFunction = Callable[..., Sequence[np.ndarray | np.generic]]
"""NumPy arrays in, which are read-only and lent for the length of the call, and NumPy arrays out."""

Filler = Callable[[Sequence[np.ndarray], Sequence[np.ndarray]], None]
"""Operands, which are read-only and lent like the results, and the results, to be filled."""

Shapes = tuple[jax.ShapeDtypeStruct, ...]

_named: dict[str, Filler] = {}
_passing: weakref.WeakValueDictionary[str, _Selected] = weakref.WeakValueDictionary()
_numbers = itertools.count()


def call_named(
    name: str, function: Filler, shapes: Shapes, *operands: jax.Array, in_place: dict[int, int] | None = None
) -> list[jax.Array]:
    """The results of a host function, in a traced program for the CPU.

    Args:
        name: stands for the function in the program, and in programs that jax keeps on disk: says all that the function
            depends on but its operands.
        function: kept as long as the process lives.
        shapes: shapes and dtypes of the results.
        operands: of the function.
        in_place: the indices of operands that lie where a result is to be, and of these results, alike in shape and
            dtype. XLA makes copies of such operands where something else reads them later.
    """
    if not _available():
        return _copying(function, shapes, *operands)
    _named[name] = function
    return list(jax.ffi.ffi_call(TARGET, shapes, input_output_aliases=in_place)(*operands, function=name))


def call(function: HostFunction, shapes: Shapes, *operands: Any) -> list[jax.Array]:
    """The results of a host function in any traced program, whose own life is as long as the function's.

    Results that the program does not use are not copied. One that is shorter along an axis than its shape says is
    padded with zeros. Under `vmap` the function is called for each item.
    """
    return _call.bind(*operands, function=function, shapes=shapes, used=tuple(range(len(shapes))))


def zeros(shape: tuple[int, ...], dtype: Any, number: int = 0) -> jax.Array:
    """Zeros, in a traced program; on the CPU the memory of large arrays is not touched before they are overwritten.

    Args:
        shape: of the array.
        dtype: of the array.
        number: tells apart arrays of one shape, so that XLA does not make copies of one.
    """
    dtype = np.dtype(dtype)
    if dtype.itemsize * math.prod(shape) < _LEAST:
        return jnp.zeros(shape, dtype)
    return _zeros.bind(shape=tuple(shape), dtype=dtype, number=number)


class _Selected:
    """Some of the results of a function."""

    def __init__(self, function: HostFunction, used: Sequence[int]):
        self.function, self.used = function, used

    def __call__(self, operands: Sequence[np.ndarray], results: Sequence[np.ndarray]) -> None:
        found = self.function(*operands)
        for i, result in zip(self.used, results, strict=True):
            fill(result, found[i])


_call = Primitive("rts_host_call")
_call.multiple_results = True


@_call.def_impl
def _run(*operands: Any, **params: Any) -> list[jax.Array]:
    return jax.jit(functools.partial(_call.bind, **params))(*operands)


@_call.def_abstract_eval
def _results(*operands: Any, function: HostFunction, shapes: Shapes, used: Sequence[int]) -> list[ShapedArray]:
    return [ShapedArray(shapes[i].shape, shapes[i].dtype) for i in used]


def _batched(operands: Sequence, dims: Sequence, **params: Any) -> tuple[list, list[int]]:
    mapped = [jnp.moveaxis(x, d, 0) for x, d in zip(operands, dims, strict=True) if d is not None]

    def item(own: list) -> list[jax.Array]:
        it = iter(own)
        return _call.bind(*(x if d is None else next(it) for x, d in zip(operands, dims, strict=True)), **params)

    found = jax.lax.map(item, mapped)
    return found, [0] * len(found)


def _without_unused(wanted: Sequence[bool], equation: Any) -> tuple[list[bool], Any]:
    """The call with those of its results that are wanted."""
    if not any(wanted):
        return [False] * len(equation.invars), None
    used = tuple(i for i, wish in zip(equation.params["used"], wanted, strict=True) if wish)
    outvars = [v for v, wish in zip(equation.outvars, wanted, strict=True) if wish]
    return [True] * len(equation.invars), equation.replace(outvars=outvars, params={**equation.params, "used": used})


def _copying(function: Filler, shapes: Sequence[jax.ShapeDtypeStruct], *operands: Any) -> list[jax.Array]:
    def whole(*given: Any) -> tuple[np.ndarray, ...]:
        results = tuple(np.empty(shape.shape, shape.dtype) for shape in shapes)
        function(list(map(np.asarray, given)), results)
        return results

    return list(jax.pure_callback(whole, tuple(shapes), *operands))


def _copying_some(*operands: Any, function: HostFunction, shapes: Shapes, used: Sequence[int]) -> list[jax.Array]:
    return _copying(_Selected(function, used), [shapes[i] for i in used], *operands)


def _in_place(ctx: Any, *operands: Any, function: HostFunction, shapes: Shapes, used: Sequence[int]) -> Any:
    if not _available():
        rule = mlir.lower_fun(_copying_some, multiple_results=True)
        return rule(ctx, *operands, function=function, shapes=shapes, used=used)
    selected = _Selected(function, used)
    name = f"{os.getpid()} {next(_numbers)}"
    _passing[name] = selected
    # A call of the usual kind, of no result, which XLA removes. But the program now keeps the function alive for as
    # long as it lives itself, and is not kept on disk, where it would outlive it.
    mlir.emit_python_callback(ctx.replace(avals_in=[], avals_out=[]), selected, None, [], [], [], has_side_effect=False)
    return jax.ffi.ffi_lowering(TARGET)(ctx, *operands, function=name)


_zeros = Primitive("rts_zeros")


@_zeros.def_impl
def _all_zeros(shape: tuple[int, ...], dtype: np.dtype, number: int) -> jax.Array:
    return jnp.zeros(shape, dtype)


@_zeros.def_abstract_eval
def _shape_of_zeros(shape: tuple[int, ...], dtype: np.dtype, number: int) -> ShapedArray:
    return ShapedArray(shape, dtype)


def _untouched(ctx: Any, *, number: int, **described: Any) -> Any:
    if not _available():
        return _touched(ctx, number=number, **described)
    name = f"rts.zeros {number}"
    _named[name] = lambda operands, results: clear(results[0])
    return jax.ffi.ffi_lowering(TARGET)(ctx, function=name)


_touched = mlir.lower_fun(_all_zeros, multiple_results=False)
mlir.register_lowering(_zeros, _touched)
mlir.register_lowering(_zeros, _untouched, platform="cpu")

batching.primitive_batchers[_call] = _batched
partial_eval.dce_rules[_call] = _without_unused
mlir.register_lowering(_call, mlir.lower_fun(_copying_some, multiple_results=True))
mlir.register_lowering(_call, _in_place, platform="cpu")


def fill(out: np.ndarray, value: np.ndarray | np.generic) -> None:
    """Copy a value, and write zeros where it is shorter than `out`."""
    value = np.asarray(value)
    if value.shape != out.shape:
        if value.ndim != out.ndim or any(n > size for n, size in zip(value.shape, out.shape, strict=True)):
            raise ValueError(f"a host function returned an array of shape {value.shape}, where {out.shape} was said")
        for axis, n in enumerate(value.shape):
            clear(out[(*map(slice, value.shape[:axis]), slice(n, None))], PIECE)
    out[tuple(map(slice, value.shape))] = value


def clear(out: np.ndarray, read: int = 0) -> None:
    """Fill with zeros. A large array's pages are handed back: the system gives empty ones when they are touched.

    Args:
        out: the array.
        read: how many of its first rows may be read all the same; their pages stay.
    """
    if out.nbytes < _LEAST or not out.flags.c_contiguous or _advise is None:
        out[...] = 0
        return
    data = out.reshape(-1).view(np.uint8)
    start = min(read, len(out)) * (out.nbytes // len(out))
    start += -(data.ctypes.data + start) % mmap.PAGESIZE
    stop = start + (len(data) - start) // mmap.PAGESIZE * mmap.PAGESIZE
    if stop <= start:
        out[...] = 0
        return
    # Shared memory would come back as it was; the mark at `start` tells.
    data[:start], data[stop:], data[start] = 0, 0, 1
    if _advise(data[start:].ctypes.data, stop - start, mmap.MADV_DONTNEED) or data[start]:
        out[...] = 0


def large_pages(results: Sequence[np.ndarray]) -> None:
    """Ask the system for pages of megabytes where results of a call are, and between them.

    What a program computes with lies side by side. Beyond some 32 MB it is new memory in each call, of which the system
    gives a page whenever one is touched first; to be given small ones takes longer than to fill them. What else lies
    between the results may get large pages, too: it stays as it is, but may take more memory.
    """
    places = [(x.__array_interface__["data"][0], x.nbytes) for x in results if x.nbytes >= _LEAST]
    if not places or _advise is None or _HUGE is None:
        return
    first, last = min(start for start, _ in places), max(start + size for start, size in places)
    # What is far apart has been allotted apart.
    if _SPARSE * sum(size for _, size in places) >= last - first >= _LARGE:
        first -= first % mmap.PAGESIZE
        _advise(first, last - first, _HUGE)


_LARGE, _SPARSE = 1 << 25, 4
"""Bytes from which on large pages are asked for, and how many times more they may be than those of the results."""

_LEAST = 1 << 17
"""Bytes, below which a call to the system is not worth it."""

PIECE = 1 << 11
"""Rows that functions of rows in use take at a time (`rows_in_use.py`): so many that calls of XLA's are worth it, and
so few that intermediate arrays stay in caches, and that XLA does not wake its other threads for each. They read on to
the end of a piece, masked; where there is no page, that takes a microsecond a row."""

_HUGE: int | None = getattr(mmap, "MADV_HUGEPAGE", None)
_advise: Callable[[int, int, int], int] | None = None
if sys.platform == "linux":  # Elsewhere `MADV_DONTNEED` promises no zeros.
    _advise = ctypes.CDLL(None).madvise
    _advise.argtypes = ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int


@functools.cache
def _available() -> bool:
    """Whether the handler is registered; XLA asks it for its version on the way."""
    try:
        # jax registers late what it is given before there are devices.
        client = jax.local_devices(backend="cpu")[0].client
        handler = jax.ffi.pycapsule(_guarded().address)
        jax.ffi.register_ffi_target(TARGET, handler, platform="cpu", api_version=1)
        # Where `_settle` does not help: its destructor would wait without end for threads that Python has ended.
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(client))
        atexit.register(_settle, os.getpid())  # Before jax's own, which has been registered before.
    except Exception as error:
        warnings.warn(f"host functions in jax programs are slower than they could be: {error}", stacklevel=2)
        return False
    return _versions == [MAJOR]


def _settle(process: int) -> None:
    """Let programs come to their end that nobody has waited for, when a process ends.

    Once Python is about to end, it ends all threads that ask for the interpreter lock, XLA's as well.
    """
    if os.getpid() != process:  # A forked child has none of the threads.
        return
    with contextlib.suppress(Exception):
        devices = jax.local_devices(backend="cpu")
        # A program begins after those before it: of one device after all that the thread has started, of several after
        # those of several.
        for own in dict.fromkeys([*((device,) for device in devices), tuple(devices)]):
            sharding = jax.sharding.NamedSharding(jax.sharding.Mesh(own, "a"), jax.sharding.PartitionSpec())
            jax.block_until_ready(jax.jit(jnp.negative)(jax.device_put(np.float32(0), sharding)))


# ------------------------------------------------------ the interface: xla/ffi/api/c_api.h in jaxlib's include folder

MAJOR, MINOR = 0, 1
"""The version of the interface: another major one is refused, and of what later minor ones add nothing is used."""
_versions: list[int] = []
_METADATA, _EXECUTE, _STRING, _INTERNAL = 1, 3, 4, 13
_DTYPES = {
    1: np.dtype(np.bool_),
    **{i + 2: np.dtype(f"i{2**i}") for i in range(4)},
    **{i + 6: np.dtype(f"u{2**i}") for i in range(4)},
    11: np.dtype(np.float32),
    12: np.dtype(np.float64),
}


def _struct(name: str, **fields: Any) -> type[ctypes.Structure]:
    """A structure of the interface: each begins with its size and a list of extensions."""
    head = [("size_of", ctypes.c_size_t), ("extension", ctypes.c_void_p)]
    return type(name, (ctypes.Structure,), {"_fields_": [*head, *fields.items()]})


class _Text(ctypes.Structure):
    _fields_ = [("start", ctypes.c_void_p), ("length", ctypes.c_size_t)]


_Pointers = ctypes.POINTER(ctypes.c_void_p)
_Buffer = _struct(
    "_Buffer", dtype=ctypes.c_int, data=ctypes.c_void_p, rank=ctypes.c_int64, dims=ctypes.POINTER(ctypes.c_int64)
)
_Arguments = _struct("_Arguments", count=ctypes.c_int64, types=ctypes.POINTER(ctypes.c_int), items=_Pointers)
_Attributes = _struct(
    "_Attributes", count=ctypes.c_int64, types=ctypes.POINTER(ctypes.c_int), names=_Pointers, items=_Pointers
)
_Version = _struct("_Version", major=ctypes.c_int, minor=ctypes.c_int)
_ErrorArguments = _struct("_ErrorArguments", message=ctypes.c_char_p, code=ctypes.c_int)
_Api = _struct(
    "_Api",
    version=_Version,
    internal=ctypes.c_void_p,
    error_create=ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.POINTER(_ErrorArguments)),
)
_Frame = _struct(
    "_Frame",
    api=ctypes.POINTER(_Api),
    context=ctypes.c_void_p,
    stage=ctypes.c_int,
    arguments=_Arguments,
    results=_Arguments,
    attributes=_Attributes,
)
_Metadata = type("_Metadata", (ctypes.Structure,), {"_fields_": [("size_of", ctypes.c_size_t), ("version", _Version)]})


class _Extension(ctypes.Structure):
    _fields_ = [
        ("size_of", ctypes.c_size_t),
        ("type", ctypes.c_int),
        ("next", ctypes.c_void_p),
        ("metadata", ctypes.POINTER(_Metadata)),
    ]


def _handle(address: int, outcome: int) -> None:
    """Fill the results of a call, and write at `outcome` that it is `_DONE`, or the address of an error of XLA's."""
    frame, status = ctypes.cast(address, ctypes.POINTER(_Frame)).contents, ctypes.c_ssize_t.from_address(outcome)
    try:
        _answer(frame)
        status.value = _DONE
    except BaseException as error:  # XLA cannot pass on an exception, only its text.
        message = f"{type(error).__name__}: {error}".encode()
        given = _ErrorArguments(ctypes.sizeof(_ErrorArguments), None, message, _INTERNAL)
        status.value = frame.api.contents.error_create(ctypes.byref(given))


def _answer(frame: Any) -> None:
    if frame.extension:
        extension = ctypes.cast(frame.extension, ctypes.POINTER(_Extension)).contents
        if extension.type == _METADATA:
            _tell_version(frame, extension.metadata.contents)
            return
    if frame.stage != _EXECUTE:
        return
    arguments, results = frame.arguments, frame.results
    operands = [_array(arguments.items[i]) for i in range(arguments.count)]
    for operand in operands:
        operand.flags.writeable = False
    name, found = _name(frame.attributes), [_array(results.items[i]) for i in range(results.count)]
    large_pages(found)
    (_named.get(name) or _passing[name])(operands, found)


_HANDLER = ctypes.CFUNCTYPE(None, ctypes.c_ssize_t, ctypes.c_ssize_t)(_handle)
_LEFT, _DONE = 0, 1
"""Outcomes of a call: an exception has left the handler, as an interrupt may before its first line; all is filled."""

_ABANDONED = _ErrorArguments(
    ctypes.sizeof(_ErrorArguments), None, b"a host function was left before its results were complete", _INTERNAL
)


@intrinsic
def _abandoned(context: Any, frame: Any) -> Any:
    """The address of an error of XLA's, made without Python."""

    def build(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        number = ir.IntType(8 * ctypes.sizeof(ctypes.c_ssize_t))

        def field(structure: Any, offset: int) -> Any:
            address = builder.add(structure, number(offset))
            return builder.load(builder.inttoptr(address, number.as_pointer()))

        function = ir.FunctionType(number, [number]).as_pointer()
        create = field(field(arguments[0], _Frame.api.offset), _Api.error_create.offset)
        return builder.call(builder.inttoptr(create, function), [number(ctypes.addressof(_ABANDONED))])

    return numba.intp(numba.intp), build


@functools.cache
def _guarded() -> Any:
    """A compiled function, which XLA calls, that calls the handler.

    ctypes ignores exceptions that leave the handler, and its result would be anything then.
    """

    @numba.cfunc(numba.intp(numba.intp))
    def guarded(frame: int) -> int:
        outcome = np.full(1, _LEFT, np.intp)
        _HANDLER(frame, outcome.ctypes.data)
        if outcome[0] == _LEFT:
            return _abandoned(frame)  # pyright: ignore[reportCallIssue]  # numba gives the context.
        return 0 if outcome[0] == _DONE else outcome[0]

    return guarded


def _tell_version(frame: Any, metadata: Any) -> None:
    """Answer XLA's question which version of the interface this is, and look at what its own is.

    Before jaxlib 0.9 XLA does not say what its own is; it takes no version but its own, then.
    """
    if frame.size_of < ctypes.sizeof(_Frame) or metadata.size_of < ctypes.sizeof(_Metadata):
        raise RuntimeError("the structures of XLA's interface are smaller than expected")
    _versions[:] = [frame.api.contents.version.major if frame.api else MAJOR]
    metadata.version.major, metadata.version.minor = MAJOR, MINOR


def _array(address: int) -> np.ndarray:
    """A view of a buffer."""
    buffer = ctypes.cast(address, ctypes.POINTER(_Buffer)).contents
    dtype, shape = _DTYPES[buffer.dtype], tuple(buffer.dims[: buffer.rank])
    size = dtype.itemsize * int(np.prod(shape))
    if size == 0:
        return np.empty(shape, dtype)
    return np.ndarray(shape, dtype, (ctypes.c_char * size).from_address(buffer.data))


def _name(attributes: Any) -> str:
    """The only attribute."""
    assert attributes.count == 1 and attributes.types[0] == _STRING
    text = ctypes.cast(attributes.items[0], ctypes.POINTER(_Text)).contents
    return ctypes.string_at(text.start, text.length).decode()
