#!/usr/bin/env bash
# Whether the applications work from wheels alone: in an empty environment, away from the sources, a folder of COLMAP
# becomes a mesh in one command, a robot moves, and errors of use take one line each.
#
#     apps/wheels.sh <folder of the wheels> <constraints>
set -euo pipefail
dist=$(realpath "$1") constraints=$(realpath "$2")
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
"${PYTHON:-python3}" -m venv venv
unset PYTHONPATH
export PYTHONWARNINGS=ignore
venv/bin/python -m pip install --quiet --upgrade pip
venv/bin/python -m pip install --quiet -c "$constraints" --find-links "$dist" rts-nvdiffrast rts-reconstruct rts-robot rts-viewer
unset PYTHONWARNINGS
venv/bin/python - <<'PYTHON'
import numpy as np
import torch
import trimesh

import rts
import rts_nvdiffrast.torch as dr
import rts_reconstruct
import rts_robot
import rts_viewer

for module in (rts, dr, rts_reconstruct, rts_robot, rts_viewer):
    assert "site-packages" in module.__file__, module.__file__
one = torch.tensor([[[-1.0, -1, 0, 1], [1, -1, 0, 1], [0, 1, 0, 1]]], requires_grad=True)
rast, _ = dr.rasterize(dr.RasterizeCudaContext(), one, torch.arange(3, dtype=torch.int32)[None], (32, 32))
dr.antialias((rast[..., 3:] > 0).float(), rast, one, torch.arange(3, dtype=torch.int32)[None]).mean().backward()
assert one.grad.abs().max() > 0
ball = trimesh.creation.icosphere(3)
theta = {"vertices": np.float32(ball.vertices), "colors": np.float32(0.5 + 0.4 * ball.vertices)}
views = []
for i, way in enumerate(trimesh.creation.icosahedron().vertices):
    camera = rts.Camera.look_at(4 * way, (0, 0, 0), fov_y=40)
    image = rts.render(rts.Part(rts.Mesh(ball.faces), theta, "unlit"), camera, (64, 64), supersample=2)
    rts.save_image(f"photos/images/{i:02}.png", np.asarray(image))
    views.append(rts.View(camera.for_size((64, 64)), np.asarray(image), name=f"{i:02}.png"))
rts.save_views("photos/sparse/0", views)
with open("arm.urdf", "w") as file:
    link = '<link name="{}"><visual><geometry><box size=".2 .3 .4"/></geometry></visual></link>'
    joint = '<joint name="j" type="revolute"><parent link="a"/><child link="b"/><limit effort="1" velocity="1"/></joint>'
    file.write(f'<robot name="r">{link.format("a")}{link.format("b")}{joint}</robot>')
assert abs(rts_robot.load_urdf("arm.urdf").transforms({"j": 0.5})[1][2, 1] - np.sin(0.5)) < 1e-6
PYTHON
venv/bin/rts reconstruct photos -o out --quick --steps 60 --size 64
test -s out/mesh.glb && test -s out/mesh.obj && test -s out/texture.png && test -s out/report.html
venv/bin/rts view --help >/dev/null
venv/bin/rts calibrate --help >/dev/null
# One line, and no traceback.
test "$(venv/bin/rts reconstruct photos/images -o out 2>&1 | wc -l)" = 1
