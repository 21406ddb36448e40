# pyright: strict, reportUnnecessaryTypeIgnoreComment=true
"""Mistakes in a user's script: pyright finds each, or calls its comment unnecessary."""

import numpy as np
import torch

import rts

part = rts.Mesh.example()
camera = rts.Camera.perspective(40)
size = (128, 128)

rts.Mash([[0, 1, 2]])  # pyright: ignore[reportAttributeAccessIssue, reportUnknownMemberType]
rts.Mesh([[0, 1, 2]], tolerance=1)  # pyright: ignore[reportCallIssue]
rts.render(part, camera, size, background="white")  # pyright: ignore[reportArgumentType]
rts.render(part, camera, size, supersample="adaptive")  # pyright: ignore[reportArgumentType]
rts.render(part, camera, size, sampler=3)  # pyright: ignore[reportArgumentType]
rts.render(part, camera, size, splatter=rts.Sampler)  # pyright: ignore[reportArgumentType]
rts.tune(3)  # pyright: ignore[reportArgumentType]
rts.load_radiance_field("field.npz").volume_render(camera, 128)  # pyright: ignore[reportArgumentType]

# No mistakes: arrays of any kind, and plugins of others.
rts.Mesh(torch.tensor([[0, 1, 2]]), {"weights": None, "uv": np.array([[0, 1, 2]])})
rts.render(part, camera, size, sampler="theirs", splatter=rts.plugin("splatters", "multi"), background=torch.ones(3))
