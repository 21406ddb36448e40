"""A fit for several processes, which tests start by torchrun: vertices and a pose, from six pictures.

python -m torch.distributed.run --nproc-per-node 2 tests/distributed_fit.py METHOD RESULT.npz [CHECKPOINT] [END]

Where END is "1:70", process 1 ends without a word before it reads its 70th picture, once.
"""

import datetime
import os
import sys
from pathlib import Path

import numpy as np
import torch
import torch.distributed.nn  # Before the group is made, see docs/guides/many_views.md.
from helpers import icosphere

import rts

METHOD, RESULT, CHECKPOINT, END = [*sys.argv[1:], "", "", "", ""][:4]
SIZE = (24, 24)


def part(parameters):
    """A ball with a light."""
    theta = {"vertices": parameters["vertices"], "light": {"direction": np.array([0.3, 0.8, 0.5], np.float32)}}
    return rts.Part(rts.Mesh(FACES), theta, "lambert", transform=rts.rigid(parameters["pose"]))


class Ending(rts.ViewResiduals):
    """Residuals whose process may end before it reads a picture."""

    count = 0

    def load(self, key):
        """See `rts.Residuals`."""
        self.count += 1
        mark = f"{RESULT}.ended"
        if END == f"{os.environ.get('RANK', 0)}:{self.count}" and not os.path.exists(mark):
            open(mark, "w").close()
            os._exit(7)
        return super().load(key)


VERTICES, FACES = icosphere(1)
VERTICES = VERTICES.astype(np.float32)
EYES = np.concatenate([np.eye(3), -np.eye(3)]) * 3 + 0.3
TRUTH = {"vertices": VERTICES * np.array([1.1, 0.9, 1.0], np.float32), "pose": np.zeros(6, np.float32)}

if __name__ == "__main__":
    torch.set_num_threads(1)
    if "RANK" in os.environ:
        torch.distributed.init_process_group("gloo", timeout=datetime.timedelta(seconds=100))
    cameras = [rts.Camera.look_at(eye, (0, 0, 0)) for eye in EYES]
    views = [rts.View(camera, rts.render(part(TRUTH), camera, SIZE), name=f"{i}") for i, camera in enumerate(cameras)]
    pose = torch.tensor([0.05, -0.03, 0.02, 0.02, 0.0, -0.02])
    if METHOD == "lm":
        constant = TRUTH["vertices"]
        residuals = Ending(lambda p: part({"vertices": constant, "pose": p["pose"]}), views)
        start = {"pose": pose}
    else:
        residuals = Ending(part, views, batch=3, seed=4)
        start = {"vertices": torch.tensor(VERTICES), "pose": pose}
    fit = rts.fit(
        residuals,
        start,
        method=METHOD,
        steps=12 if METHOD == "lm" else 50,
        checkpoint=CHECKPOINT or None,
        checkpoint_every=3,
        progress=False,
    )
    if int(os.environ.get("RANK", 0)) == 0:
        np.savez(RESULT, history=fit.history, **{name: x.numpy() for name, x in fit.parameters.items()})
    print(f"process {os.environ.get('RANK', 0)}: {fit.loss!r} after {residuals.count} pictures, {fit.reason}")
    if torch.distributed.is_initialized():
        torch.distributed.destroy_process_group()
        threads = [file.read_text() for file in Path("/proc/self/task").glob("*/comm")]
        assert not any("gloo" in name for name in threads), threads  # They may abort a process that ends.
