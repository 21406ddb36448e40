"""Where the camera may be: starts for a fit, found by points of the robot's surface on coarse masks."""

from __future__ import annotations

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from rts_robot.robot import Robot

POINTS, CELLS = 2000, 64
"""Points of the surface, and cells along the longer side of a coarse mask."""
FIRST, KEPT, CHILDREN, ROUNDS = 1500, 20, 8, 10
"""Orientations tried at first; poses that are kept in each round, and poses tried beside each."""
TURN, GROWTH = 0.3, 0.06
"""Standard deviations of these in the first round: radians, and shares of the distance. The last round has a tenth."""
COVERED = 0.2
"""Least share of a cell that the mask covers where the robot is."""
APART, RIVALS = 0.4, 0.05
"""Least angle, in radians, between two starts; and how far the overlap of the second may be below that of the first."""


def find_starts(
    robot: Robot, values: np.ndarray, masks: np.ndarray, intrinsics: np.ndarray, count: int = 3, seed: int = 0
) -> list[np.ndarray]:
    """Cameras that may have taken the masks, the most likely first.

    Random orientations are tried, each at the place that brings middle and size of the points to those of the masks.
    The best are varied, with less and less change. What is compared is which coarse cells the robot covers.

    Args:
        robot: the robot.
        values: (B, J), the values of its joints in each view.
        masks: (B, H, W) in [0, 1].
        intrinsics: (3, 3), as OpenCV's.
        count: the most starts to give.
        seed: of what is random.

    Returns:
        Matrices (4, 4), camera-from-base; camera axes are OpenCV's: x right, y down, z forward.
    """
    rng = np.random.default_rng(seed)
    views = _Coarse(robot, values, masks, intrinsics, rng)
    turns = Rotation.random(FIRST, rng).as_matrix()
    poses = views.placed(turns)
    scores = views.overlaps(poses)
    for spread in np.geomspace(1, 0.1, ROUNDS):
        best = np.argsort(-scores)[:KEPT]
        parents, kept = np.repeat(poses[best], CHILDREN, axis=0), scores[best]
        children = parents.copy()
        change = Rotation.from_rotvec(rng.normal(0, TURN * spread, (len(parents), 3))).as_matrix()
        children[:, :3, :3] = change @ parents[:, :3, :3]
        distance = parents[:, 2:3, 3]
        children[:, :3, 3] += rng.normal(0, GROWTH * spread, (len(parents), 3)) * distance
        poses = np.concatenate([poses[best], children])
        scores = np.concatenate([kept, views.overlaps(children)])
    starts: list[np.ndarray] = []
    for number in np.argsort(-scores):
        turn = poses[number, :3, :3]
        others = [Rotation.from_matrix(turn @ start[:3, :3].T).magnitude() for start in starts]
        near = scores[number] > scores.max() - RIVALS
        if near and len(starts) < count and all(angle > APART for angle in others):
            starts.append(poses[number])
    return [start @ views.uncentred for start in starts]


class _Coarse:
    """Coarse masks, and points of the robot in each view about their mean."""

    def __init__(self, robot: Robot, values: np.ndarray, masks: np.ndarray, intrinsics: np.ndarray, rng):
        height, width = masks.shape[1:]
        self.cell = max(height, width) / CELLS
        self.grid = int(np.ceil(height / self.cell)), int(np.ceil(width / self.cell))
        x, y = (np.arange(width) / self.cell).astype(int), (np.arange(height) / self.cell).astype(int)
        sums = np.add.reduceat(
            np.add.reduceat(masks, np.unique(y, return_index=True)[1], 1), np.unique(x, return_index=True)[1], 2
        )
        counts = np.outer(np.bincount(y), np.bincount(x))
        self.inside = sums / counts > COVERED
        points = surface_points(robot, values, POINTS, rng)
        centre = points.mean(axis=(0, 1))
        self.points = (points - centre).astype(np.float32)
        self.uncentred = np.eye(4)
        self.uncentred[:3, 3] = -centre
        scaled = intrinsics / self.cell
        self.focal, self.middle = np.array([scaled[0, 0], scaled[1, 1]]), scaled[:2, 2] + 0.5 / self.cell
        where = [np.argwhere(mask)[:, ::-1] + 0.5 for mask in self.inside]
        self.means = np.array([w.mean(axis=0) for w in where])
        self.spread = float(np.sqrt(np.mean([((w - w.mean(axis=0)) ** 2).sum(axis=1).mean() for w in where])))

    def placed(self, turns: np.ndarray) -> np.ndarray:
        """Poses (N, 4, 4) of these orientations (N, 3, 3), the robot's points where the masks are."""
        seen = np.einsum("nij,bpj->nbpi", turns[:, :2], self.points[:, ::10])
        means = seen.mean(axis=2)
        spread = np.sqrt(((seen - means[:, :, None]) ** 2).sum(axis=-1).mean(axis=(1, 2)))
        distance = self.focal.mean() * spread / max(self.spread, 0.5)
        shift = (self.means - self.middle) / self.focal * distance[:, None, None] - means
        poses = np.tile(np.eye(4), (len(turns), 1, 1))
        poses[:, :3, :3], poses[:, :2, 3], poses[:, 2, 3] = turns, shift.mean(axis=1), distance
        return poses

    def overlaps(self, poses: np.ndarray) -> np.ndarray:
        """Mean intersection over union (N,) of the cells that points fall into and those inside the masks."""
        (rows, columns), views = self.grid, len(self.points)
        inside = self.inside.reshape(views, -1)
        every, found = inside.sum(axis=1), np.zeros(len(poses))
        first = np.repeat(rows * columns * np.arange(views, dtype=np.int32), self.points.shape[1])
        points = np.ascontiguousarray(self.points.reshape(-1, 3).T)
        to_cells = np.diag([*self.focal, 1.0])
        to_cells[:2, 2] = self.middle
        covered = np.zeros(views * rows * columns + 1, bool)  # The last one takes points outside.
        for number, pose in enumerate((to_cells @ poses[:, :3]).astype(np.float32)):
            x, y, z = pose[:, :3] @ points + pose[:, 3:]
            valid = z > 1e-6
            x, y = x / np.where(valid, z, 1), y / np.where(valid, z, 1)
            valid &= (x >= 0) & (x < columns) & (y >= 0) & (y < rows)
            with np.errstate(invalid="ignore"):  # Of points outside, which may be too far off for integers.
                cells = first + columns * y.astype(np.int32) + x.astype(np.int32)
            covered[:] = False
            covered[np.where(valid, cells, len(covered) - 1)] = True
            seen = covered[:-1].reshape(views, -1)
            both = (seen & inside).sum(axis=1)
            found[number] = np.mean(both / np.maximum(seen.sum(axis=1) + every - both, 1))
        return found


def surface_points(robot: Robot, values: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """Points (B, count, 3) of the surface in each view, in the frame of the base: the same points, moved by joints."""
    areas = [trimesh.triangles.area(mesh.vertices[mesh.faces]) for mesh in robot.meshes]
    ends = np.cumsum([len(a) for a in areas])
    every = np.concatenate(areas)
    chosen = rng.choice(len(every), count, p=every / every.sum())
    links = np.searchsorted(ends, chosen, side="right")
    weights = rng.dirichlet(np.ones(3), count)
    local = np.empty((count, 3))
    for number, mesh in enumerate(robot.meshes):
        at = links == number
        corners = mesh.vertices[mesh.faces[chosen[at] - (ends[number] - len(mesh.faces))]]
        local[at] = np.einsum("nc,ncx->nx", weights[at], corners)
    points = []
    for row in values:
        placed = np.stack([np.asarray(x) for x in robot.transforms(row)])[[mesh.link for mesh in robot.meshes]][links]
        points.append(np.einsum("nij,nj->ni", placed[:, :3, :3], local) + placed[:, :3, 3])
    return np.stack(points)
