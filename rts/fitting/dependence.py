"""Checks for functions that do not depend on their parameters, and directions left undetermined, in words."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from rts.arrays.array_functions import kind_of
from rts.arrays.engine_base import Engine
from rts.arrays.engines import engine_of, is_constant
from rts.arrays.trees import Array, Tree, leaves, placed_leaves
from rts.errors import EngineError, InputError
from rts.fitting.parameter_names import names_in_words

UNSEEN = 0.02
"""Numbers below this share of a direction's largest are left out of its description."""
SHORT = 4
"""The most numbers of an array that is described as a vector."""

NO_WAY = "no derivative leads from the one to the other"


def differentiable(parameters: Tree, purpose: str = "") -> Engine:
    """The engine of parameters that have derivatives.

    Args:
        parameters: a user's parameters.
        purpose: text for the end of an error.

    Raises:
        InputError: an entry is no torch or jax array of floats; there is no number; dicts have keys of several kinds.
        EngineError: arrays of two engines.
    """
    try:
        arrays = list(leaves(parameters))
    except TypeError:  # Keys of several kinds have no order.
        raise InputError("parameters has keys that cannot be sorted; expected names") from None
    for x in arrays:
        try:
            engine_of(x)
        except EngineError:
            raise InputError(f"parameters holds {kind_of(x)}; expected torch or jax arrays{purpose}") from None
    if not arrays:
        raise InputError(f"parameters holds nothing; expected torch or jax arrays{purpose}")
    for place, x in placed_leaves(parameters):
        if is_constant(x):
            name = "".join(f"[{key!r}]" for key in place)
            hint = "such as torch.tensor(x) of it"
            raise InputError(f"parameters{name} is {kind_of(x)}; expected torch or jax arrays{purpose}, {hint}")
    engine = engine_of(parameters)
    for x in arrays:
        if not engine.namespace.isdtype(x.dtype, "real floating"):
            raise InputError(f"parameters holds an array of dtype {x.dtype}; expected a floating one{purpose}")
    if all(0 in x.shape for x in arrays):
        raise InputError(f"parameters holds no number, only empty arrays; expected at least one{purpose}")
    return engine


def refuse_independent(residuals: Callable, loss: Callable | None, parameters: Tree, engine: Engine) -> None:
    """Refuse a function whose results no derivative connects to the parameters. Called for a gradient of zero.

    A result is connected if the engine differentiates it: in torch it then has a graph, in jax it is traced. A gradient
    may be zero though everything is connected, for example if nothing is in view. Nothing is refused if the engine
    marks no array, so that independence cannot be seen.

    Args:
        residuals: parameters → array.
        loss: residuals → array (); None for one that depends on them.
        parameters: where to try; at least one number in arrays of the engine.
        engine: the engine of the parameters.

    Raises:
        InputError: the residuals do not depend on the parameters, or the loss not on the residuals.
    """
    marks: dict[str, bool] = {}

    def probe(p: Tree) -> Array:
        parameter = next(x for x in leaves(p) if 0 not in x.shape)
        marks["parameters"] = _marked(parameter, engine)
        values = residuals(p)
        marks["residuals"] = _marked(values, engine)
        marks["loss"] = loss is None or _marked(loss(values), engine)
        return engine.namespace.sum(parameter)

    engine.value_and_grad(probe)(parameters)
    if not marks["parameters"]:
        return  # The engine marks nothing, so that independence cannot be detected.
    for what, of in (("residuals", "parameters"), ("loss", "residuals")):
        if not marks[what]:
            raise InputError(
                f"{what} {'do' if what == 'residuals' else 'does'} not depend on the {of}: {NO_WAY}; compute with "
                f"the {of} that the function is given, without detach, no_grad, stop_gradient, rounding or NumPy"
            )


def _marked(x: Array, engine: Engine) -> bool:
    return bool(getattr(x, "requires_grad", False)) or engine.traced(x)


def directions_in_words(basis: np.ndarray, units: np.ndarray, names: Sequence[str], shapes: Sequence[tuple]) -> str:
    """Directions of the parameters, described by names and numbers.

    Args:
        basis: (U, k), linearly independent columns that span the directions, in numbers of the parameters.
        units: (U,), positive factors that make changes of different arrays comparable.
        names: the names of the arrays of the parameters, in order.
        shapes: the shapes of these arrays.

    Returns:
        Text such as "light.direction along (0.32, 0.53, 0.78), gain": three entries, and the number of the others.
        An array of which every number is undetermined goes by its name alone.
    """
    from scipy.linalg import qr

    columns = basis * units[:, None]
    # As many zeros as possible: one entry of each direction is 1, and 0 in the other directions.
    pivots: Any = qr(columns.T, mode="economic", pivoting=True)[-1]
    pivots = pivots[: columns.shape[1]]
    columns = columns @ np.linalg.inv(columns[pivots])
    columns[np.abs(columns) < UNSEEN * np.abs(columns).max(axis=0)] = 0
    columns = columns / units[:, None]
    columns /= np.linalg.norm(columns, axis=0)
    starts = np.cumsum([0, *(int(np.prod(s)) for s in shapes)])
    whole, entries = [], []
    single = (columns != 0).sum(axis=0) == 1
    alone = (columns[:, single] != 0).any(axis=1)
    for name, first, stop in zip(names, starts, starts[1:], strict=False):
        if alone[first:stop].all() and stop > first:
            whole.append((first, name))
            alone[first:stop] = False
    entries += whole
    for column in columns.T[[not s or bool(alone[c != 0].any()) for s, c in zip(single, columns.T, strict=True)]]:
        column = column * np.sign(column[np.argmax(np.abs(column))])
        terms = []
        for name, shape, first, stop in zip(names, shapes, starts, starts[1:], strict=False):
            terms += _terms(name, shape, column[first:stop])
        entries.append(
            (int(np.flatnonzero(column)[0]), " with ".join([*terms[:3], *(["others"] if terms[3:] else [])]))
        )
    return names_in_words([text for _, text in sorted(entries)])


def _terms(name: str, shape: tuple, part: np.ndarray) -> list[str]:
    """Words for the entries of a direction in one array, or none if all entries are zero.

    Args:
        name: the array's name.
        shape: its shape.
        part: (n,), its entries of a direction of length 1.

    Returns:
        One text, such as "light[2]" or "light along (0.32, 0.53, 0.78)". Of more than 4 entries, one text for each
        that is not zero, the largest first.
    """
    used = np.flatnonzero(part)
    if not len(used):
        return []
    alone = np.abs(part).max() > 1 - 1e-9
    if len(used) == 1:
        place = ", ".join(map(str, np.unravel_index(used[0], shape)))
        entry = f"{name}[{place}]" if shape else name
        return [entry if alone else f"{entry} ({_number(part[used[0]])})"]
    if part.size <= SHORT:
        return [f"{name} along ({', '.join(map(_number, part))})"]
    largest = sorted(used, key=lambda i: -abs(part[i]))
    return [_terms(name, shape, np.where(np.arange(part.size) == i, part, 0))[0] for i in largest]


def _number(x: Any) -> str:
    return f"{x:.2g}" if abs(x) < 0.01 and x else f"{x:.2f}"
