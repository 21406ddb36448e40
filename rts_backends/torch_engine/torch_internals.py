"""Private names of torch that capabilities need, since it has no public ones, and substitutes for a torch without them.

- `current_level` tells whether a `torch.func` transform is active. Threads and `checkpoint` are for code outside of
  transforms, and so are packed rows without padding.
- `value_within` reads values inside of transforms.
- `is_legacy_batchedtensor` finds the batches of `torch.autograd.grad(..., is_grads_batched=True)`.
- `is_asked_for` tells which derivatives a backward pass is for. Without it, warnings of some may come where others
  alone are wanted.
- `forward_level` tells whether forward mode is on. Tangents then take the dtype of their tensors.

With the substitutes everything works, as if a transform were always active: on one thread, with all arrays kept, and
each value read takes longer.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, TypeVar

import torch
from torch import Tensor
from torch.autograd import forward_ad

_T = TypeVar("_T")

try:
    from torch._C import _DisableFuncTorch
    from torch._C._functorch import get_unwrapped, is_functorch_wrapped_tensor, is_legacy_batchedtensor
    from torch._C._functorch import maybe_current_level as current_level

    def value_within(x: Tensor, read: Callable[[Tensor], _T]) -> _T:  # pyright: ignore[reportRedeclaration]
        """`read` of the tensor that transforms have wrapped in `x`: of all items of a batch."""
        while is_functorch_wrapped_tensor(x):
            x = get_unwrapped(x)
        with _DisableFuncTorch():  # Else what is made of it would be wrapped.
            return read(x)

except ImportError:

    class _Read(torch.autograd.Function):
        """A call of a function with the tensor that transforms have wrapped, without result or derivative."""

        @staticmethod
        def forward(call: Callable[[Tensor], None], x: Tensor) -> Tensor:
            call(x)
            return torch.zeros(())

        @staticmethod
        def setup_context(ctx: Any, inputs: tuple, output: Tensor) -> None:
            ctx.mark_non_differentiable(output)

        @staticmethod
        def backward(ctx: Any, *_: Any) -> tuple[None, None]:
            return None, None

        @staticmethod
        def jvp(ctx: Any, *_: Any) -> None:
            return None

        # torch's own signature has no named arguments, though its manual has.
        @staticmethod
        def vmap(  # pyright: ignore[reportIncompatibleMethodOverride]
            info: Any, in_dims: tuple, call: Callable, x: Tensor
        ) -> tuple[Tensor, None]:
            return _Read.apply(call, x), None

    def value_within(x: Tensor, read: Callable[[Tensor], _T]) -> _T:
        """`read` of the tensor that transforms have wrapped in `x`: of all items of a batch."""
        found: list[_T] = []
        _Read.apply(lambda value: found.append(read(value)), x)
        return found[0]

    def current_level() -> int | None:
        """0, as if some transform were active."""
        return 0

    def is_legacy_batchedtensor(tensor: Tensor) -> bool:
        """True for a tensor without values, where no transform has wrapped it."""
        return not value_within(tensor, _is_readable)

    def _is_readable(tensor: Tensor) -> bool:
        try:
            tensor.data_ptr()
        except RuntimeError:
            return False
        return True


def is_asked_for(ctx: Any, k: int) -> bool:
    """True if this backward pass goes on to the k-th tensor of a `Function`; also where torch does not tell."""
    node = ctx.next_functions[k][0]
    try:
        return node is not None and torch._C._will_engine_execute_node(node)
    except (AttributeError, RuntimeError):  # An older torch; or a leaf, of which torch does not tell.
        return True


forward_level = partial(getattr, forward_ad, "_current_level", 0)
"""() → the level of forward mode, negative where it is off; 0 from a torch that does not tell."""


def differentiated() -> bool:
    """True under a `torch.func` transform, or in forward mode."""
    return current_level() is not None or forward_level() >= 0
