"""Cameras of a robot from masks and joint values, by `apps/robot`: errors, time, and whether intervals hold the truth.

The robot is the Panda of the package example-robot-data (Franka Emika, Apache 2.0), of 135,000 faces. Masks are made by
Embree: 5 × 5 rays a pixel, averaged (area), or inside from one half on (thresholded). Then 2 % of the pixels, at
random, are turned into their opposite, and with blotches disks on the outline are wrong all over. A scene has a random
camera 1.7 to 2.2 m away, 5 random poses of the robot, and no start is given.

    python -m benchmarks.robots                          # errors and time at 480 x 640; some minutes
    python -m benchmarks.robots --coverage 60            # intervals, at 240 x 320, two draws a scene; ten minutes
    python -m benchmarks.robots --whole 100 --kinds area # intervals by whole fits at 480 x 640; half an hour
    python -m benchmarks.robots --offsets                # joints that are off

Fits of `--coverage` take Newton steps with the Jacobian of the true camera, rendered once: errors are far below a
pixel, so that it changes little. Those of `--whole` are the application's, from starts some centimetres off.
"""

from __future__ import annotations

import argparse
import sysconfig
import time
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from rts_robot import Calibration, Robot, calibrate, load_urdf
from rts_robot.uncertainty import covariance_of
from scipy.ndimage import uniform_filter
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

import rts
from benchmarks.meshes import DATA
from benchmarks.report import table

PANDA = "example-robot-data/robots/panda_description/urdf/panda.urdf"
PLACES = (Path(sysconfig.get_paths()["purelib"]) / "cmeel.prefix/share", DATA)
"""Where the package is: as pip installs it, or unpacked."""
FULL, SMALL, VIEWS, DRAWS = (480, 640), (240, 320), 5, 2
"""Sizes of pictures, views of a scene, and draws of wrong pixels for a scene of intervals."""
WRONG = 0.02
"""Share of wrong pixels."""
OPENCV = np.diag([1.0, -1, -1, 1])
NORMAL = 1.6449
"""A standard normal number is within this in 90 % of cases."""


def panda() -> Robot:
    """The robot, if its package is there."""
    for place in PLACES:
        if (place / PANDA).is_file():
            return load_urdf(place / PANDA)
    raise SystemExit(f"no {PANDA} in {' or '.join(map(str, PLACES))}; pip install --no-deps example-robot-data")


def scene(robot: Robot, size: tuple[int, int], rng: np.random.Generator) -> tuple[rts.Camera, np.ndarray]:
    """A camera, and the values (VIEWS, J) of joints: between a fifth and four fifths of their range, the hand up."""
    low, high = np.array([joint.limits for joint in robot.joints if joint.name in robot.names]).T
    values, hand = [], robot.links.index("panda_hand")
    while len(values) < VIEWS:
        q = low + (high - low) * rng.uniform(0.2, 0.8, len(low))
        if robot.transforms(q)[hand][2, 3] > 0.1:
            values.append(q)
    around, above, distance = rng.uniform(0, 2 * np.pi), rng.uniform(0.1, 0.8), rng.uniform(1.7, 2.2)
    way = np.array([np.cos(around) * np.cos(above), np.sin(around) * np.cos(above), np.sin(above)])
    target, up = (0, 0, 0.45) + 0.05 * rng.normal(size=3), (0, 0, 1) + 0.1 * rng.normal(size=3)
    eye = (0, 0, 0.4) + distance * way
    return rts.Camera.look_at(eye, target, up, fov_y=45, aspect=size[1] / size[0]), np.array(values)


def mask_of(robot: Robot, q: np.ndarray, camera: rts.Camera, size: tuple[int, int], rays: int) -> np.ndarray:
    """The share (H, W) of each pixel's rays x rays rays that meet the robot."""
    placed = robot.transforms(q)
    links = [
        trimesh.Trimesh(v @ placed[mesh.link][:3, :3].T + placed[mesh.link][:3, 3], f, process=False)
        for mesh in robot.meshes
        for v, f in [mesh.silhouette]
    ]
    whole: Any = trimesh.util.concatenate(links)
    fine = size[0] * rays, size[1] * rays
    seen = camera.project(np.float64(whole.vertices), fine)[:, :2]
    left, top = np.maximum(np.floor(seen.min(axis=0)).astype(int) - 1, 0)
    right, bottom = np.minimum(np.ceil(seen.max(axis=0)).astype(int) + 1, fine[::-1])
    y, x = np.mgrid[top:bottom, left:right]
    cast = camera.rays(fine, np.stack([x.ravel(), y.ravel()], axis=-1) + 0.5)
    caster = trimesh.ray.ray_pyembree.RayMeshIntersector(whole)
    image = np.zeros(fine)
    hits = caster.intersects_any(np.asarray(cast.origins), np.asarray(cast.directions))
    image[top:bottom, left:right] = hits.reshape(y.shape)
    return image.reshape(size[0], rays, size[1], rays).mean(axis=(1, 3))


def spoilt(mask: np.ndarray, rng: np.random.Generator, blotches: int) -> np.ndarray:
    """The mask with wrong pixels, and with disks on its outline that are all inside or all outside."""
    mask, inside = mask.copy(), mask > 0.5
    wrong = rng.random(mask.shape) < WRONG
    mask[wrong] = 1 - mask[wrong]
    edge = np.argwhere(inside & (uniform_filter(inside * 1.0, 3) < 0.99))
    y, x = np.mgrid[: mask.shape[0], : mask.shape[1]]
    for _ in range(blotches):
        row, column = edge[rng.integers(len(edge))] + rng.normal(size=2) * 0.01 * mask.shape[1]
        radius = rng.uniform(0.005, 0.015) * mask.shape[1]
        mask[(y - row) ** 2 + (x - column) ** 2 < radius**2] = rng.random() < 0.5
    return mask


def errors(found: Calibration, camera: rts.Camera) -> np.ndarray:
    """The rotation vector (3,), radians, and the shift (3,), metres, from the found camera to the true one."""
    true = np.linalg.inv(camera.view) @ OPENCV
    turn = Rotation.from_matrix(true[:3, :3] @ found.camera_to_base[:3, :3].T).as_rotvec()
    return np.concatenate([turn, true[:3, 3] - found.camera_to_base[:3, 3]])


KINDS = {"area": (False, 0), "area, 6 blotches a view": (False, 6), "thresholded": (True, 0)}
"""Kinds of masks: whether they are thresholded, and the number of blotches."""


def calibrated(robot: Robot, camera: rts.Camera, values: np.ndarray, masks: np.ndarray, **options: Any) -> Calibration:
    """A calibration with the true intrinsics."""
    return calibrate(robot, masks, values, camera.to_opencv(masks.shape[1:])[0], progress=False, **options)


def accuracy(robot: Robot, seeds: int, chosen: list[str]) -> None:
    """Print errors and times at full size."""
    rows = []
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        camera, values = scene(robot, FULL, rng)
        area = np.array([mask_of(robot, q, camera, FULL, 5) for q in values])
        for kind in chosen:
            hard, blotches = KINDS[kind]
            masks = np.array([spoilt((m > 0.5) * 1.0 if hard else m, rng, blotches) for m in area])
            begun = time.perf_counter(), time.process_time()
            found = calibrated(robot, camera, values, masks)
            wall, cpu = time.perf_counter() - begun[0], time.process_time() - begun[1]
            off = errors(found, camera)
            cells = 1e3 * np.linalg.norm(off[3:]), np.degrees(np.linalg.norm(off[:3]))
            rows.append([str(seed), kind, *(f"{x:.3f}" for x in cells), f"{cpu:.1f}", f"{wall:.1f}"])
            print(rows[-1], flush=True)
    print(table(["scene", "masks", "mm", "degrees", "CPU s", "wall s"], rows))


def coverage(robot: Robot, scenes: int, chosen: list[str], kept: Path) -> None:
    """Print how often intervals of 90 % hold the truth, at half the size. Images are kept in a folder."""
    scores: dict[str, list[np.ndarray]] = {kind: [] for kind in chosen}
    kept.mkdir(parents=True, exist_ok=True)
    for seed in range(scenes):
        if not (kept / f"{seed}.npz").is_file():
            _keep(robot, seed, kept / f"{seed}.npz")
        with np.load(kept / f"{seed}.npz") as file:
            area, images, slopes = (np.float64(file[name]) for name in ("area", "render", "J"))
        for draw in range(DRAWS):
            rng = np.random.default_rng((seed, draw))
            for kind in chosen:
                hard, blotches = KINDS[kind]
                masks = np.array([spoilt((m > 0.5) * 1.0 if hard else m, rng, blotches) for m in area])
                scores[kind].append(_scored(*_newton(images - masks, slopes)))
        if seed % 20 == 19 or seed == scenes - 1:
            print(table(COVERAGE, [_covered(kind, np.array(rows)) for kind, rows in scores.items()]), flush=True)


def whole(robot: Robot, scenes: int, chosen: list[str], kept: Path) -> None:
    """Print how often intervals of whole fits at full size hold the truth, a fit a scene. A folder keeps results."""
    kept.mkdir(parents=True, exist_ok=True)
    for kind in chosen:
        rows = []
        for seed in range(scenes):
            path = kept / f"{kind} {seed}.npz"
            if not path.is_file():
                _keep_fit(robot, kind, seed, path)
            with np.load(path) as file:
                rows.append(_scored(file["off"], file["covariance"]))
        print(table(COVERAGE, [_covered(kind, np.array(rows))]), flush=True)


def _keep_fit(robot: Robot, kind: str, seed: int, path: Path) -> None:
    """Keep the error and the covariance of a fit, from a start that is off by 1 cm and 0.6 degrees along each axis."""
    camera, values = scene(robot, FULL, np.random.default_rng(seed))
    (hard, blotches), rng = KINDS[kind], np.random.default_rng((seed, list(KINDS).index(kind)))
    area = [mask_of(robot, q, camera, FULL, 5) for q in values]
    masks = np.array([spoilt((m > 0.5) * 1.0 if hard else m, rng, blotches) for m in area])
    start = np.linalg.inv(camera.view) @ OPENCV
    start[:3, :3] = Rotation.from_rotvec(rng.normal(0, 0.01, 3)).as_matrix() @ start[:3, :3]
    start[:3, 3] += rng.normal(0, 0.01, 3)
    found = calibrated(robot, camera, values, masks, start=start)
    np.savez(path, off=errors(found, camera), covariance=found.covariance)


def _scored(off: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """(13,): errors in standard deviations, the square of all together, and errors."""
    together = off @ np.linalg.solve(covariance, off)
    return np.concatenate([off / np.sqrt(np.diag(covariance)), [together], off])


def _keep(robot: Robot, seed: int, path: Path) -> None:
    """Keep the masks of a scene, images (B, H, W) and their Jacobian (B, 6, H, W) by a small motion of the base."""
    import torch

    camera, values = scene(robot, SMALL, np.random.default_rng(seed))
    area = np.array([mask_of(robot, q, camera, SMALL, 5) for q in values])
    origin, images, slopes = torch.zeros(6), [], []
    for q in values:

        def image(pose: Any, parts: list[rts.Part] = robot.parts(q)) -> Any:  # noqa: B008
            return rts.render(parts, camera.within(rts.rigid(pose, MIDDLE)), SMALL, layers=1)[..., 3]

        value, rows = rts.engine_of(origin).jacobian(image)(origin)
        images.append(value.numpy())
        slopes.append(rows.numpy())
    np.savez_compressed(path, area=np.float32(area), render=np.stack(images), J=np.stack(slopes))


def _newton(start: np.ndarray, slopes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The error (6,) of a fit, and its covariance by the application, the images being linear in the parameters.

    Args:
        start: (B, H, W) residuals of the true camera.
        slopes: (B, 6, H, W) their Jacobian.
    """
    import torch

    loss, step, p = rts.Loss("cauchy", 0.5), 1e-4, np.zeros(6)
    views, y, x = np.nonzero(np.abs(slopes).sum(axis=1))
    rows, base = slopes[views, :, y, x], start[views, y, x]

    def slope(r: np.ndarray) -> np.ndarray:
        return loss.weights(r)[0] * r

    for _ in range(6):
        r = base + rows @ p
        curved = (slope(r + step) - slope(r - step)) / (2 * step)
        p = p - np.linalg.solve((rows * curved[:, None]).T @ rows, rows.T @ slope(r))
    images, jacobian = torch.as_tensor(start), torch.as_tensor(slopes)

    def residuals(pose: Any, number: int) -> Any:
        return images[number] + torch.einsum("uhw,u->hw", jacobian[number], pose)

    return p, covariance_of(residuals, torch.as_tensor(p), len(start), loss, ["pose"] * 6)


MIDDLE = np.array([0, 0, 0.4])
COVERAGE = ["masks", "runs", "turn x, y, z", "shift x, y, z", "all six numbers", "all at once", "mm", "degrees"]


def _covered(kind: str, rows: np.ndarray) -> list[str]:
    single = (np.abs(rows[:, :6]) < NORMAL).mean(axis=0)
    each = [" ".join(f"{x:.0%}" for x in part) for part in (single[:3], single[3:])]
    mm, degrees = (np.sqrt((rows[:, part] ** 2).sum(axis=1).mean()) for part in (slice(10, 13), slice(7, 10)))
    joint = (rows[:, 6] < chi2.ppf(0.9, 6)).mean()
    sizes = f"{1e3 * mm:.3f}", f"{np.degrees(degrees):.4f}"
    return [kind, str(len(rows)), *each, f"{single.mean():.1%}", f"{joint:.0%}", *sizes]


def offsets(robot: Robot, seeds: int) -> None:
    """Print offsets of joints as they are and as they are found, with the camera unknown, too."""
    names, rows = ["panda_joint2", "panda_joint4", "panda_joint6"], []
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        camera, values = scene(robot, FULL, rng)
        masks = np.array([spoilt(mask_of(robot, q, camera, FULL, 5), rng, 0) for q in values])
        wrong = rng.normal(0, np.radians(1), len(names))
        told = values - wrong @ np.array([[name == other for other in robot.names] for name in names])
        begun = time.process_time()
        found, plain = (calibrated(robot, camera, told, masks, offsets=chosen) for chosen in (names, []))
        cpu = time.process_time() - begun
        for name, true in zip(names, np.degrees(wrong), strict=True):
            numbers = np.degrees([found.offsets[name], found.offset_deviations[name]])
            rows.append([str(seed), name, f"{true:.3f}", f"{numbers[0]:.3f}", f"{numbers[1]:.3f}"])
        cells = [f"{1e3 * np.linalg.norm(errors(fit, camera)[3:]):.2f}" for fit in (found, plain)]
        print(f"scene {seed}: camera {cells[0]} mm off, {cells[1]} without offsets; {cpu:.0f} CPU s for both")
    print(table(["scene", "joint", "offset, degrees", "found", "standard deviation"], rows))


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--coverage", type=int, default=0, help="scenes of the measurement of intervals")
    parser.add_argument("--whole", type=int, default=0, help="scenes of the same by whole fits")
    parser.add_argument("--kept", type=Path, default=Path("out/robots"), help="folder for what these two keep")
    parser.add_argument("--offsets", action="store_true", help="joints that are off")
    parser.add_argument("--seeds", type=int, default=3, help="scenes at full size")
    parser.add_argument("--kinds", nargs="*", choices=list(KINDS), default=list(KINDS), help="of masks")
    options = parser.parse_args()
    robot = panda()
    if options.coverage:
        coverage(robot, options.coverage, options.kinds, options.kept)
    elif options.whole:
        whole(robot, options.whole, options.kinds, options.kept)
    elif options.offsets:
        offsets(robot, options.seeds)
    else:
        accuracy(robot, options.seeds, options.kinds)


if __name__ == "__main__":
    main()
