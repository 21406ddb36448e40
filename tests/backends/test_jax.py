"""jax: its engine meets the kit, and every transform of a render gives the plain derivative.

`make test` runs of jax what is here and not marked `thorough`: programs take seconds to compile.
"""

import sys

import numpy as np
import pytest
from helpers import arrays, relative_error, rigid, to_numpy
from second_plugin.torus import Torus
from test_engines import (
    EYES,
    MESH,
    SCENE,
    SIMPLE,
    SIZE,
    VERTICES,
    WEIGHTS,
    assert_trees_close,
    camera_at,
    image_of,
    loss_of,
    part_of,
    plain_gradient,
    plain_image,
    with_eye,
)

import rts
from rts import Part
from rts.testing import EngineConformance

pytestmark = pytest.mark.engines


class TestJaxEngine(EngineConformance):
    @pytest.fixture
    def engine(self):
        return "jax"


@pytest.fixture(scope="module")
def jax():
    return pytest.importorskip("jax")


@pytest.fixture(scope="module")
def scene(jax):
    return arrays("jax", SCENE)


def test_jit_keeps_image_and_gradient(jax, scene):
    loss = loss_of("jax")

    @jax.jit
    def compiled(scene):
        return image_of(scene), *jax.value_and_grad(loss)(scene)

    image, value, found = compiled(scene)
    np.testing.assert_allclose(np.asarray(image), plain_image("jax"), rtol=0, atol=1e-5)
    assert float(value) == pytest.approx(float(np.sum(plain_image("jax") * WEIGHTS)), rel=1e-4)
    assert_trees_close(to_numpy(found), plain_gradient("jax"))


def test_programs_keep_nothing_that_was_traced(jax):
    faces, vertices = np.array([(0, 1, 2)]), np.array([(-1, -1, 0), (1, -1, 0), (0, 1, 0)], np.float32)
    camera = rts.Camera.look_at((0, 0, 3), (0, 0, 0))

    def total(pose):
        part = Part(rts.Mesh(faces), {"vertices": vertices}, "lambert", transform=rts.rigid(pose))
        return rts.render(part, camera, (9, 8)).sum()

    with jax.check_tracer_leaks(True):
        gradient = jax.jit(jax.grad(total))(jax.numpy.full(6, 0.01))
    assert np.isfinite(np.asarray(gradient)).all()


def test_jit_with_too_little_capacity_drops_the_deepest_layers_and_counts_them(jax, scene):
    part, camera = part_of(scene), camera_at(scene["eye"])
    whole = np.asarray(rts.sample(part, camera, SIZE, splatter=None).row) >= 0
    capacity = int(whole[0].sum()) + 5
    sampled = jax.jit(lambda p, c: rts.sample(p, c, SIZE, capacity=capacity, splatter=None))(part, camera)
    kept = np.asarray(sampled.row) >= 0
    assert int(sampled.overflow) == whole.sum() - capacity > 0
    np.testing.assert_array_equal(kept[0], whole[0])
    assert kept[1].sum() == 5 and (whole[1] | ~kept[1]).all()


@pytest.mark.thorough
def test_jacfwd_and_jacrev_are_a_loop_of_jvps(jax, scene):
    def f(eye):
        return image_of(with_eye(scene, eye), **SIMPLE)[12:14, 14:17]

    eye = scene["eye"]
    along = jax.jit(lambda e: jax.jvp(f, (eye,), (e,))[1])
    columns = [np.asarray(along(e)) for e in arrays("jax", np.eye(3))]
    expected = np.stack(columns, axis=-1)
    assert relative_error(np.asarray(jax.jit(jax.jacfwd(f))(eye)), expected) < 1e-4
    assert relative_error(np.asarray(jax.jit(jax.jacrev(f))(eye)), expected) < 1e-4


@pytest.mark.thorough
def test_hessian_is_that_of_torch(jax, scene):
    torch = pytest.importorskip("torch")
    eye = scene["eye"]
    # As docs/guides/speed.md compiles them.
    options: dict = {"xla_backend_optimization_level": 1, "xla_disable_hlo_passes": "fusion"}
    if jax.__version_info__ < (0, 8):  # jax 0.5.3 refuses the second.
        del options["xla_disable_hlo_passes"]
    else:  # Without these, which other tests do without, XLA's other emitters compile it wrongly.
        options["xla_cpu_use_fusion_emitters"] = True
    hessian = jax.hessian(lambda e: loss_of("jax")(with_eye(scene, e), **SIMPLE))
    found = jax.jit(hessian, compiler_options=options)(eye)
    scene = arrays("torch-cpu", SCENE)
    loss = loss_of("torch-cpu")
    expected = torch.func.hessian(lambda e: loss(with_eye(scene, e), **SIMPLE))(scene["eye"])
    assert relative_error(np.asarray(found), to_numpy(expected)) < 1e-3


@pytest.mark.thorough
def test_vmap_and_jit_over_cameras_are_a_loop_for_gradients(jax, scene):
    weights = arrays("jax", WEIGHTS)
    slope = jax.value_and_grad(lambda eye: (image_of(with_eye(scene, eye)) * weights).sum())
    values, gradients = jax.jit(jax.vmap(slope))(arrays("jax", EYES))
    for i, eye in enumerate(arrays("jax", EYES)):
        value, expected = slope(eye)
        assert float(values[i]) == pytest.approx(float(value), rel=1e-4)
        assert relative_error(np.asarray(gradients[i]), np.asarray(expected)) < 1e-4


def test_records_are_arguments_of_jit_and_grad(jax, scene):
    part, camera = part_of(scene), camera_at(scene["eye"])
    weights = arrays("jax", WEIGHTS)
    found = jax.grad(lambda p: (rts.render(p, camera, SIZE) * weights).sum())(part)
    assert isinstance(found, Part) and found.surface is MESH and found.shader == "lambert"
    assert relative_error(np.asarray(found.transform), plain_gradient("jax")["transform"]) < 1e-4
    traces = []

    @jax.jit
    def f(part, camera):
        traces.append(1)
        return rts.render(part, camera, SIZE, **SIMPLE)

    image = f(part, camera)
    np.testing.assert_allclose(np.asarray(image), image_of(SCENE, **SIMPLE), rtol=0, atol=1e-5)
    f(part.replace(transform=arrays("jax", np.eye(4))), camera)
    assert len(traces) == 1
    unlit = f(part.replace(shader="unlit"), camera)
    assert len(traces) == 2
    assert np.abs(np.asarray(unlit - image)).max() > 0.01


def test_samples_taken_outside_jit_are_rendered_inside(jax, scene):
    part, camera = part_of(scene), camera_at(scene["eye"])
    sampled = rts.sample(part, camera, SIZE)
    inside = jax.jit(rts.render_samples)(sampled, [part], camera)
    np.testing.assert_allclose(np.asarray(inside), plain_image("jax"), rtol=0, atol=5e-6)


COMPILED = []


@pytest.fixture(scope="module")
def compilations(jax):
    """A list that grows by one with each compilation of jax."""

    def heard(event, duration, **_):
        if event == "/jax/core/compile/backend_compile_duration":
            COMPILED.append(duration)

    jax.monitoring.register_event_duration_secs_listener(heard)
    x = jax.numpy.ones(7919)
    before = len(COMPILED)
    jax.jit(lambda x: x * 2.7182)(x)
    assert len(COMPILED) == before + 1, "the listener does not hear compilations"
    return COMPILED


@pytest.mark.thorough
def test_eager_jax_compiles_only_at_the_first_pose_of_each_bucket(jax, compilations):
    part = Part(MESH, {"vertices": VERTICES}, "unlit")
    camera = camera_at(EYES[0])
    counts, buckets = set(), []
    for i in range(50):
        pose = arrays("jax", rigid((0, 1, 0), 7 * i, (0, 0, 0.02 * i)))
        moving = part.replace(transform=pose)
        before = len(compilations)
        sampled = rts.sample(moving, camera, (3 * SIZE[0], 3 * SIZE[1]))
        jax.grad(lambda t, s=sampled: rts.render_samples(s, part.replace(transform=t), camera).sum())(pose)
        rows = sampled.samples[0].ids.shape[0]
        assert len(compilations) == before or rows not in buckets, f"pose {i} compiled again for {rows} rows"
        counts.add(int((sampled.row >= 0).sum()))
        buckets.append(rows)
    assert len(counts) > 20 and 2 <= len(set(buckets)) <= 4


def test_map_rows_is_one_loop_in_a_compiled_program(jax):
    engine, calls = rts.engine_of(jax.numpy.zeros(1)), []

    def f(x):
        calls.append(x.shape[0])
        return 2 * x + 1

    rows = np.arange(23, dtype=np.float32)
    np.testing.assert_array_equal(jax.jit(lambda x: engine.map_rows(f, x, 5))(rows), 2 * rows + 1)
    assert set(calls) == {5} and len(calls) < 5


def test_a_loop_in_a_program_is_one_loop(jax):
    """Rays at a torus, which are traced in steps."""
    part, camera = Torus.example(), camera_at(EYES[0])

    def total(radii):
        return rts.render(part.replace(theta={**part.theta, "radii": radii}), camera, SIZE, layers=2).sum()

    radii = jax.numpy.asarray(part.theta["radii"])
    for f in (total, jax.grad(total), lambda radii: jax.vmap(total)(jax.numpy.stack([radii, radii]))):
        assert str(jax.make_jaxpr(f)(radii)).count("while[") == 1


def fan(count):
    """A shallow cone of `count` triangles, as vertices and faces."""
    turn, around = np.linspace(0, 2 * np.pi, count, endpoint=False), np.arange(count)
    rim = np.stack([np.cos(turn), np.sin(turn), 0.2 * np.cos(3 * turn)], axis=-1)
    faces = np.stack([around, (around + 1) % count, np.full(count, count)], axis=-1)
    return np.concatenate([rim, [[0, 0, 0.3]]]).astype(np.float32), faces


def mesh_of(i):
    vertices, faces = fan(200 + i)
    return rts.Mesh(faces), {"vertices": vertices}


def cage_of(i):
    count = 20 + i
    (rim, _), around = fan(count), np.arange(count)
    shift = np.array([0, 0, 0.5], np.float32)
    sides = np.stack([around, (around + 1) % count, (around + 1) % count + count, around + count], axis=-1)
    return rts.Subdivision(sides), {"vertices": np.concatenate([rim[:-1] - shift, rim[:-1] + shift])}


def level_set_of(i):
    x, y, z = np.meshgrid(*[np.linspace(-1, 1, 17)] * 3, indexing="ij")
    values = np.sqrt(x * x + y * y + z * z) - 0.5 - 0.1 * np.sin(i + 7 * x) * np.sin(5 * y)
    return rts.Isosurface(((-1, -1, -1), (1, 1, 1))), {"values": values.astype(np.float32)}


def resident_and_maps():
    """Mebibytes of memory, and the number of memory maps, of this process."""
    with open("/proc/self/statm") as file:
        pages = int(file.read().split()[1])
    with open("/proc/self/maps") as file:
        return pages * 4096 / 2**20, sum(1 for _ in file)


@pytest.mark.thorough
@pytest.mark.skipif(sys.platform != "linux", reason="/proc tells of memory")
@pytest.mark.parametrize("surface_of", [mesh_of, cage_of, level_set_of])
def test_a_fit_with_ever_new_topologies_keeps_nothing(jax, surface_of):
    camera = rts.Camera.look_at((0, 0.5, 3), (0, 0, 0), fov_y=40)
    try:
        surface_of(0)
    except AttributeError as error:
        pytest.skip(str(error))
    known = None
    for i in range(34):
        surface, theta = surface_of(i)

        def loss(theta, surface=surface):
            return (rts.render(rts.Part(surface, theta, "lambert"), camera, (32, 32)) ** 2).mean()

        _, gradient = jax.value_and_grad(loss)(jax.device_put(theta))
        assert all(np.abs(np.asarray(x)).max() > 0 for x in gradient.values())
        if i == 3:  # The programs are compiled.
            known = resident_and_maps()
    memory, maps = (later - first for later, first in zip(resident_and_maps(), known, strict=True))
    assert memory < 30 and maps < 30, f"30 topologies kept {memory:.0f} MB and {maps} memory maps"
