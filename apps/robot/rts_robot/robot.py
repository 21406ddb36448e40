"""A robot: links with meshes, and joints between them, read from a URDF."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import trimesh
import yourdfpy

import rts
from rts.plugin_api.arrays import Array
from rts_robot.kinematics import SLIDING, TURNING, Joint, Kinematics

GREY = (0.6, 0.6, 0.62)
"""Colour of a mesh that has none, as sRGB encodes it."""


class LinkMesh(NamedTuple):
    """The visual meshes of a link as one.

    Attributes:
        link: the number of the link.
        vertices: (V, 3) float32, frame of the link, metres.
        faces: (T, 3) int32.
        colors: (V, 3) float32, linear.
        silhouette: vertices (V', 3) and faces (T, 3) of which no two vertices are at one place. Silhouettes need no
            more, and take a fourth of the time.
    """

    link: int
    vertices: np.ndarray
    faces: np.ndarray
    colors: np.ndarray
    silhouette: tuple[np.ndarray, np.ndarray]


class Robot(Kinematics):
    """A robot: see `load_urdf`.

    Attributes:
        links: names; the first is the base.
        names: the joints whose values a caller gives: all that move, but those that mimic others.
        meshes: those of the links that have any.
    """

    def __init__(self, links: list[str], joints: list[Joint], names: list[str], meshes: list[LinkMesh]):
        super().__init__(links, joints, names)
        self.meshes = meshes
        self._surfaces = [rts.Mesh(mesh.faces) for mesh in meshes]
        self._silhouettes = [rts.Mesh(mesh.silhouette[1]) for mesh in meshes]
        begins = np.cumsum([0, *(len(mesh.silhouette[0]) for mesh in meshes)])
        faces = [mesh.silhouette[1] + begin for mesh, begin in zip(meshes, begins, strict=False)]
        self._whole = rts.Mesh(np.concatenate(faces))

    def parts(self, values: Any, shader: Any = "silhouette") -> list[rts.Part]:
        """A part for each link that has meshes, in the frame of the base; differentiable in the values.

        Args:
            values: (J,) radians and metres, in the order of `names`; or a dict by name. Torch or jax arrays make the
                transforms of parts such arrays.
            shader: of all parts. θ has `vertices`, and but for "silhouette" `colors`.

        Raises:
            rts.InputError: a joint that is unknown or missing, or another number of values.
        """
        placed: list[Array] = self.transforms(values)
        plain, parts = shader == "silhouette", []
        for mesh, surface in zip(self.meshes, self._silhouettes if plain else self._surfaces, strict=True):
            theta = {"vertices": mesh.silhouette[0]} if plain else {"vertices": mesh.vertices, "colors": mesh.colors}
            parts.append(rts.Part(surface, theta, shader, transform=placed[mesh.link]))
        return parts

    def silhouette(self, values: Any) -> rts.Part:
        """The robot as one part with the shader "silhouette", which takes less time than a part for each link.

        Args:
            values: as in `parts`.

        Raises:
            rts.InputError: as in `parts`.
        """
        placed, moved = self.transforms(values), []
        engine = rts.engine_of(placed[0])
        for mesh in self.meshes:
            vertices, matrix = engine.constant(mesh.silhouette[0], placed[0]), placed[mesh.link]
            moved.append(vertices @ matrix[:3, :3].T + matrix[:3, 3])
        return rts.Part(self._whole, {"vertices": engine.namespace.concat(moved)}, "silhouette")


def load_urdf(path: Any, packages: Any = None) -> Robot:
    """Read a robot from a URDF, by yourdfpy: visual meshes, boxes, cylinders, spheres, and joints.

    A file `package://NAME/…` is looked for in `packages`, and otherwise beside the URDF and in all folders above it,
    with NAME and without. Which formats of meshes are read depends on trimesh: `.dae` (by pycollada), `.stl`, `.obj`.

    Args:
        path: the file.
        packages: folder in which the folder NAME is; None to look as said above.

    Raises:
        rts.InputError: there is no such file, it is no URDF, a mesh is missing or cannot be read, a joint is of a kind
            that is not known, or no link has a visual mesh.
    """
    path = Path(path)
    if not path.is_file():
        raise rts.InputError(f"there is no file {path}; expected a robot's URDF")
    files = _Files(path, None if packages is None else Path(packages))
    logger = logging.getLogger("yourdfpy")
    before, logger.level = logger.level, logging.CRITICAL  # Errors are raised here, in one line.
    try:
        with np.errstate(invalid="ignore"):  # An axis of length zero is refused below.
            read = yourdfpy.URDF.load(str(path), filename_handler=files.found)
    except rts.InputError:
        raise
    except Exception as error:
        said = " ".join(f"{type(error).__name__}: {error}".split())
        raise rts.InputError(f"{path} cannot be read as a URDF ({said:.160})") from error
    finally:
        logger.level = before
    links, joints, names = _tree(path, read)
    meshes = _meshes(read, links)
    if not meshes:
        raise rts.InputError(f"no link of {path} has a visual mesh; expected a URDF with <visual> elements")
    return Robot(links, joints, names, meshes)


class _Files:
    """Names of files in a URDF as paths."""

    def __init__(self, urdf: Path, packages: Path | None):
        self.urdf, self.packages = urdf, packages

    def found(self, fname: str) -> str:
        """The path of an existing file.

        Raises:
            rts.InputError: there is none.
        """
        scheme, _, rest = fname.rpartition("://")
        if scheme in ("", "file"):
            tried = [self.urdf.parent / rest, Path(rest)]
        elif self.packages is not None:
            tried = [self.packages / rest]
        else:
            _, _, inside = rest.partition("/")
            tried = [folder / name for folder in self.urdf.resolve().parents for name in (rest, inside)]
        for path in tried:
            if path.is_file():
                return str(path)
        where = self.packages or f"{self.urdf.parent} and the folders above it"
        raise rts.InputError(
            f"{self.urdf} names the mesh {fname}, which is not in {where}; give the folder that holds the package "
            f"(packages=, or --packages)"
        )


def _tree(path: Path, read: yourdfpy.URDF) -> tuple[list[str], list[Joint], list[str]]:
    """Names of links from the base on, the joints in the order of the links that they move, and names of values."""
    robot: Any = read.robot
    names = [j.name for j in robot.joints if j.type in TURNING + SLIDING and j.mimic is None]
    links, joints = [str(read.base_link)], []
    left = list(robot.joints)
    while left:
        ready = [joint for joint in left if joint.parent in links]
        if not ready:
            raise rts.InputError(
                f"{path}: the joint {left[0].name} is not connected to the base {links[0]}; expected one tree of links"
            )
        for joint in ready:
            if joint.type not in (*TURNING, *SLIDING, "fixed"):
                raise rts.InputError(
                    f"{path}: the joint {joint.name} is {joint.type}; expected revolute, continuous, prismatic or fixed"
                )
            joints.append(_joint(path, joint, links, names))
            links.append(joint.child)
            left.remove(joint)
    return links, joints, names


def _joint(path: Path, joint: Any, links: list[str], names: list[str]) -> Joint:
    origin = np.eye(4) if joint.origin is None else np.asarray(joint.origin, np.float64)
    axis = np.array([1.0, 0, 0]) if joint.axis is None else np.asarray(joint.axis, np.float64)
    place = links.index(joint.parent), len(links)
    if joint.type == "fixed":
        return Joint(joint.name, "fixed", *place, origin, axis)
    if not np.linalg.norm(axis) > 0:
        raise rts.InputError(f"{path}: the axis of the joint {joint.name} is zero; expected a direction")
    axis = axis / np.linalg.norm(axis)
    mimic = joint.mimic
    if mimic is not None and mimic.joint not in names:
        raise rts.InputError(
            f"{path}: the joint {joint.name} mimics {mimic.joint}, which is no joint that moves by itself"
        )
    limit = joint.limit
    ends = (
        [end if end is not None else side * np.inf for end, side in ((limit.lower, -1), (limit.upper, 1))]
        if limit
        else None
    )
    limits = (-np.inf, np.inf) if ends is None or joint.type == "continuous" else (ends[0], ends[1])
    if mimic is None:
        return Joint(joint.name, joint.type, *place, origin, axis, names.index(joint.name), limits=limits)
    factor = 1.0 if mimic.multiplier is None else mimic.multiplier
    return Joint(
        joint.name, joint.type, *place, origin, axis, names.index(mimic.joint), factor, mimic.offset or 0.0, limits
    )


def _meshes(read: yourdfpy.URDF, links: list[str]) -> list[LinkMesh]:
    """The visual meshes of each link as one, in the frame of the link."""
    scene: Any = read.scene
    painted = {link.name: _paint(read, link) for link in read.robot.links}
    by_link: dict[int, list[tuple[np.ndarray, np.ndarray, np.ndarray]]] = {}
    for node in scene.graph.nodes_geometry:
        link = scene.graph.transforms.parents[node]
        matrix, name = scene.graph.get(node, link)
        mesh = scene.geometry[name]
        if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0:
            continue
        vertices = trimesh.transform_points(mesh.vertices, matrix)
        by_link.setdefault(links.index(link), []).append((vertices, mesh.faces, _colors(mesh, painted[link])))
    meshes = []
    for link, pieces in sorted(by_link.items()):
        vertices, faces, colors = zip(*pieces, strict=True)
        starts = np.cumsum([0, *map(len, vertices[:-1])])
        joined = np.concatenate([f + start for f, start in zip(faces, starts, strict=True)])
        positions = np.asarray(np.concatenate(vertices), np.float32)
        meshes.append(
            LinkMesh(link, positions, np.asarray(joined, np.int32), np.concatenate(colors), _welded(positions, joined))
        )
    return meshes


def _welded(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    mesh.merge_vertices(merge_norm=True, merge_tex=True)
    return np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces, np.int32)


def _paint(read: Any, link: Any) -> tuple[float, ...]:
    """The colour that a URDF gives to the meshes of a link that have none of their own: its first, else grey."""
    by_name = {material.name: material for material in read.robot.materials}
    for visual in link.visuals:
        for material in (visual.material, by_name.get(getattr(visual.material, "name", None))):
            if material is not None and material.color is not None:
                return tuple(material.color.rgba[:3])
    return GREY


def _colors(mesh: Any, paint: tuple[float, ...]) -> np.ndarray:
    """Colours (V, 3) of vertices, linear; `paint` where the mesh has none."""
    try:
        encoded = np.asarray(mesh.visual.to_color().vertex_colors, np.float64)[..., :3] / 255
    except Exception:  # A texture whose picture is missing, say: trimesh has no kind of error for it.
        encoded = np.zeros(0)
    if not mesh.visual.defined or encoded.shape not in ((3,), (len(mesh.vertices), 3)):
        encoded = np.array(paint)
    linear = np.where(encoded > 0.04045, ((encoded + 0.055) / 1.055) ** 2.4, encoded / 12.92)
    return np.array(np.broadcast_to(linear, (len(mesh.vertices), 3)), np.float32)
