"""Poses of real models beside their files, which are read, interpolated and skinned anew here, with NumPy and SciPy."""

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

import rts

pytestmark = pytest.mark.files

COLUMNS, TYPES = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}, {5123: "<u2", 5126: "<f4"}


class File:
    """The JSON of a GLB, and its accessors as arrays."""

    def __init__(self, path):
        content = path.read_bytes()
        end = 20 + int.from_bytes(content[12:16], "little")
        self.tree, self.binary = json.loads(content[20:end]), content[end + 8 :]

    def rows(self, index):
        accessor = self.tree["accessors"][index]
        view, kind = self.tree["bufferViews"][accessor["bufferView"]], np.dtype(TYPES[accessor["componentType"]])
        width, start = COLUMNS[accessor["type"]], view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
        strides = (view.get("byteStride", width * kind.itemsize), kind.itemsize)
        return np.ndarray((accessor["count"], width), kind, self.binary, start, strides).astype(float)

    def nodes(self, time):
        """All nodes as the clip has them, each with its "place" (4, 4) in the scene."""
        nodes = [dict(node) for node in self.tree["nodes"]]
        (clip,) = self.tree["animations"]
        for channel in clip["channels"]:
            sampler, target = clip["samplers"][channel["sampler"]], channel["target"]
            times, values = self.rows(sampler["input"])[:, 0], self.rows(sampler["output"])
            at, columns = np.clip(time, times[0], times[-1]), values.reshape(len(times), -1).T
            value = [np.interp(at, times, column) for column in columns]
            if target["path"] == "rotation":
                value = Slerp(times, Rotation.from_quat(values))(at).as_quat()
            nodes[target["node"]][target["path"]] = np.array(value)

        def place(node, above):
            own = np.eye(4)
            own[:3, :3] = Rotation.from_quat(node.get("rotation", (0, 0, 0, 1))).as_matrix() * node.get("scale", 1)
            own[:3, 3] = node.get("translation", (0, 0, 0))
            node["place"] = above @ (np.reshape(node["matrix"], (4, 4)).T if "matrix" in node else own)
            for child in node.get("children", ()):
                place(nodes[child], node["place"])

        for root in self.tree["scenes"][self.tree.get("scene", 0)]["nodes"]:
            place(nodes[root], np.eye(4))
        return nodes

    def corners(self, time):
        """The corners (T, 3, 3) of each primitive's triangles, in the scene."""
        nodes = self.nodes(time)
        (node,) = (node for node in nodes if "mesh" in node)
        for primitive in self.tree["meshes"][node["mesh"]]["primitives"]:
            rows = {name: self.rows(accessor) for name, accessor in primitive["attributes"].items()}
            moves = [self.rows(target["POSITION"]) for target in primitive.get("targets", ())]
            points = rows["POSITION"] + sum(w * x for w, x in zip(node.get("weights", ()), moves, strict=True))
            maps = node["place"][None]
            if "skin" in node:
                skin = self.tree["skins"][node["skin"]]
                above = self.rows(skin["inverseBindMatrices"]).reshape(-1, 4, 4).swapaxes(1, 2)
                joints = np.stack([nodes[joint]["place"] for joint in skin["joints"]]) @ above
                shares = rows["WEIGHTS_0"] / rows["WEIGHTS_0"].sum(axis=1, keepdims=True)
                maps = np.einsum("vi,viab->vab", shares, joints[rows["JOINTS_0"].astype(int)])
            placed = (maps @ np.insert(points, 3, 1, axis=1)[..., None])[:, :3, 0]
            yield placed[self.rows(primitive["indices"]).astype(int).reshape(-1, 3)]


@pytest.mark.filterwarnings("ignore:.*do not sum to 1")
@pytest.mark.parametrize("name", ["CesiumMan", "BrainStem", "RiggedSimple", "AnimatedMorphCube"])
def test_a_real_model_is_posed_as_its_file_says(data, name):
    model, file = (load(data / "gltf" / f"{name}.glb") for load in (rts.load_model, File))
    time = 0.37 * model.clips[0].duration  # Between two key frames.
    expected, at_first = (list(file.corners(t)) for t in (time, 0.0))
    size = np.ptp(np.concatenate(expected).reshape(-1, 3), axis=0).max()
    assert max(np.abs(a - b).max() for a, b in zip(expected, at_first, strict=True)) > 0.01 * size
    for part, corners in zip(model.posed(model.pose(0, time)), expected, strict=True):
        posed, place = part.surface.posed(part.theta), np.eye(4) if part.transform is None else part.transform
        found = (posed @ place[:3, :3].T + place[:3, 3])[part.surface.mesh.faces]
        np.testing.assert_allclose(found, corners, atol=1e-4 * size, rtol=0)
