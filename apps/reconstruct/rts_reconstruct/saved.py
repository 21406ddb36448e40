"""What a reconstruction keeps between stages, so that it can go on: one file, and that of the running fit."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np

import rts
from rts_reconstruct.model import Atlas, Model


class Saved:
    """The folder `checkpoint` of a reconstruction.

    Args:
        folder: the folder, which exists.
        identity: the settings that a reconstruction must share with the one that it continues.
    """

    def __init__(self, folder: Path, identity: dict[str, Any]):
        self.folder, self.identity = folder, json.loads(json.dumps(identity))
        self.file = folder / "stages.npz"

    def running(self, stage: int) -> Path:
        """The file of the fit that runs in a stage."""
        return self.folder / f"stage_{stage}.npz"

    def forget(self) -> None:
        """Remove what an earlier reconstruction has kept."""
        for file in (self.file, *self.folder.glob("stage_*.npz")):
            file.unlink(missing_ok=True)

    def write(
        self, model: Model, losses: list[list[float]], seconds: float, exposures: np.ndarray | None = None
    ) -> None:
        """Keep the model after a stage; `losses` has a list for each stage so far. See `Pictures` for exposures."""
        arrays = {name: x for name, x in model._asdict().items() if name != "atlas" and x is not None}
        if model.atlas is not None:
            arrays |= {f"atlas_{name}": x for name, x in model.atlas._asdict().items()}
        even = None if exposures is None else exposures.tolist()
        about = json.dumps({"identity": self.identity, "losses": losses, "seconds": seconds, "exposures": even})
        beside = self.folder / "stages.new.npz"
        np.savez(beside, about=np.array(about), **arrays)
        os.replace(beside, self.file)
        self.running(len(losses) - 1).unlink(missing_ok=True)

    def read(self) -> tuple[Model, list[list[float]], float, np.ndarray | None] | None:
        """What `write` kept after the last stage that ended; None if none ended.

        Raises:
            InputError: the file is damaged, or of a reconstruction with other settings.
        """
        if not self.file.is_file():
            return None
        try:
            with np.load(self.file, allow_pickle=False) as data:
                arrays = {name: data[name] for name in data.files}
            about = json.loads(str(arrays.pop("about")))
            atlas = {n.removeprefix("atlas_"): arrays.pop(n) for n in list(arrays) if n.startswith("atlas_")}
            model = Model(**arrays, atlas=Atlas(**atlas) if atlas else None)
            before, losses, seconds = about["identity"], about["losses"], about["seconds"]
            exposures = None if about["exposures"] is None else np.array(about["exposures"])
        except Exception:  # NumPy raises many kinds, some with the advice to load pickles.
            raise rts.InputError(f"{self.file} is damaged; leave out --resume to begin again") from None
        other = [name for name, value in self.identity.items() if before.get(name) != value]
        if other:
            changes = ", ".join(f"{name} was {before.get(name)!r:.40}" for name in other)
            raise rts.InputError(f"{self.folder} is of other settings ({changes}); give the same, or begin again")
        return model, losses, seconds, exposures
