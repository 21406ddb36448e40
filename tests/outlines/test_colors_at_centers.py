"""Colours beside outlines that are those of centres nearby: `Edges(colors="centers")`."""

import numpy as np
import pytest
from found_outlines import sampled_with_outlines
from helpers import icosphere

import rts

torch = pytest.importorskip("torch")

pytestmark = pytest.mark.splatting

SIZE = (24, 32)
CAMERA = rts.Camera.look_at((0.3, 0.5, 3), (0, 0, 0), fov_y=40)
CAMERAS = [CAMERA, rts.Camera.look_at((-1, 0.2, 3), (0, 0, 0), fov_y=40)]
VERTICES, FACES = icosphere(2, 0.7)
NEAR = (VERTICES * 0.6 + [0.3, 0.2, 0.9]).astype(np.float32)
WIRE = np.array([[-1, -0.3, 1], [1, 0.3, 1], [1, 0.34, 1], [-1, -0.26, 1]], np.float32)
EDGES = rts.plugin("splatters", "edges")
CENTERS = EDGES(colors="centers")


class Counted(rts.Shader):
    """A tint that grows along x, and the number of samples shaded so far."""

    opaque = True
    reads = ("tint",)

    def __init__(self):
        self.rows = 0

    def __call__(self, theta, gbuffer, camera):
        color = (1.5 + gbuffer["position"][:, :1]) * theta["tint"]
        self.rows += color.shape[0]
        xp = rts.namespace(color)
        return xp.concat([color, xp.ones_like(color[:, :1])], axis=1)


def scene(one_color, move=lambda x: x, shader="unlit"):
    """Two balls and a wire thinner than a pixel, each of one colour that programs do not know, or of several."""
    random, parts = np.random.default_rng(0), []
    for vertices, faces in ((VERTICES, FACES), (NEAR, FACES), (WIRE, np.array([[0, 1, 2], [0, 2, 3]]))):
        colors = random.random((1 if one_color else len(vertices), 3)).astype(np.float32)
        colors = np.broadcast_to(colors, (len(vertices), 3)).copy()
        parts.append(rts.Part(rts.Mesh(faces), {"vertices": move(vertices), "colors": torch.tensor(colors)}, shader))
    return parts


def image(draw):
    return np.asarray(draw.detach() if isinstance(draw, torch.Tensor) else draw)


def test_where_each_surface_has_one_colour_nothing_changes():
    for move in (np.asarray, lambda x: torch.tensor(x, requires_grad=True)):
        found = []
        for splatter in (EDGES(), CENTERS):
            parts = scene(True, move)
            drawn = rts.render(parts, CAMERA, SIZE, splatter=splatter)
            weights = torch.tensor(np.random.default_rng(1).random(drawn.shape), dtype=drawn.dtype)
            wanted = [parts[i].theta["colors"].requires_grad_() for i in range(3)]
            drawn = rts.render(parts, CAMERA, SIZE, splatter=splatter)
            moved = [part.theta["vertices"] for part in parts if isinstance(part.theta["vertices"], torch.Tensor)]
            slopes = torch.autograd.grad((drawn * weights).sum(), [*wanted, *moved])
            of_colors = np.array([slope.sum(0).numpy() for slope in slopes[:3]])
            found.append((image(drawn), of_colors, *[slope.numpy() for slope in slopes[3:]]))
        for expected, got in zip(*found, strict=True):
            np.testing.assert_allclose(got, expected, atol=2e-4 * max(1.0, np.abs(expected).max()))
        assert (found[0][0][..., 3] > 0).sum() > 200


def test_what_nothing_moves_is_shaded_at_centres_and_between_two_crossings_alone():
    def rows(splatter, move):
        shader = Counted()
        parts = scene(False, move, shader)
        thetas = [{"vertices": part.theta["vertices"], "tint": torch.ones(3)} for part in parts]
        parts = [part.replace(theta=theta) for part, theta in zip(parts, thetas, strict=True)]
        images.append(rts.render(parts, CAMERA, SIZE, splatter=splatter))
        return shader.rows

    images = []
    sampled, outlines = sampled_with_outlines(scene(False), CAMERA, SIZE, splatter=CENTERS)
    last = outlines.rows[:, :2]
    behind = ~outlines.ends[:, 1] & (last[:, 1] >= 0)
    centers = int((np.asarray(sampled.row)[0] >= 0).sum())
    assert behind.sum() > 10  # The wire, between two centres.
    assert 0 <= rows(CENTERS, np.asarray) - centers - behind.sum() <= 2  # An empty table has one row.
    moving = centers + int((last >= 0).sum())
    assert rows(CENTERS, torch.as_tensor) == moving < rows(EDGES(), torch.as_tensor)
    np.testing.assert_allclose(images[0], images[1], atol=3e-5)


def test_colours_are_those_of_the_centre_on_the_same_surface():
    """A ramp that ends midway between two centres: the pixel beside it has a share of the last centre's colour."""
    height, width = 3, 12
    projection = np.array([[2 / width, 0, 0, -1], [0, -2 / height, 0, 1], [0, 0, -0.02, -1], [0, 0, 0, 1]])
    camera = rts.Camera(np.eye(4), projection)
    x = np.array([-9, 6.25, 6.25, -9.0])
    vertices = np.column_stack([x, [-9, -9, 9, 9], np.full(4, -3)]).astype(np.float32)
    colors = np.repeat((x[:, None] + 9) / 20, 3, axis=1).astype(np.float32)
    part = rts.Part(rts.Mesh([[0, 1, 2], [0, 2, 3]]), {"vertices": vertices, "colors": colors}, "unlit")
    line = np.asarray(rts.render(part, camera, (height, width), splatter=CENTERS))[1]
    np.testing.assert_allclose(line[:7, 3], [1, 1, 1, 1, 1, 1, 0.25], atol=1e-6)
    np.testing.assert_allclose(line[6, 0] / 0.25, (5.5 + 9) / 20, atol=0.01)
    np.testing.assert_allclose(line[:6, 0], (np.arange(6) + 9.5) / 20, atol=1e-5)


def test_glass_has_its_samples_beside_outlines():
    parts = scene(False, shader=rts.plugin("shaders", "unlit")(opaque=False))
    for part in parts:
        part.theta["colors"] = torch.cat([part.theta["colors"], torch.full((len(part.theta["colors"]), 1), 0.5)], 1)
    images = [rts.render(parts, CAMERA, SIZE, splatter=splatter).detach().numpy() for splatter in (EDGES(), CENTERS)]
    np.testing.assert_array_equal(*images)


def test_other_words_are_refused():
    with pytest.raises(rts.InputError, match="colors is 'centres'; expected 'outlines' or 'centers'"):
        EDGES(colors="centres")


def test_every_way_draws_the_same():
    jax = pytest.importorskip("jax")
    expected = np.asarray(rts.render(scene(False), CAMERA, SIZE, splatter=CENTERS).detach())
    moving = scene(False, lambda x: torch.tensor(x, requires_grad=True))
    ways = {
        "moving": rts.render(moving, CAMERA, SIZE, splatter=CENTERS),
        "views": rts.render_views(scene(False), CAMERAS, SIZE, splatter=CENTERS)[0],
        "views that move": rts.render_views(moving, CAMERAS, SIZE, splatter=CENTERS)[0],
        "views of several kinds": rts.render_views(
            [scene(False)[0].replace(cull="back"), *scene(False)[1:]], CAMERAS, SIZE, splatter=CENTERS
        )[0],
        "samples": rts.render_samples(
            rts.sample(scene(False), CAMERA, SIZE, splatter=CENTERS), scene(False), CAMERA, splatter=CENTERS
        ),
    }
    host = [part.replace(theta={k: np.asarray(v) for k, v in part.theta.items()}) for part in scene(False)]

    def drawn(vertices):
        first = host[0].replace(theta={**host[0].theta, "vertices": vertices})
        return rts.render([first, *host[1:]], CAMERA, SIZE, splatter=CENTERS)

    ways |= {
        "numpy": rts.render(host, CAMERA, SIZE, splatter=CENTERS),
        "jit": jax.jit(drawn)(jax.numpy.asarray(VERTICES)),
    }
    ways["vmap"] = jax.vmap(drawn)(jax.numpy.asarray(VERTICES)[None])[0]
    ways["jax"] = drawn(jax.numpy.asarray(VERTICES))
    for name, way in ways.items():
        np.testing.assert_allclose(image(way), expected, atol=3e-5, err_msg=name)
    plain = np.asarray(rts.render(host, CAMERA, SIZE))
    assert 0.001 < np.abs(plain - expected).max()
