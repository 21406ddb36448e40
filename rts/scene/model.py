"""Models that move: parts, the nodes that carry them, skins, and clips."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from rts.arrays.argument_checks import check_numbers, quoted
from rts.arrays.array_functions import described, from_numbers, shape_of
from rts.arrays.engines import engine_of
from rts.arrays.trees import Array
from rts.errors import InputError
from rts.scene.camera import Camera
from rts.scene.clips import Clip, node_matrix
from rts.scene.parts import Part


class Node(NamedTuple):
    """A place in a model, which moves all places below it.

    Attributes:
        name: its name; "" where the file gives none.
        parent: the index of the node above; −1 for none.
        transform: (4, 4) float64 parent-from-node, at rest.
        translation: (3,), at rest, as all that follow.
        rotation: (4,), a quaternion x, y, z, w.
        scale: (3,).
        morph_weights: (M,) of the morph targets of its mesh, or None.
    """

    name: str
    parent: int
    transform: np.ndarray
    translation: np.ndarray
    rotation: np.ndarray
    scale: np.ndarray
    morph_weights: np.ndarray | None = None


class Skin(NamedTuple):
    """The nodes that bend a mesh.

    Attributes:
        name: its name; "" where the file gives none.
        joints: (J,) int, indices of nodes.
        inverse_bind_matrices: (J, 4, 4) float64, joint-from-mesh, in the pose in which the mesh was made.
    """

    name: str
    joints: np.ndarray
    inverse_bind_matrices: np.ndarray


class Binding(NamedTuple):
    """The node, and perhaps the skin, that move a part.

    Attributes:
        node: the index of the node that it belongs to.
        skin: the index of the skin that bends it; None for a part that moves with its node.
    """

    node: int
    skin: int | None


class Pose(NamedTuple):
    """Where the nodes of a model are; arrays of any engine.

    Attributes:
        transforms: (N, 4, 4) parent-from-node.
        morph_weights: for each node the weights (M,) of its morph targets, or None.
    """

    transforms: Array
    morph_weights: tuple[Array | None, ...]


@dataclass(frozen=True, eq=False)
class Model:
    """A model that moves.

    Attributes:
        parts: its parts at rest; those that joints bend or that have morph targets are of the surface `skinned`.
        bindings: what moves each part.
        nodes: its nodes.
        skins: its skins.
        clips: its clips.
        lights: θ["light"] of its directional, point and spot lights, at rest; empty if there are none.
        cameras: its cameras, at rest, in the order of their nodes.
        camera_names: the name of each: its node's, else its own, else "".
    """

    parts: tuple[Part, ...]
    bindings: tuple[Binding, ...]
    nodes: tuple[Node, ...]
    skins: tuple[Skin, ...]
    clips: tuple[Clip, ...]
    lights: dict[str, np.ndarray]
    cameras: tuple[Camera, ...]
    camera_names: tuple[str, ...] = ()

    def __repr__(self) -> str:
        kinds = zip(("part", "node", "skin", "clip"), (self.parts, self.nodes, self.skins, self.clips), strict=True)
        return f"Model({', '.join(f'{len(x)} {kind}' + 's' * (len(x) > 1) for kind, x in kinds if x)})"

    def clip(self, clip: str | int) -> Clip:
        """The clip of a name, or of an index.

        Raises:
            InputError: there is no such clip; or several have this name.
        """
        names = [c.name for c in self.clips]
        if isinstance(clip, str) and names.count(clip) == 1:
            return self.clips[names.index(clip)]
        if isinstance(clip, (int, np.integer)) and not isinstance(clip, bool) and 0 <= clip < len(names):
            return self.clips[int(clip)]
        there = ", ".join(f"{i} ({name!r})" if name else str(i) for i, name in enumerate(names[:20])) or "none"
        raise InputError(f"clip is {quoted(clip)}; expected the name of one clip of the model, or its index: {there}")

    def pose(self, clip: str | int | None = None, time: float = 0.0) -> Pose:
        """The pose at a time of a clip; before its begin that of its begin, and after its end that of its end.

        Nodes that the clip does not move are at rest.

        Args:
            clip: a name or an index; None for the model at rest.
            time: seconds.

        Returns:
            NumPy arrays, transforms in float64.

        Raises:
            InputError: there is no such clip, or the time is not finite.
        """
        seconds = check_numbers("time", time, ())
        if seconds is None:
            raise InputError("time is traced; expected a number of seconds that is known")
        moved: dict[int, dict[str, np.ndarray]] = {}
        for channel in () if clip is None else self.clip(clip).channels:
            moved.setdefault(channel.node, {})[channel.path] = channel.at(float(seconds))
        transforms = np.stack([node.transform for node in self.nodes]) if self.nodes else np.zeros((0, 4, 4))
        weights = [node.morph_weights for node in self.nodes]
        for i, values in moved.items():
            weights[i] = values.pop("weights", weights[i])
            if values:
                node = self.nodes[i]
                places = {"translation": node.translation, "rotation": node.rotation, "scale": node.scale}
                transforms[i] = node_matrix(**{**places, **values})
        return Pose(transforms, tuple(None if w is None else w.astype(np.float32) for w in weights))

    def places(self, pose: Pose) -> Array:
        """World-from-node transforms (N, 4, 4) of a pose; differentiable.

        Raises:
            InputError: the pose has another number of nodes.
        """
        local = from_numbers(pose.transforms, "transforms")
        if shape_of(local) != (len(self.nodes), 4, 4):
            raise InputError(f"pose.transforms {described(local)}; expected {(len(self.nodes), 4, 4)}")
        engine = engine_of(local)
        xp = engine.namespace
        done, order = [], []
        for nodes, parents in self._levels:
            level = xp.take(local, engine.constant(nodes, local), axis=0)
            if done:
                level = engine.product(xp.take(done[-1], engine.constant(parents, local), axis=0), level)
            done.append(level)
            order.append(nodes)
        if not done:
            return local
        return xp.take(xp.concat(done), engine.constant(np.argsort(np.concatenate(order)), local), axis=0)

    def posed(self, pose: Pose) -> list[Part]:
        """The parts in a pose, differentiable in its arrays.

        θ["joint_transforms"] and θ["morph_weights"] of parts of the surface `skinned` are those of the pose; parts
        without joints have their node's place as transform, which clips may make singular to hide them: leave such
        parts out. θ stays in float32 where the pose is in NumPy.

        Args:
            pose: as `pose` gives it, perhaps with arrays of another engine in place of its own.

        Raises:
            InputError: the pose has another number of nodes, or of morph weights.
        """
        if not isinstance(pose, Pose) or not isinstance(pose.morph_weights, (list, tuple)):
            raise InputError(f"pose is {quoted(pose)}; expected a Pose, such as model.pose(clip, time) gives")
        if len(pose.morph_weights) != len(self.nodes):
            raise InputError(
                f"pose.morph_weights has {len(pose.morph_weights)} entries; expected {len(self.nodes)}, one a node"
            )
        places = self.places(pose)
        engine = engine_of(places)
        joints = {i: self._joint_transforms(places, i) for i in {b.skin for b in self.bindings if b.skin is not None}}
        parts = []
        for part, (node, skin) in zip(self.parts, self.bindings, strict=True):
            theta = dict(part.theta)
            if skin is not None:
                theta["joint_transforms"] = joints[skin]
            if "morph_vertices" in theta:
                weights, count = pose.morph_weights[node], shape_of(theta["morph_vertices"])[0]
                if not hasattr(weights, "shape") or shape_of(weights) != (count,):
                    raise InputError(f"pose.morph_weights[{node}] is {quoted(weights)}; expected an array ({count},)")
                theta["morph_weights"] = weights
            place = None if skin is not None else places[node, :, :]
            if engine.name == "numpy" and place is not None and np.array_equal(place, np.eye(4)):
                place = None
            parts.append(part.replace(theta=theta, transform=place))
        return parts

    def _joint_transforms(self, places: Array, skin: int) -> Array:
        """The maps (J, 4, 4) of a skin's joints from the mesh at rest into the world."""
        engine, (_, joints, inverse) = engine_of(places), self.skins[skin]
        xp = engine.namespace
        maps = engine.product(
            xp.take(places, engine.constant(joints, places), axis=0), engine.constant(inverse, places)
        )
        return maps.astype(np.float32) if engine.name == "numpy" else maps

    @cached_property
    def _levels(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Nodes with 0, 1, … nodes above, each level with its nodes' parents: places in the level before."""
        levels: list[tuple[np.ndarray, np.ndarray]] = []
        children: dict[int, list[int]] = {}
        for i, node in enumerate(self.nodes):
            children.setdefault(node.parent, []).append(i)
        above: Sequence[int] = [-1]
        while below := [(child, place) for place, node in enumerate(above) for child in children.get(node, ())]:
            nodes, places = np.array(below).T
            levels.append((nodes, places))
            above = nodes.tolist()
        return levels
