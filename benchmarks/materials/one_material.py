"""Whether a smooth sky tells metallic from dielectric: spheres of one material, fitted to pictures by `pbr` itself.

Colour, metallic and roughness are five numbers; the sky is that of `compare`, and known.

    python -m benchmarks.materials.one_material
"""

from __future__ import annotations

import numpy as np
import torch

import rts
from benchmarks.materials.compare import sky, sphere
from benchmarks.report import table
from rts.shading import prefiltered

EYES = ((0.0, 0.2, 1.0), (1.0, 0.4, -0.3), (-1.0, -0.3, -0.2))
SIZE = (48, 48)


def found(metallic: float, roughness: float, start: float) -> tuple[float, float]:
    """Metallic and roughness that Levenberg–Marquardt finds from 0.5, and from `start` of metallic, as logits."""
    part, light = sphere(metallic, roughness).part, {"environment": prefiltered(sky())}
    cameras = [rts.Camera.look_at(3.4 * np.array(eye) / np.linalg.norm(eye), (0, 0, 0), fov_y=38) for eye in EYES]

    def images(looks: dict) -> torch.Tensor:
        here = part.replace(theta={**part.theta, **looks, "light": light})
        return torch.as_tensor(rts.render_views(here, cameras, SIZE, splatter="none"))

    target = images({})

    def residuals(logits: dict) -> torch.Tensor:
        return images({name: torch.sigmoid(x) for name, x in logits.items()}) - target

    logits = {"color": torch.zeros(3), "metallic": torch.logit(torch.tensor(start)), "roughness": torch.tensor(0.0)}
    fit = rts.fit(residuals, logits, method="lm", steps=25, progress=False)
    metal, rough = (float(torch.sigmoid(fit.parameters[name])) for name in ("metallic", "roughness"))
    return metal, rough


def main() -> None:
    lines = []
    for metallic, roughness in ((0.0, 0.5), (1.0, 0.5), (1.0, 0.8)):
        for start in (0.27, 0.5, 0.9):
            m, r = found(metallic, roughness, start)
            lines.append([f"{metallic:g}, {roughness:g}", f"{start:g}", f"{m:.3f}, {r:.3f}"])
            print(lines[-1], flush=True)
    print(table(["metallic and roughness", "metallic at first", "found"], lines))


if __name__ == "__main__":
    main()
