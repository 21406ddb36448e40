"""The engine of torch tensors: eager autograd, `torch.func` transforms and `torch.compile`, on any device."""

from __future__ import annotations

import threading
import weakref
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
import torch.utils.checkpoint
from torch.compiler import is_compiling
from torch.utils import _pytree

from rts import Engine, InputError
from rts.plugin_api.arrays import Tree, leaves, map_leaves
from rts.plugin_api.checks import quoted
from rts_backends.torch_engine import array_api, operations, torch_internals
from rts_backends.torch_engine.functions import quiet_forward_mode, tangent_alike, transformed
from rts_backends.torch_engine.host_call import call_host, to_host, to_tensor, to_tensors

for _cls, _split, _join in Engine.records():
    _pytree.register_pytree_node(_cls, _split, _join, serialized_type_name=f"rts.{_cls.__name__}")


_REAL = {torch.float32, torch.float64, torch.int32, torch.int64, torch.bool, torch.uint8, torch.float16, torch.bfloat16}
"""Dtypes of tensors that are taken as they are; others may be complex, or quantized."""


_NUMPYS = _REAL - {torch.float16, torch.bfloat16}
"""Dtypes of these that tensors keep as NumPy arrays."""

_running = threading.local()
"""`_running.checkpoint` is True on a thread that runs what `TorchEngine.checkpoint` may run again."""

FEW = 16
"""The most products of a sum that are made one by one."""

_CPU = torch.device("cpu")
_cast = np.errstate(over="ignore")(np.ndarray.astype)
"""`astype`, by which too large numbers become infinite."""

_sent: dict[tuple[int, torch.device], tuple[weakref.ref, torch.Tensor]] = {}
"""Read-only tables of the host by identity and device, and their tensors there."""


def _is_fixed(array: np.ndarray) -> bool:
    """True for a read-only array that owns its memory, whose numbers stay."""
    return array.flags.owndata and not array.flags.writeable


class TorchEngine(Engine):
    """Engine of torch tensors."""

    name = "torch"
    namespace = array_api

    def owns(self, x: Any) -> bool:
        """True for a tensor."""
        return isinstance(x, torch.Tensor)

    def constant(self, value: Any, like: torch.Tensor | None = None) -> torch.Tensor:
        """`value` on the device of `like`, else on the CPU; floats as float64 if `like` is, else as float32.

        Of read-only tables of integers, such as a mesh's faces, one tensor is made for each device, and kept as long as
        they live: their numbers must stay, and nobody may change the result in place.
        """
        array, device = np.asarray(value), _CPU if like is None else like.device
        dtype = np.float64 if like is not None and like.dtype is torch.float64 else np.float32
        if array.dtype.kind == "f" and array.dtype != dtype:
            array = _cast(array, dtype, "C")  # torch takes longer for a matrix.
            if device.type == "cpu":
                return torch.from_numpy(array)
        if array.dtype.kind != "i" or not _is_fixed(array) or transformed():
            return to_tensor(array, device)
        key = id(array), device
        kept = _sent.get(key)
        if kept is None or kept[0]() is not array:
            with torch.inference_mode(False):  # Gradients may need it later.
                sent = to_tensor(array, device)
            if type(sent) is not torch.Tensor and device.type == "cpu":  # Without values, as in FakeTensorMode.
                return sent
            kept = _sent[key] = weakref.ref(array, lambda _: _sent.pop(key, None)), sent
        return kept[1]

    def arange(self, count: int, like: torch.Tensor) -> torch.Tensor:
        """See `Engine.arange`: made on the device."""
        return torch.arange(count, dtype=like.dtype, device=like.device)

    call_host = staticmethod(call_host)  # pyright: ignore[reportAssignmentType]  # To pyright it is no method.

    def uncompiled(self, f: Callable) -> Callable:
        """`f` itself; while `torch.compile` traces, a function that calls `f` without tracing it."""
        return torch.compiler.disable(f) if is_compiling() else f

    def stop_gradient(self, x: torch.Tensor) -> torch.Tensor:
        """`x` detached."""
        return x.detach()

    apply = staticmethod(operations.apply)  # pyright: ignore[reportAssignmentType]  # To pyright it is no method.

    def on_host(self, *arrays: torch.Tensor) -> bool:
        """True if all tensors are in the memory of the host."""
        for x in arrays:
            if not x.is_cpu:
                return False
        return True

    def devices(self, arrays: Iterable[Any]) -> set[torch.device]:
        """The devices of the tensors. Single numbers on the CPU count for nothing: torch takes them beside any."""
        return {x.device for x in arrays if isinstance(x, torch.Tensor) and (x.ndim or not x.is_cpu)}

    def product(self, a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
        """See `Engine.product`: by elements on devices, whose matrix units may be set to round, and in `autocast`.

        Of large matrices in float64 there, which is never rounded: elements would take too much memory.
        """
        if a.is_cpu and a.dtype == b.dtype and not torch.is_autocast_enabled("cpu"):
            return a @ b
        if a.shape[-1] <= FEW or a.device.type == "mps":  # Which has no float64.
            return (a.unsqueeze(-1) * b.unsqueeze(-3)).sum(-2)
        return (a.double() @ b.double()).to(torch.promote_types(a.dtype, b.dtype))

    def plain(self, x: torch.Tensor) -> bool:
        """True for a dense tensor with values, of a dtype in `_REAL`, while torch's forward mode is off."""
        return x.layout is torch.strided and x.dtype in _REAL and not x.is_meta and torch_internals.forward_level() < 0

    def admitted(self, x: torch.Tensor, name: str) -> torch.Tensor:
        """`x`, with its tangent in the dtype of `x`.

        Raises:
            InputError: `x` is sparse, quantized, complex, or on the device "meta".
        """
        if x.layout is not torch.strided or x.is_quantized:
            what = "quantized" if x.is_quantized else str(x.layout).removeprefix("torch.")
            raise InputError(f"{name} is a {what} tensor; expected a dense one (to_dense(), dequantize())")
        if x.is_meta:
            raise InputError(f"{name} is a tensor on the device 'meta', which has no values; expected one that has")
        if x.dtype.is_complex:
            raise InputError(f"{name} has dtype {x.dtype}; expected real numbers")
        return tangent_alike(x) if torch_internals.forward_level() >= 0 else x

    def known(self, x: torch.Tensor) -> np.ndarray | None:
        """The value of `x` as NumPy, for all items of a batch; None under `torch.compile`, or for `foreign` tensors."""
        if is_compiling() or torch_internals.is_legacy_batchedtensor(x):
            return None
        if torch_internals.current_level() is None:
            return x.numpy(force=True) if x.is_cpu and x.dtype in _NUMPYS else to_host(x)
        return torch_internals.value_within(x, to_host)

    def at_hand(self, x: torch.Tensor) -> np.ndarray | None:
        """See `Engine.at_hand`."""
        return self.known(x) if x.is_cpu else None

    def are_known(self, arrays: Iterable[torch.Tensor]) -> bool:
        """See `Engine.are_known`."""
        if torch_internals.current_level() is not None or is_compiling():
            return super().are_known(arrays)
        return not any(map(torch_internals.is_legacy_batchedtensor, arrays))

    def placed(self, arrays: Sequence[np.ndarray], like: torch.Tensor | None) -> Sequence[torch.Tensor]:
        """See `Engine.placed`."""
        return to_tensors(arrays, None if like is None else like.device)

    def padded(self, x: torch.Tensor) -> bool:
        """True under a `torch.func` transform: under `torch.vmap` all items have as many rows as the longest."""
        return torch_internals.current_level() is not None

    def fill_unused(self, x: torch.Tensor, row: torch.Tensor) -> torch.Tensor:
        """See `Engine.fill_unused`: by selection; all rows become ones if no row is in use."""
        used = row.max() + 1
        index = torch.arange(x.shape[0], device=x.device).reshape(-1, *[1] * (x.ndim - 1))
        return torch.where(index < used, x, torch.where(used > 0, x[:1], torch.ones_like(x[:1])))

    def segment_sum(self, values: torch.Tensor, segments: torch.Tensor | np.ndarray, count: int) -> torch.Tensor:
        """(count, n) sums of the rows of `values` (N, n) that have the same number in `segments` (N,)."""
        index = segments if isinstance(segments, torch.Tensor) else to_tensor(segments, values.device)
        sums = torch.zeros((count, values.shape[1]), dtype=values.dtype, device=values.device)
        return sums.index_add(0, index.long(), values)  # On a CPU torch takes ten times as long for other integers.

    def to_numpy(self, x: torch.Tensor) -> np.ndarray:
        """The value on the host."""
        return to_host(x)

    def repeat(
        self,
        body: Callable[[Tree], Tree],
        going: Callable[[Tree], torch.Tensor],
        state: Tree,
        most: int,
    ) -> Tree:
        """See `Engine.repeat`: by a Python loop.

        Under `torch.vmap` it goes on as long as any item does, and finished items stay unchanged.
        """
        with torch.no_grad():
            return map_leaves(
                self.stop_gradient, self._repeated(body, going, map_leaves(self.stop_gradient, state), most)
            )

    @staticmethod
    def _repeated(body: Callable, going: Callable, state: Tree, most: int) -> Tree:
        for _ in range(most):
            on = going(state)
            any_on, batched = torch_internals.value_within(on, lambda whole: (whole.any(), whole.ndim > 0))
            if not bool(any_on):
                break
            new = iter(list(leaves(body(state))))
            state = map_leaves(lambda x, on=on, b=batched: torch.where(on, next(new), x) if b else next(new), state)  # noqa: B023
        return state

    def block(self, x: Tree) -> Tree:
        """Wait for the devices that hold the tensors of `x`, and return it."""
        for device in {leaf.device for leaf in leaves(x) if isinstance(leaf, torch.Tensor)}:
            if device.type == "cuda":
                torch.cuda.synchronize(device)
        return x

    def concurrent(self) -> bool:
        """True unless a transform, compilation, inference mode or `checkpoint` is on: these are one thread's alone."""
        return (
            not transformed() and not getattr(_running, "checkpoint", False) and not torch.is_inference_mode_enabled()
        )

    def split(self, x: torch.Tensor, sizes: Sequence[int]) -> Sequence[torch.Tensor]:
        """See `Engine.split`: by `torch.split`, whose derivative is one array for all pieces."""
        return torch.split(x, list(sizes))

    def program(self, f: Callable[..., Tree], varying: Callable[[Tree], Tree], options: Mapping[str, Any]) -> Callable:
        """See `Engine.program`: traced by `torch.export`, compiled by `torch.compile`."""
        from rts_backends.torch_engine.programs import Programs

        return Programs(f, varying, options, self.constant)

    def value_and_grad(self, f: Callable) -> Callable:
        """See `Engine.value_and_grad`: by autograd on detached leaves; entries that `f` does not use get gradient 0."""

        def call(tree: Tree) -> tuple[torch.Tensor, Tree]:
            variables: list[torch.Tensor] = []

            def variable(x: torch.Tensor) -> torch.Tensor:
                variables.append(x.detach().requires_grad_(True))
                return variables[-1]

            with torch.enable_grad():  # Whatever surrounds the call.
                value = f(map_leaves(variable, tree))
            if value.requires_grad:
                gradients = torch.autograd.grad(value, variables, materialize_grads=True)
            else:
                gradients = [torch.zeros_like(v) for v in variables]
            it = iter(gradients)
            return value.detach(), map_leaves(lambda _: next(it), tree)

        return call

    def checkpoint(self, make: Callable[[], Tree], f: Callable[[Tree], Tree]) -> Any:
        """See `Engine.checkpoint`: by `torch.utils.checkpoint`; under `torch.func` transforms all arrays are kept."""
        if not torch.is_grad_enabled() or transformed():
            return f(make())

        def run() -> Tree:
            _running.checkpoint = True
            try:
                return f(make())
            finally:  # Also where torch stops it, once it has made again what was asked for.
                _running.checkpoint = False

        return torch.utils.checkpoint.checkpoint(run, use_reentrant=False)

    def jvp(self, f: Callable, primal: Tree, tangent: Tree) -> tuple[torch.Tensor, torch.Tensor]:
        """See `Engine.jvp`: by forward-mode autodiff."""
        quiet_forward_mode()
        # A third result, with `has_aux` alone, is always in torch's annotation.
        return torch.func.jvp(f, (primal,), (tangent,))  # pyright: ignore[reportReturnType]

    def gradient_of_rows(self, f: Callable[[torch.Tensor], torch.Tensor], rows: torch.Tensor) -> torch.Tensor:
        """See `Engine.gradient_of_rows`: by reverse mode, which is faster here, and safe on several threads at once."""
        if getattr(_running, "checkpoint", False):  # Where torch refuses reverse mode within.
            quiet_forward_mode()
            return super().gradient_of_rows(f, rows)
        value, pull = torch.func.vjp(f, rows)[:2]
        return pull(torch.ones_like(value))[0]

    def jacobian(self, f: Callable) -> Callable:
        """See `Engine.jacobian`: by forward-mode autodiff, all unknowns in one vectorised pass."""

        def call(vector: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
            quiet_forward_mode()
            vector = vector.detach()
            along = torch.eye(vector.numel(), dtype=vector.dtype, device=vector.device)
            # torch's annotation of axes has no None in a tuple.
            pushed = torch.func.vmap(
                lambda t: torch.func.jvp(f, (vector,), (t,)),
                out_dims=(None, 0),  # pyright: ignore[reportArgumentType]
            )
            return pushed(along)  # pyright: ignore[reportReturnType]  # Two results, as above.

        return call

    def optimizer(self, method: Any, learning_rate: Any, parameters: Tree, original: Tree = None) -> Any:
        """See `Engine.optimizer`: torch's `Adam` or `SGD`, or a `torch.optim.Optimizer`, on copies of parameters."""
        from rts_backends.torch_engine.optimizer import Optimizer

        if not isinstance(method, (str, torch.optim.Optimizer)):
            raise InputError(
                f"method is {quoted(method)}; expected one of adam, sgd, lm, or a torch.optim.Optimizer, such as "
                f"torch.optim.Adam([parameters], lr=0.01), for torch tensors"
            )
        return Optimizer(method, learning_rate, parameters, parameters if original is None else original)
