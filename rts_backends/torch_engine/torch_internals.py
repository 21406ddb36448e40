"""Private names of torch, where it has no public ones, and substitutes for a torch without them.

With the substitutes, the engine works as if a transform were always active: more slowly, through public names alone.
Values inside of `torch.func` transforms are then unknown.
"""

from __future__ import annotations

import contextlib

from torch import Tensor
from torch.autograd import forward_ad

try:
    from torch._C import _are_functorch_transforms_active as transforms_active
    from torch._C import _DisableFuncTorch as untransformed
    from torch._C._functorch import get_unwrapped, is_legacy_batchedtensor, maybe_current_level, unwrap_if_dead
    from torch._C._functorch import is_functorch_wrapped_tensor as is_wrapped
except ImportError:
    untransformed = contextlib.nullcontext

    def transforms_active() -> bool:
        """True, so that `applied` calls torch's public `apply`."""
        return True

    def maybe_current_level() -> int | None:
        """0, as if some transform were active."""
        return 0

    def is_wrapped(tensor: Tensor) -> bool:
        """False, as if no transform had wrapped the tensor."""
        return False

    def is_legacy_batchedtensor(tensor: Tensor) -> bool:
        """False, as if the tensor were no batch of gradients."""
        return False

    def get_unwrapped(tensor: Tensor) -> Tensor:
        """`tensor` itself."""
        return tensor

    unwrap_if_dead = get_unwrapped


is_zero = getattr(Tensor, "_is_zerotensor", lambda x: False)
"""True for a tensor of zeros without memory, as torch's forward mode makes."""


def forward_level() -> int:
    """The level of forward mode, negative where it is off; 0 from a torch that does not tell."""
    return getattr(forward_ad, "_current_level", 0)
