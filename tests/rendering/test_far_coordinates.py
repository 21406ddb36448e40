"""Scenes far from the origin, as in map coordinates: in float64 as near it, in float32 with a warning."""

import numpy as np
import pytest
from helpers import quick

import rts
from rts.contracts.records import Proxy
from rts.errors import InputWarning
from rts.sampling.sample_checks import checked_proxy
from rts_surfaces.mesh import Mesh

pytestmark = pytest.mark.rendering

UTM = np.array([5e5, 5e6, 100.0])
SIZE = (48, 64)
SAMPLERS = quick(["raster", "reference", "embree", "opengl"], 2)


def torus(around=32, across=16):
    """Vertices (V, 3) and faces (T, 3) of a torus around z."""
    u, v = (np.arange(n) * 2 * np.pi / n for n in (around, across))
    u, v = (x.ravel() for x in np.meshgrid(u, v, indexing="ij"))
    vertices = np.stack([(1 + 0.4 * np.cos(v)) * np.cos(u), (1 + 0.4 * np.cos(v)) * np.sin(u), 0.4 * np.sin(v)], 1)
    i, j = (x.ravel() for x in np.meshgrid(np.arange(around), np.arange(across), indexing="ij"))
    a, b, c, d = (((i + k) % around) * across + (j + m) % across for k, m in ((0, 0), (1, 0), (1, 1), (0, 1)))
    return vertices, np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])


VERTICES, FACES = torus()


def camera_at(origin, eye=(1.0, -3.0, 2.0)):
    return rts.Camera.look_at(origin + np.array(eye), origin, fov_y=40.0)


def skip_without(sampler):
    try:
        rts.render(Mesh.example(), rts.Camera.look_at((0, 0, 4), (0, 0, 0)), (4, 4), sampler=sampler)
    except rts.PluginError as error:
        pytest.skip(str(error))


@pytest.mark.parametrize("sampler", SAMPLERS)
def test_image_does_not_depend_on_where_the_scene_is(sampler):
    """Vertices and camera of float64 at map coordinates give the image at the origin, of one part and of several."""
    skip_without(sampler)

    def images(origin):
        apart = [np.zeros(3), np.array([0.3, 0.2, 0.1])]
        parts = [rts.Part(Mesh(FACES), {"vertices": 0.7 * VERTICES + origin + x}, "normals") for x in apart]
        cameras = [camera_at(origin), camera_at(origin, (0.0, 3.0, 1.0))]
        yield rts.render(parts[0], cameras[0], SIZE, sampler=sampler)
        yield rts.render(parts, cameras[0], SIZE, sampler=sampler)
        yield rts.render(rts.prepare(parts, sampler), cameras[0], SIZE)
        yield rts.render(parts[0].replace(cull="back"), cameras[0], SIZE, sampler=sampler, splatter="none")
        yield from rts.render_views(parts[0], cameras, SIZE, sampler=sampler)
        yield from rts.render_views(parts, cameras, SIZE, sampler=sampler)

    for near, far in zip(images(0 * UTM), images(UTM), strict=True):
        assert near[..., -1].any() and np.abs(near - far).max() < 1e-4


@pytest.mark.parametrize("name", quick(["bezier", "bspline", "subdivision"]))
def test_patches_do_not_depend_on_where_they_are(name):
    """Their triangles are as exact as meshes, and so are the samples that are moved onto the surface from there."""
    part = rts.plugin("rts.surfaces", name).example()
    points = "vertices" if "vertices" in part.theta else "points"

    def image(origin):
        theta = {points: part.theta[points].astype(np.float64) + origin}
        return rts.render(part.replace(theta=theta, shader="silhouette"), camera_at(origin, (1.5, -4.5, 3.0)), SIZE)

    near, far = image(0 * UTM), image(UTM)
    assert near[..., -1].any() and np.abs(near - far).max() < 1e-4


@pytest.mark.parametrize("sampler", quick(["raster", "embree"]))
def test_gradient_does_not_depend_on_where_the_scene_is(sampler):
    """So does the gradient, relative to its largest entry."""
    torch = pytest.importorskip("torch")
    skip_without(sampler)
    weights = torch.from_numpy(np.random.default_rng(0).normal(size=(*SIZE, 4)))

    def gradient(origin):
        vertices = torch.from_numpy(VERTICES + origin).requires_grad_()
        image = rts.render(
            rts.Part(Mesh(FACES), {"vertices": vertices}, "normals"), camera_at(origin), SIZE, sampler=sampler
        )
        (image * weights).sum().backward()
        return vertices.grad.numpy()

    near, far = gradient(0 * UTM), gradient(UTM)
    assert np.abs(near - far).max() < 1e-4 * np.abs(near).max()


def test_only_far_vertices_have_an_origin():
    """It is near them, and vertices near the origin, and those of float32, stay as they are."""
    surface = Mesh(FACES)
    for vertices in (VERTICES, VERTICES + 2, (VERTICES + UTM).astype(np.float32)):
        proxy = checked_proxy(surface, vertices, None, SIZE)
        assert proxy.origin is None and np.array_equal(proxy.vertices, vertices.astype(np.float32))
    proxy = checked_proxy(surface, VERTICES + UTM, None, SIZE)
    assert np.abs(proxy.origin - UTM).max() <= 4 and np.abs(proxy.vertices + proxy.origin - UTM - VERTICES).max() < 1e-6
    one = Proxy(np.tile(UTM, (3, 1)), np.array([[0, 1, 2]], np.int32))
    assert checked_proxy(Fixed(one), None, None, SIZE).vertices.max() < 100


class Fixed(Mesh):
    """A mesh whose proxy is given."""

    def __init__(self, proxy):
        super().__init__(FACES)
        self.given = proxy

    def proxy(self, inputs, camera, size):
        return self.given


def test_prepared_vertices_far_away_are_compared():
    """Vertices that have moved since `rts.prepare` are told; unmoved ones are not."""
    theta = {"vertices": VERTICES + UTM}
    prepared = rts.prepare(rts.Part(Mesh(FACES), theta, "normals"), "raster")
    rts.render(prepared, camera_at(UTM), SIZE)
    theta["vertices"] += 0.01
    with pytest.warns(InputWarning, match="have changed since"):
        rts.render(prepared, camera_at(UTM), SIZE)


def far_scenes():
    """Scenes whose places are rounded to more than a pixel, and what the warning names."""
    moved = np.eye(4)
    moved[:3, 3] = UTM
    single = VERTICES.astype(np.float32)
    camera = camera_at(UTM)
    yield {"vertices": (VERTICES + UTM).astype(np.float32)}, None, camera, "vertices"
    yield {"vertices": single}, moved.astype(np.float32), camera, "transform"
    rounded = camera.map(lambda m: m.astype(np.float32))
    yield {"vertices": VERTICES + UTM}, None, rounded, "view"


@pytest.mark.parametrize("number", range(3))
def test_float32_far_away_warns_once(number):
    theta, transform, camera, what = list(far_scenes())[number]
    part = rts.Part(Mesh(FACES), theta, "normals", transform)
    with pytest.warns(InputWarning, match=f"{what}.*float32.*subtract an origin") as found:
        rts.render(part, camera, SIZE)
        rts.render(part, camera, SIZE)
    assert len([x for x in found if "subtract an origin" in str(x.message)]) == 1


WIDE = 412_345.678
"""The width of a torus, in metres, of which float32 keeps 1.6 cm, even from its middle."""


def wide_scene(origin, pixel):
    """A torus of float64, `WIDE`, around a point, and a camera above a vertex at its silhouette."""
    vertices = VERTICES * WIDE / 2.8 + origin
    above = vertices[0] + np.array([0, 0, WIDE])
    camera = rts.Camera.orthographic(above, vertices[0], (0, 1, 0), height=64 * pixel, near=WIDE / 10, far=2 * WIDE)
    return rts.Part(Mesh(FACES), {"vertices": vertices}, "silhouette"), camera


@pytest.mark.parametrize("engine", ["numpy", "torch"])
@pytest.mark.parametrize("origin", [0 * UTM, UTM], ids=["near", "far"])
def test_float64_too_wide_for_float32_warns_once_of_its_rounding_in_pixels(origin, engine):
    part, camera = wide_scene(origin, 0.05)
    if engine == "torch":
        part = part.replace(theta={"vertices": pytest.importorskip("torch").from_numpy(part.theta["vertices"])})
    with pytest.warns(
        InputWarning, match=r"of float64, .* 0.016 apart, .* 0.05 wide, .*cut it into several parts"
    ) as x:
        image = rts.render(part, camera, (64, 64))
        rts.render(part, camera, (64, 64))
    assert len([w for w in x if "cut it into" in str(w.message)]) == 1
    assert image[..., 3].max() == 1 and image[..., 3].min() == 0


def test_float64_that_is_wide_does_not_warn_where_pixels_are_wider_or_once_it_is_cut():
    part, camera = wide_scene(UTM, 0.5)
    rts.render(part, camera, (64, 64))  # Warnings are errors.
    part, camera = wide_scene(UTM, 0.05)
    piece = 4 * (FACES[:, 0] // 32) + FACES[:, 0] % 16 // 4
    parts = [part.replace(surface=Mesh(FACES[piece == i])) for i in range(64)]
    cut = rts.render(parts, camera, (64, 64))
    exact = rts.render(*wide_scene(-VERTICES[0] * WIDE / 2.8, 0.05), (64, 64))
    with pytest.warns(InputWarning, match="cut it into several parts"):
        whole = rts.render(part, camera, (64, 64))
    assert np.abs(cut - exact).max() < 0.05 < np.abs(whole - exact).max()


def test_engine_in_float32_warns_of_a_far_transform():
    """A transform and a camera of float64 are rounded beside vertices of torch in float32."""
    torch = pytest.importorskip("torch")
    moved = np.eye(4)
    moved[:3, 3] = UTM
    part = rts.Part(Mesh(FACES), {"vertices": torch.from_numpy(VERTICES.astype(np.float32))}, "normals", moved)
    with pytest.warns(InputWarning, match="transform of part 0 is in float32"):
        rts.render(part, camera_at(UTM), SIZE)


def test_ordinary_scenes_do_not_warn():
    """Float32 near the origin, seen from near and by a telephoto lens from afar; a large floor; float64 anywhere."""
    floor = 1e4 * np.array([[-1, 0, -1], [1, 0, -1], [1, 0, 1], [-1, 0, 1]])
    moved = np.eye(4)
    moved[:3, 3] = UTM
    scenes = [
        (VERTICES.astype(np.float32), FACES, None, camera_at(np.zeros(3))),
        (VERTICES.astype(np.float32), FACES, None, rts.Camera.look_at((0, 0, 1000), (0, 0, 0), fov_y=0.2)),
        (floor.astype(np.float32), [[0, 2, 1], [0, 3, 2]], None, rts.Camera.look_at((0, 1.6, 0), (0, 1, -10))),
        (VERTICES.astype(np.float32), FACES, moved, camera_at(UTM)),
        (VERTICES + UTM, FACES, None, camera_at(UTM)),
    ]
    for vertices, faces, transform, camera in scenes:
        rts.render(rts.Part(Mesh(faces), {"vertices": vertices}, "normals", transform), camera, SIZE)


def test_vertices_without_a_face_do_not_count():
    vertices = np.concatenate([VERTICES + UTM, np.zeros((1, 3))])
    part = rts.Part(Mesh(FACES), {"vertices": VERTICES}, "normals")
    near = rts.render(part, camera_at(np.zeros(3)), SIZE)
    far = rts.render(part.replace(theta={"vertices": vertices}), camera_at(UTM), SIZE)
    assert np.abs(far - near).max() < 1e-4


def test_a_file_in_map_coordinates_keeps_them(tmp_path):
    rows = [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in VERTICES + UTM]
    text = [*rows, *(f"f {a} {b} {c}" for a, b, c in FACES + 1)]
    (tmp_path / "far.obj").write_text("\n".join(text))
    (part,) = rts.load(tmp_path / "far.obj")
    assert part.theta["vertices"].shape == VERTICES.shape
    near = rts.render(rts.Part(Mesh(FACES), {"vertices": VERTICES}, "normals"), camera_at(np.zeros(3)), SIZE)
    assert np.abs(rts.render(part.replace(shader="normals"), camera_at(UTM), SIZE) - near).max() < 1e-4


@pytest.mark.parametrize("name", ["bezier", "bspline", "subdivision"])
def test_patches_in_float32_far_away_warn(name):
    part = rts.plugin("rts.surfaces", name).example()
    key = "vertices" if "vertices" in part.theta else "points"
    points = (np.asarray(part.theta[key], np.float64) + UTM).astype(np.float32)
    with pytest.warns(InputWarning, match="in float32, with coordinates up to 5e"):
        rts.render(part.replace(theta={**part.theta, key: points}), camera_at(UTM), SIZE)


@pytest.mark.parametrize("place", [0.0, 1.0, 50.0])
def test_ordinary_files_are_float32(place, tmp_path):
    rows = [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in VERTICES + place]
    (tmp_path / "near.obj").write_text("\n".join([*rows, *(f"f {a} {b} {c}" for a, b, c in FACES + 1)]))
    (part,) = rts.load(tmp_path / "near.obj")
    assert part.theta["vertices"].dtype == np.float32
