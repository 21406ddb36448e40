"""The choice between two branches of a compiled program, one choice for all items of a batch.

Under `vmap`, `jax.lax.cond` with a predicate for each item runs both branches, and for gradients each on zeros where it
was not chosen: which are no cameras to sample by. So the predicates of a batch become one, which holds if all do.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax.extend.core import Primitive
from jax.interpreters import batching, mlir


def choose(which: jax.Array, usual: Callable[[], jax.Array], rare: Callable[[], jax.Array]) -> jax.Array:
    """The result of `usual()` if `which` () bool is true, for all items of a batch, else that of `rare()`.

    Intermediate arrays of a branch that the gradient needs are results of both, zeros where the other runs: large ones
    of `rare` would cost `usual` more than it saves. So `rare` keeps none, and runs again for the gradient.
    """
    return jax.lax.cond(_for_all.bind(jax.lax.stop_gradient(which)), usual, jax.checkpoint(rare))


_for_all = Primitive("rts_for_all_items")
_for_all.def_impl(lambda which: which)
_for_all.def_abstract_eval(lambda which: which)
mlir.register_lowering(_for_all, mlir.lower_fun(lambda which: which, multiple_results=False))


def _batched(operands: Sequence[Any], dims: Sequence[int]) -> tuple[Any, None]:
    return _for_all.bind(jnp.all(operands[0], axis=dims[0])), None


batching.primitive_batchers[_for_all] = _batched
