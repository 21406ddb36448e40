"""Is a sharp forward image better for fitting textures? The image of the splat, against a hard one with its derivative.

A texture is fitted to area-sampled pictures of textured spot; it is judged by pictures from other viewpoints, and texel
by texel where it was seen:

    python -m benchmarks.accuracy.texture_fit
"""

from __future__ import annotations

import argparse

import numpy as np
import torch
from rich.progress import track

import rts
from benchmarks.accuracy import scenes
from benchmarks.camera import camera, supersampled
from rts.plugin_api.records import Splats
from rts.splatting import Plain, Visible

SIZE, TEXELS, TRAINING, HELD_OUT, STEPS, BATCHES, RATE = (128, 128), 256, 16, 6, 120, 4, 0.03


class Sharp(rts.Splatter):
    """The image of `none` with the derivative of `visible`."""

    def image(self, splats: Splats) -> torch.Tensor:
        """See `rts.Splatter`."""
        soft = Visible().image(splats)
        return soft + (Plain().image(splats) - soft).detach()


def views(count: int, seed: int) -> list[rts.Camera]:
    """Cameras all around, at random heights."""
    random = np.random.default_rng(seed)
    around, height = 2 * np.pi * np.arange(count) / count + seed, random.uniform(-0.5, 0.6, count)
    eyes = 3.2 * np.stack([np.cos(height) * np.sin(around), np.sin(height), np.cos(height) * np.cos(around)], -1)
    return [camera(tuple(e)) for e in eyes]


def spot() -> rts.Part:
    """Spot, with its texture averaged to few texels."""
    part = scenes.scene("spot").rest[0]
    texture = part.theta["texture"][..., :3]
    k = len(texture) // TEXELS
    return textured(part, texture.reshape(TEXELS, k, TEXELS, k, 3).mean(axis=(1, 3)).astype(np.float32))


def textured(part: rts.Part, texture) -> rts.Part:
    return part.replace(theta={**part.theta, "texture": texture})


def picture(part: rts.Part, view: rts.Camera) -> np.ndarray:
    return supersampled([part], view, SIZE, 8)[..., :3]


def fitted(part: rts.Part, cameras, pictures, splatter, supersample: int) -> np.ndarray:
    """The texture (T, T, 3) after Adam with a falling rate, a quarter of the pictures a step."""
    texture = torch.full((TEXELS, TEXELS, 3), 0.5, requires_grad=True)
    targets = [torch.tensor(p, dtype=torch.float32) for p in pictures]
    start = textured(part, texture.detach())
    sampled = [rts.sample(start, c, SIZE, supersample=supersample) for c in cameras]
    optimizer = torch.optim.Adam([texture], lr=RATE)
    schedule = torch.optim.lr_scheduler.LambdaLR(optimizer, lambda step: 1 - step / (STEPS + 10))
    for step in track(range(STEPS), description=f"{type(splatter).__name__}, {supersample}²", transient=True):
        optimizer.zero_grad()
        for i in range(step % BATCHES, len(cameras), BATCHES):
            image = rts.render_samples(sampled[i], textured(part, texture), cameras[i], splatter=splatter)[..., :3]
            (image - targets[i]).square().mean().backward()
        optimizer.step()
        schedule.step()
    return texture.detach().numpy()


def psnr(error: np.ndarray) -> float:
    return -10 * np.log10(np.mean(error**2))


def main() -> None:
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    part, training, held_out = spot(), views(TRAINING, 0), views(HELD_OUT, 1)
    pictures, others = ([picture(part, c) for c in cameras] for cameras in (training, held_out))
    print(f"{'forward image':14} samples  other views, dB  texels, dB")
    for supersample in (1, 2):
        for splatter in (Visible(), Sharp(), Plain()):
            texture = fitted(part, training, pictures, splatter, supersample)
            found = textured(part, texture.clip(0, 1))
            errors = [picture(found, c) - o for c, o in zip(held_out, others, strict=True)]
            seen = np.abs(texture - 0.5).max(axis=-1) > 0.02
            texels = (texture - part.theta["texture"])[seen]
            name = type(splatter).__name__.lower()
            print(f"{name:14} {supersample}²    {psnr(np.array(errors)):12.2f} {psnr(texels):14.2f}")


if __name__ == "__main__":
    main()
