"""Scalar fields of space, negative inside, and the base class of surfaces of fields."""

from __future__ import annotations

import abc
import inspect
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from rts import Engine, GBuffer, InputError, RtsError, Surface, engine_of, namespace
from rts.errors import EngineError
from rts.plugin_api.arrays import Array, Tree, exemplar, leaves, shape_of, unit
from rts.plugin_api.checks import check_numbers, quoted
from rts.plugin_api.operations import gradient
from rts.plugin_api.records import Samples
from rts_surfaces.parameter_checks import RESERVED

LARGEST = 1e38
"""The largest absolute value of an isovalue, near the limit of single precision."""

FEWEST = 1024
"""The least number of points for a function that compiles for each shape; larger ones are powers of two."""

Function = Callable[[Mapping[str, Tree], Array], Array]
"""A function of θ and points (M, 3), with one value (M,) or some values (M, C) a point."""

SIDES = {"below": 1.0, "above": -1.0}
"""The sides of the isovalue that may be the inside, and the sign that makes the values there negative."""


class ScalarField(abc.ABC):
    """A scalar field as surfaces use it: a number at every point of space, negative inside.

    Attributes:
        name: its name in errors.
    """

    name: str

    @abc.abstractmethod
    def names(self, theta: Mapping[str, Tree]) -> tuple[str, ...]:
        """The names of the entries of θ that are read."""

    @abc.abstractmethod
    def check(self, theta: Mapping[str, Tree]) -> None:
        """Refuse θ that lacks an entry that is read."""

    @abc.abstractmethod
    def level(self, theta: Mapping[str, Tree], points: Array) -> Array:
        """The field minus the isovalue, with the sign that makes it negative inside; zero counts as outside.

        Args:
            theta: θ.
            points: (M, 3) float, of θ's engine.

        Returns:
            (M,), in the dtype of the points.
        """

    @abc.abstractmethod
    def slope(self, theta: Mapping[str, Tree], points: Array) -> Array:
        """The gradient (M, 3) of `level` at points (M, 3), towards the outside."""

    @abc.abstractmethod
    def in_theta_dtype(self, theta: Mapping[str, Tree], points: Array) -> Array:
        """The points in the dtype of the entries of θ that are read, float32 at least."""


class Field(ScalarField):
    """A scalar function of space that θ parametrizes; its surface is where it has one value.

    Args:
        f: (θ, points (M, 3)) → (M,), in array code; points and results are in θ's dtype, float32 at least. It may work
            with one engine only, such as a network of torch by `torch.func.functional_call`.
        isovalue: the value on the surface.
        inside: which values are inside, "below" the isovalue or "above" it.
        reads: the names of the entries of θ that `f` reads; None for all.

    Raises:
        InputError: wrong arguments.
    """

    def __init__(self, f: Function, isovalue: float = 0.0, inside: str = "below", reads: Sequence[str] | None = None):
        check_function("f", f)
        value = check_isovalue(isovalue)
        if not isinstance(inside, str) or inside not in SIDES:
            raise InputError(f"inside is {quoted(inside)}; expected 'below' or 'above'")
        if reads is not None and not (isinstance(reads, (list, tuple)) and all(isinstance(n, str) for n in reads)):
            raise InputError(f"reads is {quoted(reads)}; expected names of entries of theta, or None for all")
        self.f, self.isovalue, self.inside, self.sign = f, value, inside, SIDES[inside]
        self.name = getattr(f, "__name__", type(f).__name__)
        self._reads = None if reads is None else tuple(reads)
        # Functions of jax.numpy, for one, give arrays of jax for points of NumPy.
        self._compiles = False

    def __repr__(self) -> str:
        return f"Field({self.name}, {self.isovalue:g}, {self.inside!r})"

    def names(self, theta: Mapping[str, Tree]) -> tuple[str, ...]:
        """The names of the entries of θ that `f` reads."""
        return tuple(theta) if self._reads is None else self._reads

    def check(self, theta: Mapping[str, Tree]) -> None:
        """Refuse θ that lacks an entry which `f` reads. The result of `f` is checked when it is called."""
        for name in self.names(theta):
            if name not in theta:
                raise InputError(f"theta has no {name!r}, which {self.name} reads; it has {sorted(theta)}")

    def level(self, theta: Mapping[str, Tree], points: Array) -> Array:
        """See `ScalarField`.

        Raises:
            InputError: `f` fails, or its result has another shape, dtype or engine. Only in NumPy a float32 result is
                accepted for float64 points.
        """
        try:
            value = self._value(theta, points)
        except KeyError as error:
            raise InputError(f"{self.name} finds no {error}; theta has {sorted(theta)}") from error
        except (AttributeError, TypeError, ValueError, IndexError, RuntimeError) as error:
            if isinstance(error, RtsError):
                raise
            raise InputError(self._why(error, engine_of(points))) from error
        compiles = self._compiles or (type(points) is np.ndarray and not isinstance(value, np.ndarray))
        if not engine_of(points).differentiates and getattr(value, "dtype", None) == np.float32:
            value = np.asarray(value, points.dtype)  # Differences for slopes are taken in float64.
        check_result("f", value, points)
        self._compiles = compiles
        return self.sign * (value - self.isovalue)

    def _value(self, theta: Mapping[str, Tree], points: Array) -> Array:
        """The values (M,) of `f`, which gets points of few shapes where it compiles for each."""
        count = points.shape[0]
        if not (self._compiles and type(points) is np.ndarray and count):
            return self.f(theta, points)
        more = max(FEWEST, 1 << (count - 1).bit_length()) - count
        value = self.f(theta, np.concatenate([points, np.repeat(points[:1], more, axis=0)]))
        return np.asarray(value)[:count] if shape_of(value) == (count + more,) else value

    def _why(self, error: Exception, engine: Engine) -> str:
        """The message for an error of `f`."""
        text = " ".join(str(error).split())[:120] or type(error).__name__
        if isinstance(error, (AttributeError, TypeError)) and not engine.differentiates:
            return (
                f"{self.name} cannot work with arrays of NumPy ({text}); it gets these where theta has no others: put "
                f"the weights that it reads into theta"
            )
        return (
            f"{self.name} fails on points (M, 3) of {engine.name} ({text}); write it in array code, with the functions "
            f"of rts.namespace(points) alone"
        )

    def slope(self, theta: Mapping[str, Tree], points: Array) -> Array:
        """The gradient (M, 3) of `level` at points (M, 3), towards the outside; see `gradient`."""
        return gradient(partial(self.level, theta), points)

    def in_theta_dtype(self, theta: Mapping[str, Tree], points: Array) -> Array:
        """The points in the widest floating dtype among the entries that `f` reads, float32 at least.

        Unchanged if `f` reads no floating entry.
        """
        xp, bits = namespace(points), 0
        for x in leaves({name: theta[name] for name in self.names(theta)}):
            if hasattr(x, "dtype") and namespace(x).isdtype(x.dtype, "real floating"):
                bits = max(bits, namespace(x).finfo(x.dtype).bits)
        if not bits:
            return points
        return xp.astype(points, xp.float64 if bits == 64 else xp.float32, copy=False)


class Implicit(Surface):
    """Base class of surfaces of a field: the entries of θ that they read, and their G-buffer.

    Args:
        field: the field.
        attributes: name → g(θ, positions (N, 3)) → (N, C): further entries of the G-buffer, such as "color". They are
            computed if the shader reads them. They may read any entry of θ.

    Raises:
        InputError: an attribute has no function, or its name is reserved, such as "normal".
    """

    def __init__(self, field: ScalarField, attributes: Mapping[str, Function] | None = None):
        if attributes is not None and not isinstance(attributes, Mapping):
            raise InputError(f"attributes is {quoted(attributes)}; expected a dict of name → function")
        for name, g in (attributes or {}).items():
            if not isinstance(name, str) or name in RESERVED:
                raise InputError(f"attributes declares {name!r}, which is no further attribute; expected another name")
            check_function(f"attributes[{name!r}]", g)
        self.field, self.attributes = field, dict(attributes or {})

    def reads(self, theta: Mapping[str, Tree]) -> tuple[str, ...]:
        """The entries that the field reads; all entries if there are attributes."""
        return tuple(theta) if self.attributes else self.field.names(theta)

    def check(self, theta: Mapping[str, Tree]) -> None:
        """Refuse θ that lacks an entry which the field reads."""
        self.field.check(theta)

    def at_hits(self, theta: Mapping[str, Tree], samples: Samples) -> GBuffer:
        """The G-buffer where rays met the field, at x₀ − (f(x₀) − f₀) w, with x₀, w and f₀ the parameters of samples.

        f is the level of the field. Rows of zeros, which only pad, have the result of the first row.

        Args:
            theta: θ.
            samples: samples with the parameters (N, 7) of `rts_surfaces.implicit.casting.moving`: x₀, w and f₀.
        """
        params = self.field.in_theta_dtype(theta, samples.params)
        xp = namespace(params)
        # Rows that only pad would lie at the origin, where many functions have no derivative: they copy the first row.
        used = xp.any(params != 0, axis=1, keepdims=True)
        params = xp.where(used, params, xp.where(used[:1], params[:1], xp.ones_like(params[:1])))
        points, along = params[:, :3], params[:, 3:6]
        change = self.field.level(theta, points) - params[:, 6]
        return self.gbuffer(theta, points - change[:, None] * along)

    def normal(self, theta: Mapping[str, Tree], position: Array) -> Array:
        """Normals (N, 3) of unit length, outwards, at positions on the surface; zero where the field has no slope."""
        return unit(self.field.slope(theta, position))

    def gbuffer(self, theta: Mapping[str, Tree], position: Array) -> GBuffer:
        """The G-buffer of positions (N, 3) on the surface: with unit normals, outwards, and attributes, made when read.

        All are differentiable in θ and in the positions. A normal is zero where the field has no slope.
        """
        entries = GBuffer(position=position)
        entries.defer("normal", lambda: self.normal(theta, position))
        for name, g in self.attributes.items():
            entries.defer(name, partial(_attribute, name, g, theta, position))
        return entries


def check_isovalue(isovalue: Any) -> float:
    """The isovalue as a float.

    Raises:
        InputError: it is no number, beyond ±`LARGEST`, or a torch or jax array, whose derivative would be lost.
    """
    value = known_number("isovalue", check_numbers("isovalue", isovalue, ()))
    if exemplar(isovalue) is not None:
        raise InputError(
            f"isovalue is an array of {engine_of(isovalue).name}; expected a number, which has no derivative. Where it "
            f"is to have one, put it into theta, and subtract it from the values, or in f; else take float(isovalue)"
        )
    if abs(value) > LARGEST:
        raise InputError(f"isovalue is {value:g}; expected a number of single precision")
    return value


def known_number(name: str, value: np.ndarray | None) -> float:
    """The float of a number that `check_numbers` has returned; an InputError for None, which is a traced number."""
    if value is None:
        raise InputError(f"{name} is traced; expected a known number: surfaces do not change with theta")
    return float(value)


def check_function(name: str, f: Any) -> None:
    """Refuse anything but a function of θ and points; classes are refused, callable objects are not.

    Compiled functions, whose arguments are unknown, pass.
    """
    if not callable(f) or isinstance(f, type):
        raise InputError(f"{name} is {quoted(f)}; expected a function of theta and points (M, 3)")
    try:
        signature = inspect.signature(f)
    except (TypeError, ValueError):  # Of compiled code nothing is known.
        return
    try:
        signature.bind(None, None)
    except TypeError as error:
        raise InputError(
            f"{name} is {quoted(f)} of {signature} ({error}); expected a function of two arguments, theta and points "
            f"(M, 3)"
        ) from None


def check_result(name: str, value: Any, points: Array, columns: bool = False) -> None:
    """Refuse a result for points (M, 3) that is not (M,), or (M, C) with `columns`, in the points' engine and dtype."""
    engine, count = engine_of(points), points.shape[0]
    expected = f"({count}, C)" if columns else f"({count},)"
    try:
        owned = hasattr(value, "dtype") and engine_of(value) is engine
    except EngineError:
        owned = False
    if not owned:
        what = "None" if value is None else f"a {type(value).__name__}"
        raise InputError(f"{name} gave {what} for points of {engine.name}; expected its array {expected}")
    shape = shape_of(value)
    if len(shape) != 1 + columns or shape[0] != count:
        raise InputError(f"{name} gave shape {shape} for {count} points; expected {expected}")
    if value.dtype != points.dtype:
        raise InputError(f"{name} gave {value.dtype} for points of {points.dtype}; expected {points.dtype}")


def _attribute(name: str, g: Function, theta: Mapping[str, Tree], position: Array) -> Array:
    value = g(theta, position)
    check_result(f"attributes[{name!r}]", value, position, columns=True)
    return value
