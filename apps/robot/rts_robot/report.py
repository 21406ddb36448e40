"""What a calibration is written to: a JSON file, and a page with the robot drawn over each mask."""

from __future__ import annotations

import base64
import html
import io
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

import rts
from rts_robot.calibration import Calibration
from rts_robot.robot import Robot

MOST = 24
"""The most views that the page shows."""
BOTH, MASK, ROBOT, NEITHER = (0.62, 0.66, 0.7), (0.16, 0.42, 0.85), (0.95, 0.5, 0.1), (1.0, 1.0, 1.0)
"""Colours of pixels inside both, inside the mask alone, inside the robot alone, and inside neither."""
STYLE = """body { font: 15px/1.5 system-ui, sans-serif; max-width: 62rem; margin: 2rem auto; padding: 0 1rem }
figure { display: inline-block; width: 19rem; margin: .4rem } img { max-width: 100% } figcaption { color: #666 }
table { border-collapse: collapse }
td, th { padding: .1rem .8rem; text-align: right }
th { border-bottom: 1px solid #999 }"""


def write_json(path: Path, found: Calibration, names: Sequence[str], intrinsics: np.ndarray) -> None:
    """Write the calibration's numbers: `camera_to_base`, `covariance`, `standard_deviations`, offsets, views."""
    turn, shift = found.deviations[:3], found.deviations[3:]
    entries: dict[str, Any] = {
        "camera_to_base": found.camera_to_base.tolist(),
        "camera_axes": "x right, y down, z forward, as OpenCV's; metres",
        "covariance": found.covariance.tolist(),
        "covariance_of": "rotation vector in the frame of the base (radians, 3), position of the camera (metres, 3)",
        "standard_deviations": {"degrees": np.degrees(turn).tolist(), "millimetres": (1e3 * shift).tolist()},
        "offsets": {
            name: {"value": value, "standard_deviation": found.offset_deviations[name]}
            for name, value in found.offsets.items()
        },
        "intrinsics": intrinsics.tolist(),
        "views": [{"mask": name, "iou": iou} for name, iou in zip(names, found.ious.tolist(), strict=True)],
        "reason": found.reason,
        "seconds": found.seconds,
    }
    path.write_text(json.dumps(entries, indent=2) + "\n", encoding="utf-8")


def overlay(robot: Robot, found: Calibration, mask: np.ndarray, number: int) -> np.ndarray:
    """A picture (H, W, 3), 0 to 1, of where robot and mask of a view agree, and where not."""
    parts = robot.parts(found.values[number])
    drawn = np.asarray(rts.render(parts, found.camera, mask.shape, layers=1))[..., 3:]
    inside = mask[..., None]
    colours = (np.asarray(c) for c in (BOTH, MASK, ROBOT, NEITHER))
    both, mask_alone, robot_alone, neither = colours
    return (
        drawn * inside * both
        + (1 - drawn) * inside * mask_alone
        + drawn * (1 - inside) * robot_alone
        + (1 - drawn) * (1 - inside) * neither
    )


def write_page(path: Path, robot: Robot, found: Calibration, names: Sequence[str], masks: Sequence[np.ndarray]) -> None:
    """Write a page of HTML, which needs no network."""
    chosen = np.unique(np.linspace(0, len(masks) - 1, min(MOST, len(masks))).astype(int))
    figures = "\n".join(
        f'<figure><img alt="" src="{_png(overlay(robot, found, masks[n], n))}">'
        f"<figcaption>{html.escape(names[n])}: IoU {found.ious[n]:.3f}</figcaption></figure>"
        for n in map(int, chosen)
    )
    turn, shift = np.degrees(found.deviations[:3]), 1e3 * found.deviations[3:]
    rows = [
        (f"position {axis}", f"{1e3 * found.camera_to_base[i, 3]:.2f} mm", f"{shift[i]:.2g} mm")
        for i, axis in enumerate("xyz")
    ]
    rows += [(f"turn about {axis}", "", f"{turn[i]:.2g}°") for i, axis in enumerate("xyz")]
    rows += [
        (f"offset of {name}", f"{value:.5f}", f"{found.offset_deviations[name]:.2g}")
        for name, value in found.offsets.items()
    ]
    table = "".join("<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in row) + "</tr>" for row in rows)
    matrix = "\n".join("  ".join(f"{x: .6f}" for x in row) for row in found.camera_to_base)
    path.write_text(
        f"""<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>Camera of a robot</title><style>{STYLE}</style></head><body>
<h1>Camera of a robot</h1>
<p>{html.escape(repr(found))}.</p>
<h2>Camera to base</h2>
<pre>{matrix}</pre>
<table><tr><th>frame of the base</th><th>value</th><th>standard deviation</th></tr>{table}</table>
<p>Offsets are in radians, or metres where the joint slides.</p>
<h2>Views</h2>
<p>Grey: robot and mask. Blue: mask alone. Orange: robot alone.</p>
{figures}
</body></html>
""",
        encoding="utf-8",
    )


def _png(picture: np.ndarray) -> str:
    buffer = io.BytesIO()
    Image.fromarray(np.uint8(np.round(255 * picture.clip(0, 1)))).save(buffer, "PNG")
    return f"data:image/png;base64,{base64.b64encode(buffer.getvalue()).decode()}"
