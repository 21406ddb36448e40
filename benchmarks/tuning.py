"""`rts.tune` beside an exhaustive search over all settings that it may choose from: does it find the cheapest?

On six scenes of different surfaces, 128², for two modes each. *Exhaustive*: the error of every setting, and the
time of every one that is within the tolerance, with every sampler. Both then take turns once more: the ratio is that of
their medians:

    python -m benchmarks.tuning -o out/tuning
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import replace
from pathlib import Path

import rts
from benchmarks.report import table
from rts_compare.builtin_scenes import builtin
from rts_compare.compared_settings import Setting, engines, usable
from rts_compare.comparison import file_name
from rts_compare.environment import environment
from rts_compare.interleaved_timing import Calls
from rts_compare.kept_measurements import KeptMeasurements
from rts_compare.measurements import TOGETHER, Measurements
from rts_compare.settings_search import LAYERS, SUPERSAMPLE

CASES = {
    "bunny over black": (("translation", "rotation"), 0.25),
    "stack of cards": (("translation", "rotation"), 0.07),
    "vase that turns": (("translation", "shape"), 0.08),
    "bezier teapot": (("translation", "camera"), 0.05),
    "subdivided rook": (("translation", "shape"), 0.12),
    "torus by lattice": (("translation", "camera"), 0.06),
}
"""Scene → what a fit would change, and the tolerance: such that neither one sample nor sixteen are sure to do."""
SIZE, TURNS = (128, 128), 5


def options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, default=Path("out/tuning"))
    parser.add_argument("--scenes", nargs="+", choices=CASES, default=list(CASES))
    return parser.parse_args()


def within(measured: Measurements, tolerance: float) -> list[Setting]:
    """All settings that are accurate enough, with each sampler."""
    splatters, samplers = usable("rts.splatters")[0], measured.samplers(usable("rts.samplers")[0])
    kinds, found = measured.kinds(samplers), []
    for setting in measured.settings(TOGETHER, splatters, LAYERS, SUPERSAMPLE, dict.fromkeys(kinds.values())):
        scores = [measured.scores(mode, setting) for mode in measured.scene.directions]
        if all(s is not None and s["error"] <= tolerance for s in scores):
            alike = [name for name, kind in kinds.items() if kind == setting.sampler]
            found += [setting._replace(sampler=name, engine=measured.engine.name) for name in alike]
    return found


def case(name: str, modes: tuple[str, ...], tolerance: float, folder: Path) -> dict:
    scene = builtin(name)
    times = []
    for _ in range(2):  # Without the truth at hand, where no earlier run has left it, and with it.
        start = time.perf_counter()
        tuned = rts.tune(scene, modes=modes, tolerance=tolerance, size=SIZE, truths=folder, progress=False)
        times.append(time.perf_counter() - start)
    kept = KeptMeasurements(folder / f"{file_name(name)}.jsonl")
    scene = replace(scene.with_modes(modes), size=SIZE)
    measured = Measurements(scene, kept, engines()[0][:1], truths=folder, together=True, count_at=SUPERSAMPLE[-1])
    admissible = within(measured, tolerance)
    found = medians(measured, admissible, 2)
    best = min(found, key=lambda s: found[s])
    chosen = Setting(**tuned.settings, rate=tuned.rate, engine=measured.engine.name)
    last = Measurements(
        measured.scene, KeptMeasurements(), [measured.engine], truths=folder, together=True, count_at=SUPERSAMPLE[-1]
    )
    again = medians(last, list({chosen: None, best: None}), TURNS)
    return {
        "scene": name,
        "modes": modes,
        "tolerance": tolerance,
        "settings": len(admissible),
        "tuned": _told(chosen),
        "cheapest": _told(best),
        "error": tuned.error,
        "ms": [again[chosen], again[best]],
        "seconds": times,
        "reasons": tuned.reasons,
    }


def medians(measured: Measurements, settings: list[Setting], turns: int) -> dict[Setting, float]:
    """Milliseconds of settings, in turns."""
    calls: Calls = {s: lambda s=s: measured.call(TOGETHER, s) for s in settings}
    return {Setting(*s): ms["median"] for s, ms in measured.timing(TOGETHER, calls).run(turns).items()}


def _told(setting: Setting) -> str:
    words = [setting.splatter, f"K={setting.layers}", f"{setting.supersample}×{setting.supersample}", setting.sampler]
    return " ".join(filter(None, [*words, setting.rate]))


def main() -> None:
    args = options()
    args.output.mkdir(parents=True, exist_ok=True)
    results = {**environment(("numpy", "numba", "torch")), "cases": []}
    for name in args.scenes:
        found = case(name, *CASES[name], args.output)
        results["cases"].append(found)
        print(json.dumps(found, indent=1), flush=True)
        (args.output / "tuning.json").write_text(json.dumps(results, indent=1))
    header = ["scene", "modes", "tolerance", "tuned", "ms", "cheapest of all", "ms", "ratio", "s, truth included", "s"]
    lines = [
        [
            f["scene"],
            ", ".join(f["modes"]),
            f"{f['tolerance']:.0%}",
            f["tuned"],
            f"{f['ms'][0]:.3g}",
            f"{f['cheapest']} ({f['settings']} tried)",
            f"{f['ms'][1]:.3g}",
            f"{f['ms'][0] / f['ms'][1]:.2f}",
            *(f"{s:.0f}" for s in f["seconds"]),
        ]
        for f in results["cases"]
    ]
    (args.output / "tuning.md").write_text(table(header, lines))
    print(table(header, lines))


if __name__ == "__main__":
    main()
