"""Where the links of a robot are: a differentiable function of the values of its joints, for arrays of any engine."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

import rts
from rts.plugin_api.arrays import Array, constants, engine_of, exemplar, from_numbers, shape_of

TURNING, SLIDING = ("revolute", "continuous"), ("prismatic",)


class Joint(NamedTuple):
    """A joint between two links.

    Attributes:
        name: its name.
        kind: "revolute", "continuous", "prismatic" or "fixed".
        parent: the number of the link that it is on.
        child: the number of the link that it moves.
        origin: (4, 4) frame of the joint in the parent's.
        axis: (3,) unit vector, frame of the joint.
        source: the number, among the values that a caller gives, of the joint that moves it; -1 if none does.
        multiplier: its own value is this times that of `source`, plus `offset`: 1 and 0 but for joints that mimic.
        offset: radians or metres.
        limits: least and largest value, radians or metres; infinite without.
    """

    name: str
    kind: str
    parent: int
    child: int
    origin: np.ndarray
    axis: np.ndarray
    source: int = -1
    multiplier: float = 1.0
    offset: float = 0.0
    limits: tuple[float, float] = (-np.inf, np.inf)


class Kinematics:
    """The tree of joints and links.

    Args:
        links: names; the first is the base, and each is listed after its parent.
        joints: one for each link but the base, in the order of their children.
        names: the joints whose values a caller gives, in order.
    """

    def __init__(self, links: Sequence[str], joints: Sequence[Joint], names: Sequence[str]):
        self.links, self.joints, self.names = tuple(links), tuple(joints), tuple(names)
        pieces = [_pieces(joint) for joint in joints]
        # The matrix of a joint of value q is fixed + s · first + c · second: sin q and cos q if it turns, q and 0 else.
        self._fixed, self._first, self._second = (np.stack(x) for x in zip(*pieces, strict=True))
        self._turns = np.array([joint.kind in TURNING for joint in joints])
        self._sources = np.array([max(joint.source, 0) for joint in joints])
        moves = np.array([joint.source >= 0 for joint in joints])
        self._multipliers = np.array([joint.multiplier for joint in joints]) * moves
        self._offsets = np.array([joint.offset for joint in joints])

    def values(self, values: Any) -> Array:
        """The values (J,) of all joints that a caller gives, from such an array, a list, or a dict by name.

        Raises:
            rts.InputError: a name that is unknown or missing, or another number of values.
        """
        if isinstance(values, Mapping):
            unknown = [name for name in values if name not in self.names]
            missing = [name for name in self.names if name not in values]
            if unknown or missing:
                problem = f"unknown: {', '.join(map(str, unknown))}" if unknown else f"missing: {', '.join(missing)}"
                raise rts.InputError(
                    f"values of joints are {problem}; expected one for each of {', '.join(self.names)}"
                )
            numbers = [values[name] for name in self.names]
            like = exemplar(numbers)
            if like is None:
                values = np.array(numbers, np.float64)
            else:
                numbers = constants([np.asarray(x) if np.isscalar(x) else x for x in numbers], engine_of(like), like)
                values = rts.namespace(like).stack([x.reshape(()) for x in numbers])
        values = from_numbers(values, "values")
        if shape_of(values) != (len(self.names),):
            raise rts.InputError(
                f"values of joints have shape {shape_of(values)}; expected ({len(self.names)},), in the order "
                f"{', '.join(self.names)}"
            )
        return values

    def transforms(self, values: Any) -> list[Array]:
        """The matrix (4, 4) of each link, base-from-link; differentiable in the values.

        Args:
            values: (J,) radians and metres, in the order of `names`; or a dict by name.

        Raises:
            rts.InputError: see `values`.
        """
        q = self.values(values)
        xp, engine = rts.namespace(q), rts.engine_of(q)
        fixed, first, second, turns, multipliers, offsets = (
            engine.constant(x, q)
            for x in (self._fixed, self._first, self._second, self._turns * 1.0, self._multipliers, self._offsets)
        )
        q = xp.take(q, engine.constant(self._sources, q), axis=0) * multipliers + offsets
        s, c = turns * xp.sin(q) + (1 - turns) * q, turns * xp.cos(q)
        local = fixed + s[:, None, None] * first + c[:, None, None] * second
        placed: list[Array] = [engine.constant(np.eye(4), q)]
        for number, joint in enumerate(self.joints):
            placed.append(placed[joint.parent] @ local[number, ...])
        return placed


def _pieces(joint: Joint) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The constant matrices (4, 4) of a joint: fixed, and those that sin q (or q) and cos q multiply."""
    one, first, second = np.eye(4), np.zeros((4, 4)), np.zeros((4, 4))
    if joint.kind in SLIDING:
        first[:3, 3] = joint.axis
    elif joint.kind in TURNING:  # Rodrigues: 1 + sin q K + (1 − cos q) K².
        x, y, z = joint.axis
        first[:3, :3] = cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        second[:3, :3] = -cross @ cross
        one = one - second
    return joint.origin @ one, joint.origin @ first, joint.origin @ second
