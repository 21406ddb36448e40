"""A network as shader learns a ball's colours from pictures. Writes network_shader.png: start, result, target."""

import sys

import numpy as np
import torch
import trimesh

import rts

QUICK = "--quick" in sys.argv
SIZE, STEPS = ((32, 32), 30) if QUICK else ((128, 128), 400)

ball = trimesh.creation.icosphere(3)
surface, vertices = rts.Mesh(ball.faces), np.asarray(ball.vertices, np.float32)
cameras = [rts.Camera.look_at(eye, (0, 0, 0)) for eye in ((0, 0, 3), (3, 0, 0), (0, 3, 0.1))]
torch.manual_seed(0)
network = torch.nn.Sequential(torch.nn.Linear(3, 48), torch.nn.SiLU(), torch.nn.Linear(48, 3), torch.nn.Sigmoid())


def stripes(theta, gbuffer, camera):  # What is to be learned: a shader in array code.
    xp = rts.namespace(gbuffer["position"])
    bright = 0.5 + 0.5 * xp.sin(5 * gbuffer["position"])
    return xp.concat([bright, xp.ones_like(bright[:, :1])], axis=-1)


def learned(theta, gbuffer, camera):  # Weights are numbers of the part, like vertices, and so have derivatives.
    color = torch.func.functional_call(network, theta["weights"], (gbuffer["position"],))
    return torch.cat([color, torch.ones_like(color[:, :1])], dim=-1)


def image(camera):
    theta = {"vertices": vertices, "weights": dict(network.named_parameters())}
    return rts.render(rts.Part(surface, theta, learned), camera, SIZE)


pictures = [rts.render(rts.Part(surface, {"vertices": vertices}, stripes), camera, SIZE) for camera in cameras]
start, optimizer = image(cameras[0]).detach().numpy(), torch.optim.Adam(network.parameters(), lr=0.02)
for step in range(STEPS):
    optimizer.zero_grad()
    views = zip(cameras, pictures, strict=True)
    loss = sum((image(camera) - torch.as_tensor(picture)).square().mean() for camera, picture in views)
    loss.backward()
    optimizer.step()
    if step in (0, STEPS - 1):
        print(f"step {step}: loss {loss:.5f}")

shown = [start, image(cameras[0]).detach().numpy(), pictures[0]]
rts.save_image("network_shader.png", np.concatenate(shown, axis=1))
