"""Albedo, roughness, metallic and light of a bottle from 24 pictures by Mitsuba, beside a fit by `lambert`.

Mitsuba renders glTF's WaterBottle with its material `principled` in a smooth sky, 24 pictures to fit and 8 to hold out,
128², and the latter in another sky, too. The shape is known. Both fits find maps of 128² texels, and light as spherical
harmonics of order 3 (`pbr`) or 2 (`lambert`, which reads no more). PSNR is that of encoded colours inside outlines.
Pictures do not tell bright light from bright colours: maps of albedo are compared after one factor for each of red,
green and blue, and relit pictures have these factors, too.

Both are also fitted in the light of the known sky, without such factors.

Needs Mitsuba (`pip install mitsuba`), and the folder that RTS_DATA names.

    python -m benchmarks.materials.fit
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.progress import track

import rts
from benchmarks.materials.compare import model, sky
from benchmarks.materials.mitsuba_scenes import Shape, pictures
from benchmarks.report import table
from rts.shading import prefiltered
from rts_compare.environment import environment

SIZE, TEXELS, BATCH = (128, 128), 128, 4
VIEWS, HELD_OUT = 24, 8
RELIT = sky(-0.6, 0.1)
"""The other sky: brighter from the left, with a darker ground."""


def around(count: int, first: float) -> list[rts.Camera]:
    """Cameras all around, in turn above and below."""
    found = []
    for i in range(count):
        turn, up = np.radians(first + 360 * i / count), np.radians((35, -20, 10)[i % 3])
        eye = 3.2 * np.array([np.sin(turn) * np.cos(up), np.sin(up), np.cos(turn) * np.cos(up)])
        found.append(rts.Camera.look_at(eye, (0, 0, 0), fov_y=37))
    return found


def encoded(image: Any) -> Any:
    """Colours in steps that look alike: the square root, by which no derivative is infinite."""
    return (image.clip(0, None) + 1e-3) ** 0.5


def psnr(found: np.ndarray, truth: np.ndarray) -> float:
    """The PSNR of encoded colours (…, 4), where both pictures are covered."""
    inside = (found[..., 3] > 0.999) & (truth[..., 3] > 0.999)
    off = [x[..., :3][inside].clip(0, 1) ** (1 / 2.2) for x in (found, truth)]
    return float(-10 * np.log10(((off[0] - off[1]) ** 2).mean()))


def start(shader: str, light_known: bool) -> dict[str, torch.Tensor]:
    """Parameters of a fit, as logits of maps, and light unless it is known."""
    maps = {"texture": 3, "roughness": 1, "metallic": 1} if shader == "pbr" else {"texture": 3}
    found = {name: torch.zeros(TEXELS, TEXELS, channels) for name, channels in maps.items()}
    if shader == "pbr":
        found["metallic"] -= 1.0
    if not light_known:
        found["sh"] = torch.zeros(16 if shader == "pbr" else 9, 3)
        found["sh"][0] = 2.0
    return found


@cache
def known_sky() -> dict[str, torch.Tensor]:
    """The sky of the pictures, blurred once."""
    return prefiltered(torch.tensor(sky()))


def theta_of(parameters: dict[str, torch.Tensor], shape: Shape) -> dict[str, Any]:
    """θ of the part that parameters describe."""
    maps = {name: torch.sigmoid(x) for name, x in parameters.items() if name != "sh"}
    known = {"vertices": shape.vertices, "normals": shape.normals, "uv": shape.uv}
    return {**known, **maps, "light": {"sh": parameters["sh"]} if "sh" in parameters else {"environment": known_sky()}}


def smoothness(parameters: dict[str, torch.Tensor]) -> torch.Tensor:
    """The mean size of differences of neighbours in maps, which fills texels that no picture shows."""
    total = torch.zeros(())
    for name, x in parameters.items():
        if name != "sh":
            weight = 1.0 if name == "texture" else 4.0  # Few pixels tell them.
            total = total + weight * ((x[1:] - x[:-1]).abs().mean() + (x[:, 1:] - x[:, :-1]).abs().mean())
    return total


def fitted(
    shader: str, shape: Shape, views: list[tuple[rts.Camera, np.ndarray]], steps: int, light_known: bool
) -> dict[str, Any]:
    """θ of a fit of a shader to views."""
    parameters = {name: x.requires_grad_() for name, x in start(shader, light_known).items()}
    part = rts.Part(rts.Mesh(shape.faces), {}, rts.plugin("shaders", shader)(mip=True))
    rates = [{"params": [x], "lr": 0.02 if name == "sh" else 0.05} for name, x in parameters.items()]
    optimizer, random = torch.optim.Adam(rates), np.random.default_rng(0)
    decay = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps, 1e-3)
    targets, frozen = [torch.tensor(picture) for _, picture in views], {}
    for _ in track(range(steps), description=shader):
        optimizer.zero_grad()
        here = part.replace(theta=theta_of(parameters, shape))
        loss = 3e-4 * smoothness(parameters)
        for i in random.choice(len(views), BATCH, replace=False):
            camera, target = views[i][0], targets[i]
            if i not in frozen:  # The shape stays, so its samples do.
                frozen[i] = rts.sample(here, camera, SIZE, splatter="none")
            image = rts.render_samples(frozen[i], here, camera, splatter="none")
            inside = (image[..., 3:].detach() > 0.999) & (target[..., 3:] > 0.999)
            loss = loss + (inside * (encoded(image[..., :3]) - encoded(target[..., :3])) ** 2).mean() / BATCH
        loss.backward()
        optimizer.step()
        decay.step()
    return theta_of({name: x.detach() for name, x in parameters.items()}, shape)


def drawn(shader: str, shape: Shape, theta: dict[str, Any], camera: rts.Camera) -> np.ndarray:
    """A picture (H, W, 4), without derivative."""
    part = rts.Part(rts.Mesh(shape.faces), theta, rts.plugin("shaders", shader)(mip=True))
    return rts.render(part, camera, SIZE, splatter="none").numpy()


def seen_texels(shape: Shape, cameras: list[rts.Camera]) -> np.ndarray:
    """(TEXELS, TEXELS) bool, true for texels that some picture shows, by the gradient of its pixels."""
    texture = torch.full((TEXELS, TEXELS, 3), 0.5, requires_grad=True)
    theta = {"vertices": shape.vertices, "normals": shape.normals, "uv": shape.uv, "texture": texture}
    part = rts.Part(rts.Mesh(shape.faces), theta, rts.plugin("shaders", "textured")(mip=False))
    sum(rts.render(part, camera, SIZE, splatter="none")[..., :3].sum() for camera in cameras).backward()
    assert texture.grad is not None
    return texture.grad.sum(dim=2).numpy() > 1.0


def averaged(image: np.ndarray) -> np.ndarray:
    """A map in `TEXELS`² texels."""
    k = image.shape[0] // TEXELS
    return image.reshape(TEXELS, k, TEXELS, k, -1).mean(axis=(1, 3))


def measured(name: str, seconds: float, theta: dict[str, Any], shape: Shape, truth: dict[str, Any]) -> dict[str, Any]:
    """Figures of a fit, with its pictures of the first held-out view, in both lights."""
    seen = truth["seen"]
    albedo, true = theta["texture"].numpy()[seen], averaged(shape.material["texture"])[seen]
    known = "environment" in theta["light"]
    factor = np.ones(3) if known else (albedo * true).sum(axis=0) / (albedo * albedo).sum(axis=0)
    held_out = [drawn(name, shape, theta, camera) for camera in truth["cameras"]]
    other = {
        **theta,
        "texture": (theta["texture"] * torch.tensor(factor, dtype=torch.float32)).clip(0, 1),
        "light": {"environment": torch.tensor(RELIT)},
    }
    relit = [drawn(name, shape, other, camera) for camera in truth["cameras"]]
    found: dict[str, Any] = {"seconds": seconds, "factor": factor.tolist()}
    for key, images in (("held_out", held_out), ("relit", relit)):
        found[f"psnr_{key}"] = float(np.mean([psnr(a, b) for a, b in zip(images, truth[key], strict=True)]))
    found["albedo"] = float(np.sqrt(((albedo * factor - true) ** 2).mean()))
    for key in ("roughness", "metallic"):
        if key in theta:
            off = theta[key].numpy()[seen] - averaged(shape.material[key])[seen]
            found[key] = float(np.sqrt((off**2).mean()))
            found[f"{key}_constant"] = float(averaged(shape.material[key])[seen].std())
    return {**found, "pictures": [held_out[0], relit[0]]}


def kept(path: Path, make: Callable[[], list[np.ndarray]]) -> list[np.ndarray]:
    """Pictures of a file, made if it is not there."""
    if not path.exists():
        np.savez(path, np.stack(make()))
    return list(np.load(path)["arr_0"])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, default=Path("out/materials"))
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--samples", type=int, default=128, help="of Mitsuba, a pixel")
    args = parser.parse_args()
    args.output.mkdir(parents=True, exist_ok=True)
    shape = model("WaterBottle", 512)
    shape = shape._replace(material={n: x for n, x in shape.material.items() if n != "normal_map"})
    cameras, held_out = around(VIEWS, 0.0), around(HELD_OUT, 7.5)
    targets, first, other = (
        kept(args.output / f"{name}.npz", lambda c=c, s=s: pictures([shape], s, c, SIZE, args.samples))
        for name, c, s in (("fit", cameras, sky()), ("held_out", held_out, sky()), ("relit", held_out, RELIT))
    )
    truth = {"seen": seen_texels(shape, cameras), "cameras": held_out, "held_out": first, "relit": other}
    exact = {"vertices": shape.vertices, "normals": shape.normals, "uv": shape.uv, **shape.material}
    exact = {n: torch.tensor(x) for n, x in exact.items()} | {"light": {"environment": torch.tensor(sky())}}
    best = float(np.mean([psnr(drawn("pbr", shape, exact, c), t) for c, t in zip(held_out, first, strict=True)]))
    results: dict[str, Any] = environment(("numpy", "torch")) | {"true material": best}
    columns, lines = [[first[0], other[0]]], [["`pbr`, true maps and sky", f"{best:.1f}", "", "", "", "", ""]]
    rows = []
    for shader, light_known in (("pbr", False), ("lambert", False), ("pbr", True), ("lambert", True)):
        name, begin = f"`{shader}`" + ", light known" * light_known, time.perf_counter()
        theta = fitted(shader, shape, list(zip(cameras, targets, strict=True)), args.steps, light_known)
        found = measured(shader, time.perf_counter() - begin, theta, shape, truth)
        drawings = found.pop("pictures")
        columns += [] if light_known else [drawings]
        results[name] = found
        maps = [
            f"{found[k]:.3f} ({found[k + '_constant']:.3f})" if k in found else "" for k in ("roughness", "metallic")
        ]
        psnrs = [f"{found[f'psnr_{k}']:.1f}" for k in ("held_out", "relit")]
        lines.append([name, *psnrs, f"{found['albedo']:.3f}", *maps, f"{found['seconds']:.0f}"])
        if shader == "pbr":
            rows += [_maps(theta)]
    rts.save_image(args.output / "materials_maps.png", np.concatenate([*rows, _maps(shape.material)]))
    picture = np.concatenate([np.concatenate(column) for column in columns], axis=1)[..., :3]
    rts.save_image(args.output / "materials_fit.png", picture.clip(0, 1).astype(np.float32))
    head = ["fit", "PSNR held out, dB", "relit, dB", "albedo", "roughness", "metallic", "s"]
    text = table(head, lines)
    (args.output / "fit.md").write_text(text)
    (args.output / "fit.json").write_text(json.dumps(results, indent=1))
    print(text)


def _maps(material: Mapping[str, Any]) -> np.ndarray:
    """Albedo, roughness and metallic side by side."""
    found = [averaged(np.asarray(material[name])) * np.ones(3) for name in ("texture", "roughness", "metallic")]
    return np.concatenate(found, axis=1).astype(np.float32)


if __name__ == "__main__":
    main()
