"""Short programs as users of nvdiffrast write them: what they draw, and what they find."""

import numpy as np
import pytest
import rts_nvdiffrast.torch as dr
import scenes
import torch

CONTEXT = dr.RasterizeCudaContext()
SQUARE_SIDES = torch.tensor([[0, 1, 2], [0, 2, 3]], dtype=torch.int32)


def test_a_triangle_of_three_colours():
    pos = torch.tensor([[[-0.8, -0.8, 0, 1], [0.8, -0.8, 0, 1], [-0.8, 0.8, 0, 1]]], dtype=torch.float32)
    rast, _ = dr.rasterize(CONTEXT, pos, scenes.ONE, resolution=[64, 64])
    out, _ = dr.interpolate(torch.eye(3)[None], rast, scenes.ONE)
    assert out.shape == (1, 64, 64, 3)
    x = (np.arange(64) + 0.5) / 32 - 1
    second, third = np.meshgrid((x + 0.8) / 1.6, (x + 0.8) / 1.6)
    inside = (second > 0) & (third > 0) & (second + third < 1)
    expected = np.stack([1 - second - third, second, third], axis=-1)
    np.testing.assert_allclose(out[0][inside], expected[inside], atol=1e-6)
    assert not out[0][~inside].any()


def test_a_cube_with_colours_at_corners_is_found():
    """Corners and colours unknown, images of 8 x 8 pixels from everywhere."""
    rng = np.random.default_rng(1)
    true = scenes.CUBE + 0.5
    pos = (scenes.CUBE + torch.tensor(rng.uniform(-0.2, 0.2, (8, 3)), dtype=torch.float32)).requires_grad_()
    colors = torch.full((8, 3), 0.5, requires_grad=True)

    def render(vertices, colors, vector):
        clip = scenes.clip(vertices, vector)
        rast, _ = dr.rasterize(CONTEXT, clip, scenes.CUBE_FACES, resolution=[8, 8])
        image, _ = dr.interpolate(colors[None], rast, scenes.CUBE_FACES)
        return dr.antialias(image, rast, clip, scenes.CUBE_FACES)

    def error():
        return (pos.detach() - scenes.CUBE).norm(dim=1).mean().item()

    start, optimizer = error(), torch.optim.Adam([pos, colors], lr=0.02)
    for _ in range(60):
        vector = rng.uniform(-np.pi, np.pi, 3)
        loss = (render(pos, colors, vector) - render(scenes.CUBE, true, vector)).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    assert error() < 0.6 * start
    assert (colors.detach() - true).abs().mean() < 0.35


@pytest.mark.parametrize("mip", [False, True])
def test_the_texture_of_a_sphere_is_found(mip):
    points, faces, uv = scenes.sphere()
    s, t = torch.meshgrid(torch.arange(16) / 16, torch.arange(16) / 16, indexing="xy")
    true = torch.stack([(2 * np.pi * s).sin(), (2 * np.pi * t).cos(), (2 * np.pi * (s + t)).sin()], dim=-1)[None]
    texture = torch.zeros_like(true, requires_grad=True)

    def render(texture, vector):
        rast, db = dr.rasterize(CONTEXT, scenes.clip(points, vector), faces, resolution=[48, 48])
        st, changes = dr.interpolate(uv[None], rast, faces, rast_db=db, diff_attrs="all")
        if mip:
            image = dr.texture(texture, st, changes, filter_mode="linear-mipmap-linear", max_mip_level=3)
        else:
            image = dr.texture(texture, st, filter_mode="linear")
        return torch.where(rast[..., 3:] > 0, image, 0.0)

    rng, optimizer = np.random.default_rng(2), torch.optim.Adam([texture], lr=0.1)
    for _ in range(60):
        vector = rng.uniform(-np.pi, np.pi, 3)
        loss = (render(texture, vector) - render(true, vector)).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    middle = slice(3, 13)  # Few pixels see the poles.
    assert (texture.detach() - true)[:, middle].abs().mean() < 0.15 * true[:, middle].abs().mean()


def test_an_environment_that_a_sphere_reflects_is_found():
    points, faces, _ = scenes.sphere()
    true = torch.linspace(0, 1, 6)[None, :, None, None, None].expand(1, 6, 8, 8, 3).contiguous()
    environment = torch.full_like(true, 0.5, requires_grad=True)

    def render(environment, vector):
        clip = scenes.clip(points, vector)
        rast, db = dr.rasterize(CONTEXT, clip, faces, resolution=[40, 40])
        turn = scenes.rotation(torch.as_tensor(vector, dtype=torch.float32))
        normal = points / 0.9
        eye = turn.T @ torch.tensor([0.0, 0, 3.5]) - points
        mirrored = 2 * normal * (normal * eye).sum(dim=1, keepdim=True) - eye
        reflected, changes = dr.interpolate(mirrored[None], rast, faces, rast_db=db, diff_attrs="all")
        image = dr.texture(environment, reflected, changes, filter_mode="linear-mipmap-linear", boundary_mode="cube")
        return dr.antialias(torch.where(rast[..., 3:] > 0, image, 0.0), rast, clip, faces)

    rng, optimizer = np.random.default_rng(3), torch.optim.Adam([environment], lr=0.05)
    for _ in range(40):
        vector = rng.uniform(-np.pi, np.pi, 3)
        loss = (render(environment, vector) - render(true, vector)).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    assert (environment.detach() - true).abs().mean() < 0.05


def test_a_pose_is_found_from_colours_of_sides():
    corners = torch.arange(24, dtype=torch.int32).reshape(6, 4)[:, [0, 1, 2, 0, 2, 3]].reshape(12, 3)
    colors = torch.rand((6, 3), generator=torch.Generator().manual_seed(4)).repeat_interleave(4, dim=0)

    def render(vector):
        clip = scenes.clip(scenes.CUBE, vector)
        rast, _ = dr.rasterize(CONTEXT, clip, scenes.CUBE_FACES, resolution=[48, 48])
        image, _ = dr.interpolate(colors[None], rast, corners)
        return dr.antialias(image, rast, clip, scenes.CUBE_FACES)

    truth = torch.tensor([0.4, 0.7, 0.2])
    target, found = render(truth), torch.tensor([0.6, 0.45, 0.0], requires_grad=True)
    optimizer = torch.optim.Adam([found], lr=0.02)
    for step in range(50):
        optimizer.param_groups[0]["lr"] = 0.03 * 0.05 ** (step / 50)
        loss = (render(found) - target).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    assert (found.detach() - truth).norm() < 0.03  # It was 0.38 at the start.
