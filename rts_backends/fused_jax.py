"""The compiled splatters as jax primitives: eager, `jit`, `grad`, `jvp`, `vmap` and what is made of them.

Three primitives: the image, its pushforward and its pullback. Each of the last two is linear in the tangents or the
gradient, and the transpose of the other; their derivatives by the samples, which are second derivatives of the image,
are taken of the specification. So is everything on devices other than the CPU.

Tangents and gradients have a leading axis T, of as many as one sweep takes. Before that, `vmap` over samples gives
those operands that differ by item an axis B.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

from rts import splatting
from rts_backends import jax_host
from rts_backends.fused_kernels import Settings, Splats

Wanted = tuple[bool, bool]
"""Whether positions, and whether colours, have a tangent or want a gradient."""


def fits(positions: jax.Array, rgba: jax.Array) -> bool:
    """Whether the arrays are of the kernels' dtypes; on what device they are, a traced function cannot know."""
    return positions.dtype == rgba.dtype and positions.dtype in (np.float32, np.float64)


def splat(settings: Settings, positions: jax.Array, rgba: jax.Array, row: jax.Array) -> jax.Array:
    """The image (H, W, 4) of positions (N, 3), rgba (N, 4) and row (K, H, W)."""
    return _image(positions, rgba, row, settings=settings)[0]


def _spread(given: Sequence, wanted: Wanted) -> list:
    """Those given, in the places that are wanted, and None in the others."""
    it = iter(given)
    return [next(it) if wish else None for wish in wanted]


# ---------------------------------------------------------------------------------------------- by compiled kernels


def _host_image(samples: Sequence[np.ndarray], settings: Settings) -> list[np.ndarray]:
    return [Splats(settings, *samples).image()]


def _host_push(operands: Sequence[np.ndarray], settings: Settings, wanted: Wanted) -> list[np.ndarray]:
    positions, rgba, row, *tangents = operands
    return [Splats(settings, positions, rgba, row).jvp(*_spread(tangents, wanted))]


def _host_pull(operands: Sequence[np.ndarray], settings: Settings, wanted: Wanted) -> list[np.ndarray]:
    positions, rgba, row, gradients = operands
    used = int(row.max(initial=0)) + 1  # Under `jit` there may be many more.
    splats = Splats(settings, positions[:used], rgba[:used], row)
    found = [[x for x in splats.vjp(g, wanted) if x is not None] for g in gradients]
    return [_stacked(x) for x in zip(*found, strict=True)]


def _stacked(arrays: Sequence[np.ndarray]) -> np.ndarray:
    return arrays[0][None] if len(arrays) == 1 else np.stack(arrays)


# ------------------------------------------------------------------------------------------------ by specification


def _specified_image(samples: Sequence[jax.Array], settings: Settings) -> list[jax.Array]:
    kernel = {"single": splatting.Single, "multi": splatting.Multi, "visible": splatting.Visible}[settings.kind]
    return [kernel(settings.sigma, settings.epsilon, settings.gamma).accumulate(*samples)]


def _specified_push(operands: Sequence[jax.Array], settings: Settings, wanted: Wanted) -> list[jax.Array]:
    positions, rgba, row, *tangents = operands
    image, given = _among(settings, wanted, (positions, rgba, row))
    return [jax.vmap(jax.linearize(image, *given)[1])(*tangents)]


def _specified_pull(operands: Sequence[jax.Array], settings: Settings, wanted: Wanted) -> list[jax.Array]:
    *samples, gradients = operands
    image, given = _among(settings, wanted, samples)
    return list(jax.vmap(jax.vjp(image, *given)[1])(gradients))


def _among(settings: Settings, wanted: Wanted, samples: Sequence[jax.Array]) -> tuple[Callable, list[jax.Array]]:
    """The image as a function of the samples' wanted arrays, and these."""
    *both, row = samples

    def image(*given: jax.Array) -> jax.Array:
        replaced = (x if g is None else g for x, g in zip(both, _spread(given, wanted), strict=True))
        return _specified_image((*replaced, row), settings)[0]

    return image, [x for x, wish in zip(both, wanted, strict=True) if wish]


# -------------------------------------------------------------------------------------------------- the primitives


class _Operation:
    """One of the three as a primitive: what it is to eager arrays, to the compiler and to `vmap`.

    Args:
        name: of the primitive.
        ranks: of its operands without the axis B.
        result_rank: of its results without it.
        shapes: of the results without it, from the shapes of the operands without it and the parameters.
        host: the results for one item, by kernels.
        specified: the same by specification.
    """

    def __init__(
        self,
        name: str,
        ranks: tuple[int, ...],
        result_rank: int,
        shapes: Callable,
        host: Callable,
        specified: Callable,
    ):
        self.name, self.ranks, self.result_rank = name, ranks, result_rank
        self._shapes, self._host, self._specified = shapes, host, specified
        self.primitive = primitive = Primitive(f"rts_{name}")
        primitive.multiple_results = True
        primitive.def_impl(self._eager)
        primitive.def_abstract_eval(
            lambda *avals, **params: [ShapedArray(s, avals[0].dtype) for s in self._results(avals, params)]
        )
        mlir.register_lowering(primitive, mlir.lower_fun(self.specification, multiple_results=True))
        mlir.register_lowering(primitive, mlir.lower_fun(self._traced, multiple_results=True), platform="cpu")
        batching.primitive_batchers[primitive] = self._batched

    def __call__(self, *operands: jax.Array, **params: Any) -> list[jax.Array]:
        """The results."""
        return self.primitive.bind(*operands, **params)

    def specification(self, *operands: jax.Array, **params: Any) -> list[jax.Array]:
        """The results by specification, which is differentiable."""
        axes = tuple(0 if b else None for b in self._by_item(operands))
        function = lambda *item: self._specified(item, **params)  # noqa: E731
        return (function if not any(a == 0 for a in axes) else jax.vmap(function, axes))(*operands)

    def _by_item(self, operands: Sequence[Any]) -> list[bool]:
        """Which operands have the axis B."""
        return [x.ndim > rank for x, rank in zip(operands, self.ranks, strict=False)]

    def _results(self, operands: Sequence[Any], params: dict) -> list[tuple[int, ...]]:
        """Shapes of the results."""
        by_item = self._by_item(operands)
        lead = next(((x.shape[0],) for x, b in zip(operands, by_item, strict=True) if b), ())
        shapes = (x.shape[1:] if b else x.shape for x, b in zip(operands, by_item, strict=True))
        return [(*lead, *shape) for shape in self._shapes(*shapes, **params)]

    def _on_host(self, operands: Sequence[np.ndarray], params: dict) -> list[np.ndarray]:
        """The results, perhaps without the last rows, where those are zero."""
        by_item = self._by_item(operands)
        if not any(by_item):
            return self._host(operands, **params)
        found = [np.empty(shape, operands[0].dtype) for shape in self._results(operands, params)]
        for b in range(len(found[0])):
            item = [x[b] if by else x for x, by in zip(operands, by_item, strict=True)]
            for out, value in zip(found, self._host(item, **params), strict=True):
                jax_host.fill(out[b], value)
        return found

    def _traced(self, *operands: jax.Array, **params: Any) -> list[jax.Array]:
        """In a program for the CPU."""
        results = tuple(jax.ShapeDtypeStruct(s, operands[0].dtype) for s in self._results(operands, params))
        name = f"{self.name} {sorted(params.items())}"
        return jax_host.call_named(name, lambda *arrays: self._on_host(arrays, params), results, *operands)

    def _eager(self, *operands: Any, **params: Any) -> list[jax.Array]:
        device = _cpu_of(operands)
        if device is None:
            return _compiled(self.primitive, tuple(params.items()))(*operands)
        found = self._on_host([np.asarray(x) for x in operands], params)
        for i, shape in enumerate(self._results(operands, params)):
            if found[i].shape != shape:
                found[i], part = np.empty(shape, found[i].dtype), found[i]
                jax_host.fill(found[i], part)
        if any(x.committed for x in operands):
            return jax.device_put(found, device)
        with jax.default_device(device):
            return jax.device_put(found)

    def _batched(self, operands: Sequence[Any], dims: Sequence, **params: Any) -> tuple[list[jax.Array], list[int]]:
        mapped = [d is not None for d in dims]
        operands = [jnp.moveaxis(x, d, 0) if m else x for x, d, m in zip(operands, dims, mapped, strict=True)]
        size = next(x.shape[0] for x, m in zip(operands, mapped, strict=True) if m)
        if any(mapped[:3]):
            return self._over_samples(operands, mapped, size, params)
        # The batch is more tangents or gradients of the same samples: one sweep for all.
        folded = []
        for x, m, rank in zip(operands, mapped, self.ranks, strict=False):
            if len(folded) >= 3:
                x = x if m else jnp.broadcast_to(x, (size, *x.shape))
                at = x.ndim - 1 - rank
                x = jnp.moveaxis(x, 0, at)
                x = x.reshape(*x.shape[:at], size * x.shape[at + 1], *x.shape[at + 2 :])
            folded.append(x)
        found = self(*folded, **params)
        at = found[0].ndim - self.result_rank
        return [x.reshape(*x.shape[:at], size, -1, *x.shape[at + 1 :]) for x in found], [at] * len(found)

    def _over_samples(self, operands: list, mapped: list[bool], size: int, params: dict) -> tuple[list, list[int]]:
        """Each item with samples of its own."""
        inner = [x.shape[m] for x, m, r in zip(operands, mapped, self.ranks, strict=False) if x.ndim - m > r]
        if not inner:
            found = self(*operands, **params)
            return found, [0] * len(found)
        lead = size, inner[0]
        for i, (x, m, rank) in enumerate(zip(operands, mapped, self.ranks, strict=False)):
            if m or x.ndim > rank:
                own = x.shape[x.ndim - rank :]
                x = x[:, None] if m and x.ndim == rank + 1 else x
                operands[i] = jnp.broadcast_to(x, (*lead, *own)).reshape(size * inner[0], *own)
        found = self(*operands, **params)
        return [x.reshape(*lead, *x.shape[1:]) for x in found], [0] * len(found)


def _cpu_of(operands: Sequence[jax.Array]) -> Any:
    """The device of the arrays if it is one CPU, else None."""
    devices = set().union(*(x.devices() for x in operands))
    return next(iter(devices)) if len(devices) == 1 and all(d.platform == "cpu" for d in devices) else None


@functools.cache
def _compiled(primitive: Primitive, params: tuple) -> Callable:
    return jax.jit(functools.partial(primitive.bind, **dict(params)))


def _push_shapes(positions: tuple, rgba: tuple, row: tuple, *tangents: tuple, settings: Settings, wanted: Wanted):
    return [(tangents[0][0], *row[1:], 4)]


def _pull_shapes(positions: tuple, rgba: tuple, row: tuple, gradients: tuple, settings: Settings, wanted: Wanted):
    return [(gradients[0], *x) for x, wish in zip((positions, rgba), wanted, strict=True) if wish]


_image = _Operation("image", (2, 2, 3), 3, lambda p, c, row, settings: [(*row[1:], 4)], _host_image, _specified_image)
_push = _Operation("push", (2, 2, 3, 3, 3), 4, _push_shapes, _host_push, _specified_push)
_pull = _Operation("pull", (2, 2, 3, 4), 3, _pull_shapes, _host_pull, _specified_pull)


# --------------------------------------------------------------------------------------------------- derivatives


def _is_zero(x: Any) -> bool:
    return type(x) is ad.Zero


def _zeros(like: Sequence[jax.Array]) -> list:
    return [ad.Zero(ShapedArray(x.shape, x.dtype)) for x in like]


def _present(tangents: Sequence, wanted: Wanted = (True, True)) -> tuple[list, Wanted]:
    """Tangents that are not zeros, and of what they are."""
    places = _spread(tangents, wanted)
    given = tuple(t is not None and not _is_zero(t) for t in places)
    return [t for t, g in zip(places, given, strict=True) if g], (given[0], given[1])


def _along_samples(operation: _Operation, primals: Sequence, tangents: Sequence, params: dict) -> list | None:
    """Derivatives of an operation's results along tangents of positions and rgba, by specification; None for zeros."""
    _, moved = _present(tangents[:2])
    if not any(moved):
        return None
    fixed = [x for x, m in zip(primals[:2], moved, strict=True) if not m]

    def function(*given: jax.Array) -> list[jax.Array]:
        it, rest = iter(given), iter(fixed)
        both = [next(it) if m else next(rest) for m in moved]
        return _whole(operation.name, tuple(params.items()))(*both, *primals[2:])

    varied = [x for x, m in zip(primals[:2], moved, strict=True) if m]
    along = [t for t, m in zip(tangents[:2], moved, strict=True) if m]
    return jax.jvp(function, tuple(varied), tuple(along))[1]


@functools.cache
def _whole(name: str, params: tuple) -> Callable:
    """The specification of an operation, compiled as a whole: operation by operation, each would be compiled alone."""
    operation = {"push": _push, "pull": _pull}[name]
    return jax.jit(functools.partial(operation.specification, **dict(params)))


def _image_jvp(primals: Sequence, tangents: Sequence, *, settings: Settings) -> tuple[list, list]:
    found = _image(*primals, settings=settings)
    given, wanted = _present(tangents[:2])
    if not given:
        return found, _zeros(found)
    at = 1 if found[0].ndim > _image.result_rank else 0
    # Of operands by item, tangents have B before T; of the others T alone.
    swept = [jnp.expand_dims(t, t.ndim - 2) for t in given]
    (pushed,) = _push(*primals, *swept, settings=settings, wanted=wanted)
    return found, [jax.lax.squeeze(pushed, (at,))]


def _push_jvp(primals: Sequence, tangents: Sequence, *, settings: Settings, wanted: Wanted) -> tuple[list, list]:
    params = {"settings": settings, "wanted": wanted}
    found = _push(*primals, **params)
    along = _along_samples(_push, primals, tangents, params)
    given, moved = _present(tangents[3:], wanted)
    if given:
        linear = _push(*primals[:3], *given, settings=settings, wanted=moved)
        along = linear if along is None else [a + b for a, b in zip(along, linear, strict=True)]
    return found, _zeros(found) if along is None else along


def _pull_jvp(primals: Sequence, tangents: Sequence, *, settings: Settings, wanted: Wanted) -> tuple[list, list]:
    params = {"settings": settings, "wanted": wanted}
    found = _pull(*primals, **params)
    along = _along_samples(_pull, primals, tangents, params)
    if not _is_zero(tangents[3]):
        linear = _pull(*primals[:3], tangents[3], **params)
        along = linear if along is None else [a + b for a, b in zip(along, linear, strict=True)]
    return found, _zeros(found) if along is None else along


def _push_transpose(gradients: Sequence, *operands: Any, settings: Settings, wanted: Wanted) -> list:
    (g,), samples, tangents = gradients, operands[:3], operands[3:]
    if _is_zero(g):
        return [None] * 3 + [ad.Zero(t.aval) for t in tangents]
    found = _pull(*samples, g, settings=settings, wanted=wanted)
    return [None] * 3 + [_summed(x, t.aval.ndim) for x, t in zip(found, tangents, strict=True)]


def _pull_transpose(tangents: Sequence, *operands: Any, settings: Settings, wanted: Wanted) -> list:
    *samples, g = operands
    given, moved = _present(tangents, wanted)
    if not given:
        return [None] * 3 + [ad.Zero(g.aval)]
    (found,) = _push(*samples, *given, settings=settings, wanted=moved)
    return [None] * 3 + [_summed(found, g.aval.ndim)]


def _summed(x: jax.Array, rank: int) -> jax.Array:
    """The sum over items, for what they share."""
    return x.sum(0) if x.ndim > rank else x


ad.primitive_jvps[_image.primitive] = _image_jvp
ad.primitive_jvps[_push.primitive] = _push_jvp
ad.primitive_jvps[_pull.primitive] = _pull_jvp
ad.primitive_transposes[_push.primitive] = _push_transpose
ad.primitive_transposes[_pull.primitive] = _pull_transpose
