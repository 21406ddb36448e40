"""The report: one HTML file with pictures beside renders, the loss, and the table of views; it needs no network."""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from rts_reconstruct.measures import Measured, mean_of, shown
from rts_reconstruct.model import Model
from rts_reconstruct.pictures import Pictures, on
from rts_reconstruct.verdict import Verdict

MOST = 8
"""The most views that are shown."""
POINTS = 400
"""The most points of the curve of losses."""
STYLE = """body { font: 15px/1.5 system-ui, sans-serif; max-width: 60rem; margin: 2rem auto; padding: 0 1rem;
  color: #222 }
img { max-width: 100%; image-rendering: pixelated } figure { margin: 1rem 0 } figcaption { color: #666 }
table { border-collapse: collapse; font-variant-numeric: tabular-nums } td, th { padding: .1rem .8rem;
  text-align: right }
th { border-bottom: 1px solid #999 } .held { background: #eef4ff } .pair { display: flex; gap: .3rem }
.pair img { width: 32%; min-width: 0 }"""


def write_report(
    path: Path,
    model: Model,
    pictures: Pictures,
    rows: Sequence[Measured],
    losses: Sequence[list[float]],
    told: str,
    verdict: Verdict,
) -> None:
    """Write the report.

    Args:
        path: the file.
        model: the model.
        pictures: the pictures that it was fitted to.
        rows: measures, of views to fit and then of those held out.
        losses: those of the steps of each stage.
        told: a line on the whole.
        verdict: the verdict on it.
    """
    first = len(pictures.views) if pictures.held_out else 0
    last = len(rows)
    places = np.unique(np.linspace(first, last - 1, min(MOST, last - first)).astype(int))
    title = "Views that were held out" if pictures.held_out else "Views (none was held out)"
    pairs = "\n".join(_pair(model, pictures, rows[place], int(place)) for place in places)
    path.write_text(
        f"""<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>Reconstruction</title><style>{STYLE}</style></head><body>
<h1>Reconstruction</h1>
<p>{html.escape(told)}</p>
{_verdict(verdict)}
<figure><img alt="The mesh, turning" src="{_data((path.parent / "turntable.gif").read_bytes(), "gif")}"></figure>
<h2>{title}</h2>
<p>Left the picture, in the middle the render, on the right their difference (grey where they are the same).</p>
{pairs}
<h2>Loss</h2>
{_curve(losses)}
<h2>Measures</h2>
{_table(rows)}
</body></html>
""",
        encoding="utf-8",
    )


def _verdict(verdict: Verdict) -> str:
    head = "Not a reconstruction" if verdict.blob else "Findings" if verdict.findings else "No fault was found"
    findings = "".join(f"<li>{html.escape(finding)}</li>" for finding in verdict.findings)
    return f"<h2>{head}</h2><p>{html.escape(verdict.figures)}</p><ul>{findings}</ul>"


def _pair(model: Model, pictures: Pictures, row: Measured, place: int) -> str:
    """A picture, its render, and their difference."""
    image = on((pictures.views + pictures.held_out)[place].image, pictures.background)
    render = shown(model, pictures, place)
    render = on(render if pictures.outlined else render[..., :3], pictures.background)
    shots = "".join(f'<img alt="" src="{_png(shot)}">' for shot in (image, render, 0.5 + 0.5 * (render - image)))
    return f'<figure><div class="pair">{shots}</div><figcaption>{_told(row)}</figcaption></figure>'


def _told(row: Measured) -> str:
    name = html.escape(row.name or f"view {row.number}")
    iou = "" if row.iou is None else f", IoU {row.iou:.3f}"
    return f"{name}: PSNR {row.psnr:.1f} dB, SSIM {row.ssim:.3f}{iou}"


def _png(image: np.ndarray) -> str:
    buffer = io.BytesIO()
    Image.fromarray(np.round(255 * np.clip(image, 0, 1)).astype(np.uint8)).save(buffer, "PNG")
    return _data(buffer.getvalue(), "png")


def _data(content: bytes, kind: str) -> str:
    return f"data:image/{kind};base64,{base64.b64encode(content).decode()}"


def _curve(losses: Sequence[list[float]]) -> str:
    """The losses of all stages as a picture, SVG, on a logarithmic scale; lines part the stages."""
    values = np.array([value for stage in losses for value in stage], np.float64)
    if len(values) == 0:
        return "<p>No step was made.</p>"
    width, height = 880, 240
    logs = np.log10(np.maximum(values, 1e-12))
    low, high = float(logs.min()), float(logs.max())
    span = max(high - low, 1e-6)
    chosen = np.unique(np.linspace(0, len(values) - 1, POINTS).astype(int))
    xs, ys = width * chosen / max(len(values) - 1, 1), 10 + (height - 20) * (high - logs[chosen]) / span
    line = " ".join(f"{x:.1f},{y:.1f}" for x, y in zip(xs, ys, strict=True))
    ends = np.cumsum([len(stage) for stage in losses])[:-1] * width / max(len(values) - 1, 1)
    parts = "".join(f'<line x1="{x:.1f}" x2="{x:.1f}" y1="0" y2="{height}" stroke="#ccc"/>' for x in ends)
    return (
        f'<svg viewBox="0 0 {width} {height + 20}" role="img" aria-label="Loss of each step">{parts}'
        f'<polyline points="{line}" fill="none" stroke="#2563eb" stroke-width="1.5"/>'
        f'<text x="2" y="{height + 15}" font-size="12">loss {values[0]:.3g} → {values[-1]:.3g} in {len(values)} steps, '
        f"logarithmic; the lowest is {values.min():.3g}</text></svg>"
    )


def _table(rows: Sequence[Measured]) -> str:
    def cells(name: str, psnr: float | None, ssim: float | None, iou: float | None) -> str:
        texts = ["" if x is None else format(x, form) for x, form in ((psnr, ".2f"), (ssim, ".4f"), (iou, ".4f"))]
        return f"<td>{html.escape(name)}</td>" + "".join(f"<td>{text}</td>" for text in texts)

    lines = []
    for held_out, name in ((True, "mean of views held out"), (False, "mean of views fitted")):
        means = [mean_of(list(rows), measure, held_out) for measure in ("psnr", "ssim", "iou")]
        if means[0] is not None:
            lines.append(f"<tr>{cells(name, *means)}</tr>")
    for row in sorted(rows, key=lambda row: row.number):
        kind = ' class="held"' if row.held_out else ""
        lines.append(f"<tr{kind}>{cells(row.name or str(row.number), row.psnr, row.ssim, row.iou)}</tr>")
    head = "<tr><th>view</th><th>PSNR, dB</th><th>SSIM</th><th>IoU</th></tr>"
    note = "Rows of views that were held out are blue."
    if any(row.held_out and row.camera == "fitted" for row in rows):
        note += " Their cameras were fitted to these pictures in the end, while the mesh stayed."
    return f"<table>{head}{''.join(lines)}</table><p>{note}</p>"
