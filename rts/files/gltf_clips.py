"""Animations of GLB and glTF files."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from rts.files.damaged_files import warn
from rts.files.gltf_accessors import Accessor, read_table
from rts.files.gltf_tree import Gltf, count_of
from rts.scene.clips import INTERPOLATIONS, PATHS, Channel, Clip
from rts.scene.model import Node


def read_clips(gltf: Gltf, accessors: list[Accessor], nodes: Sequence[Node]) -> list[Clip]:
    """All animations.

    Refused are key frames that are not in order, or are fewer or more than values; nodes that are not there; and
    channels that move a property twice. Channels without a node, or of a property that is not known, are left out;
    the latter with a warning.
    """

    def read_clip(index: int, animation: dict[str, Any]) -> Clip:
        name = f"animation {index}"
        channels = []
        for i, channel in enumerate(animation["channels"]):
            target = channel["target"]
            if "node" in target and target["path"] in (*PATHS, "weights"):
                channels.append(_channel(gltf, f"channel {i} of {name}", animation, channel, accessors, nodes))
            elif target["path"] not in (*PATHS, "weights"):
                warn(f"{gltf.path}: {name} moves {str(target['path'])[:40]}, which is not read")
        moved = [(channel.node, channel.path) for channel in channels]
        if len(set(moved)) < len(moved):
            node, path = next(x for x in moved if moved.count(x) > 1)
            raise gltf.fail(f"{name} has two channels for {path} of node {node}; expected one")
        return Clip(str(animation.get("name", "")), tuple(channels))

    return gltf.each("animations", read_clip)


def _channel(
    gltf: Gltf,
    name: str,
    animation: dict[str, Any],
    channel: dict[str, Any],
    accessors: list[Accessor],
    nodes: Sequence[Node],
) -> Channel:
    node, path = count_of(channel["target"]["node"]), channel["target"]["path"]
    if node >= len(nodes):
        raise gltf.fail(f"{name} moves node {node}, and there are {len(nodes)}")
    sampler = animation["samplers"][count_of(channel["sampler"])]
    interpolation = sampler.get("interpolation", "LINEAR")
    if interpolation not in INTERPOLATIONS:
        raise gltf.fail(f"{name} has the interpolation {interpolation!r}; expected {', '.join(INTERPOLATIONS)}")
    if path != "weights" and "matrix" in gltf.tree["nodes"][node]:
        raise gltf.fail(
            f"{name} moves the {path} of node {node}, which has a matrix; expected translation, rotation, …"
        )
    times = read_table(gltf, f"the input of {name}", "input", sampler["input"], accessors)[:, 0].astype(np.float64)
    rows = read_table(gltf, f"the output of {name}", path, sampler["output"], accessors).astype(np.float64)
    if not len(times) or (np.diff(times) <= 0).any():
        raise gltf.fail(f"{name} has {len(times)} key frames that are not in order; expected times that increase")
    weights = nodes[node].morph_weights
    width = PATHS.get(path, 0 if weights is None else len(weights))
    tangents = 3 if interpolation == "CUBICSPLINE" else 1
    if not width or rows.size != len(times) * tangents * width:
        raise gltf.fail(
            f"{name} has {rows.size} numbers for {len(times)} key frames; expected {tangents * width} for each"
        )
    values = rows.reshape(len(times), *((3, width) if tangents == 3 else (width,)))
    if path == "rotation" and (np.linalg.norm(values[:, 1] if tangents == 3 else values, axis=1) < 1e-6).any():
        raise gltf.fail(f"{name} has a rotation of length 0; expected quaternions of length 1")
    return Channel(node, path, times, values, interpolation)
