"""torch beside jax: one scene, the gradient by both. Writes torch_and_jax.png: the picture, how vertices are pushed."""

import sys

import jax
import numpy as np
import torch
import trimesh

import rts

SIZE = (24, 24) if "--quick" in sys.argv else (256, 256)

knot = trimesh.creation.torus(0.8, 0.35, major_sections=24, minor_sections=12)
surface, vertices = rts.Mesh(knot.faces), np.asarray(knot.vertices, np.float32)
camera = rts.Camera.look_at((1, 1, 3), (0, 0, 0))


def image(vertices):  # The arrays that come in say which engine computes: nothing else differs.
    return rts.render(rts.Part(surface, {"vertices": vertices}, "silhouette"), camera, SIZE)


def loss(vertices):
    return (image(vertices)[..., 3] ** 2).mean()


by_torch = torch.tensor(vertices, requires_grad=True)
value = loss(by_torch)
value.backward()
other, by_jax = jax.value_and_grad(loss)(jax.numpy.asarray(vertices))  # Or jax.jit(…) of it, for many steps.

by_torch, by_jax = by_torch.grad.numpy(), np.asarray(by_jax)
apart = np.abs(by_torch - by_jax).max() / np.abs(by_jax).max()
print(f"loss {value.item():.6f} by torch, {float(other):.6f} by jax; gradients differ by {apart:.1e} of the largest")

colors = 0.5 + 0.5 * by_torch / np.abs(by_torch).max()  # Grey where nothing pulls.
pushed = rts.Part(surface, {"vertices": vertices, "colors": colors.astype(np.float32)}, "unlit")
rts.save_image("torch_and_jax.png", np.concatenate([image(vertices), rts.render(pushed, camera, SIZE)], axis=1))
