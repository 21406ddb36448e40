"""Scenes that are broken on purpose: `check_gradient` names the reason, and does not name it once they are mended."""

import functools
import time

import numpy as np
import pytest
from helpers import arrays, icosphere, quad, quick

import rts
from rts.arrays.engines import engine_of
from rts.arrays.trees import leaves
from rts_diagnostics.gradient_reasons import disagreeing, shared_budget
from rts_diagnostics.gradient_reasons.reasons import KINDS
from rts_diagnostics.gradient_reasons.subject import Subject

pytestmark = pytest.mark.rendering

MESH = rts.plugin("rts.surfaces", "mesh")
SIZE = (32, 32)
CAMERA = rts.Camera.orthographic((0, 0, 20), (0, 0, 0), height=32)  # A world unit is a pixel.
EYE = rts.Camera.look_at((0, 0, 4), (0, 0, 0), fov_y=40, near=0.5, far=20)
RED, BLUE = np.array([0.9, 0.3, 0.2]), np.array([0.2, 0.4, 0.9])


def constant(x, value):
    return engine_of(x).constant(value, x)


def flat(vertices, faces, color, **fields):
    colors = np.tile(color.astype(np.float32), (len(vertices), 1))
    return rts.Part(MESH(faces), {"vertices": vertices, "colors": colors}, "unlit", **fields)


SLANT = np.array([[0.96, -0.28, 0], [0.28, 0.96, 0], [0, 0, 1]], np.float32)
"""Edges along rows of pixels are what few samples show worst."""


def card(left, right, bottom, top, z, color, **fields):
    vertices, faces = quad(left, right, bottom, top, z)
    return flat(vertices @ SLANT.T, faces, color, **fields)


def moved(part, shift):
    """A part whose vertices are shifted; some components of the shift may be left out."""
    xp, vertices = rts.namespace(shift), part.theta["vertices"]
    full = xp.concat([shift, constant(shift, np.zeros(3 - shift.shape[0]))]) if shift.shape[0] < 3 else shift
    return part.replace(theta={**part.theta, "vertices": constant(shift, vertices) + full})


NEAR = card(-7.3, 6.4, -6.1, 8.2, 0, RED)
ZERO = np.array([0.1, 0.2])


def outside(mended):
    start = np.array([0.1 if mended else 40.0, 0.2])
    return lambda p: (moved(NEAR, p), CAMERA), start, {}


def behind(mended):
    vertices, faces = quad(-0.6, 0.7, -0.5, 0.6, 0.0 if mended else 6.0)
    return lambda p: (moved(flat(vertices, faces, RED), p), EYE), ZERO, {}


def hidden(mended):
    front = card(-12.2, 11.3, -11.4, 12.1, 5, BLUE)
    small = card(-4.3, 5.2, -3.4, 4.1, 8 if mended else 0, RED)
    return lambda p: ([front, moved(small, p)], CAMERA), ZERO, {}


def hidden_by_itself(mended):
    """A vertex on the side of a ball that is turned away."""
    vertices, faces = icosphere(2, radius=9.0)
    index = int(np.argmax(vertices[:, 2] * (1 if mended else -1)))

    def scene(p):
        one = np.zeros((len(vertices), 1), np.float32)
        one[index] = 1
        theta = {"vertices": constant(p, vertices) + constant(p, one) * p}
        return rts.Part(MESH(faces), theta, "normals"), CAMERA

    return scene, np.zeros(3), {}


def culled(mended):
    part = flat(NEAR.theta["vertices"], quad()[1] if mended else quad()[1][:, ::-1], RED, cull="back")
    return lambda p: (moved(part, p), CAMERA), ZERO, {}


def glass(theta, gbuffer, camera):
    """Half transparent."""
    return 0.5 * rts.plugin("rts.shaders", "unlit")()(theta, gbuffer, camera)


def layers(mended):
    """A pane behind a pane."""
    panes = [card(-9.2, 8.3, -8.4, 8.1, 5, BLUE), card(-5.3, 4.2, -4.4, 4.1, 0, RED)]
    panes = [p.replace(shader=glass) for p in panes]
    options = {"splatter": "multi", "layers": 2 if mended else 1}
    return lambda p: ([panes[0], moved(panes[1], p)], CAMERA), ZERO, options


def transparent(mended):
    """Three panes behind each other, of which `multi` averages the last two."""
    sides = (-9.2, 8.3, -8.4, 8.1, 5, BLUE), (-8.1, 9.2, -8.2, 9.3, 0, BLUE), (-5.3, 4.2, -4.4, 4.1, -5, RED)
    panes = [card(*side).replace(shader=glass) for side in sides]
    options = {"layers": 4} if mended else {"layers": 4, "splatter": "multi"}
    return lambda p: ([*panes[:2], moved(panes[2], p)], CAMERA), ZERO, options


def outlines(mended):
    return lambda p: (moved(NEAR, p), CAMERA), ZERO, {"splatter": "auto" if mended else "none"}


def reach(mended):
    """A square loss of a target that the object does not touch, or touches."""
    target = rts.render(card(4.3 if mended else 9.3, 13.2, -4.1, 4.2, 0, RED), CAMERA, SIZE)
    part = card(-11.3, 6.4 if mended else -5.4, -3.2, 3.4, 0, RED)
    loss = lambda image: ((image - constant(image, target)) ** 2).mean()  # noqa: E731
    return lambda p: (moved(part, p), CAMERA), np.array([0.1]), {"loss": loss, "splatter": "multi", "layers": 2}


def bounded(mended):
    """Values on a lattice, some of whose crossed edges have hardly any slope: those across its right outline."""
    axes = np.meshgrid(*[np.linspace(-1, 1, 7)] * 3, indexing="ij")
    values = (np.linalg.norm(np.stack(axes), axis=0) - 0.73).astype(np.float32)
    if not mended:
        x, y, z = np.argwhere((values[3:-1] < 0) & (values[4:] > 0)).T
        values[x + 3, y, z], values[x + 4, y, z] = -1e-5, 1e-5
    surface = rts.plugin("rts.surfaces", "isosurface")(((-1, -1, -1), (1, 1, 1)), motion="edge")

    def scene(p):
        return rts.Part(surface, {"values": constant(p, values) + p}), EYE

    return scene, np.zeros(()), {"loss": lambda image: image[..., 3].sum()}


def numpy_transform(mended):
    """A pose that goes through NumPy beside a colour that does not."""

    def scene(p):
        transform = rts.rigid(p["pose"])
        if not mended:
            transform = transform.detach().numpy()
        vertices, faces = quad(-7.3, 6.4, -6.1, 8.2)
        return rts.Part(MESH(faces), {"vertices": vertices, "color": p["color"]}, "unlit", transform), CAMERA

    return scene, {"pose": np.array([0.0, 0, 0, 0.1, 0.2, 0]), "color": RED}, {"entries": 2}


def all_numpy(mended):
    """Vertices that go through NumPy, where nothing else has a derivative."""

    def scene(p):
        part = moved(NEAR, p)
        vertices = part.theta["vertices"]
        return part if mended else part.replace(theta={**part.theta, "vertices": vertices.detach().numpy()}), CAMERA

    return scene, ZERO, {"entries": 2}


def cut(mended):
    """Vertices that are cut off from the parameters."""
    return lambda p: (moved(NEAR, p if mended else engine_of(p).stop_gradient(p)), CAMERA), ZERO, {}


def infinite(mended):
    """A length whose derivative at 0 is 0 / 0."""

    def scene(p):
        xp = rts.namespace(p)
        return moved(NEAR, xp.stack([xp.sqrt(p[0] * p[0]), p[1]])), CAMERA

    return scene, np.array([0.1 if mended else 0.0, 0.2]), {}


def held(mended):
    """A number that nothing but a shader holds, of a part that is hidden."""
    front, small = card(-12.2, 11.3, -11.4, 12.1, 5, BLUE), card(-4.3, 5.2, -3.4, 4.1, 8 if mended else 0, RED)

    def scene(p):
        def shader(theta, gbuffer, camera):
            return constant(p, np.ones((gbuffer["position"].shape[0], 1))) * (constant(p, [*RED, 1]) * p)

        return [front, small.replace(shader=shader)], CAMERA

    return scene, np.array(0.8), {"engine": "torch"}


def unused(mended):
    start = {"shift": ZERO, "scale": np.array(1.5)}
    return lambda p: (moved(NEAR, p["shift"] * p["scale"] if mended else p["shift"]), CAMERA), start, {}


def gauge(mended):
    """A colour and a gain that multiplies it."""

    def scene(p):
        color = p["color"] if mended else p["color"] * p["gain"]
        return NEAR.replace(theta={"vertices": NEAR.theta["vertices"], "color": color}), CAMERA

    color = {"color": np.array([0.5, 0.3, 0.2])}
    return scene, color if mended else {**color, "gain": np.array(1.1)}, {"entries": 3}


def depth(mended):
    """The distance of a card, without perspective or, `mended`, with it."""
    part = card(-0.9, 0.8, -0.7, 0.9, 0.0, RED)
    camera = EYE if mended else rts.Camera.orthographic((0, 0, 4), (0, 0, 0), height=3)
    xp = rts.namespace
    return lambda p: (moved(part, xp(p).stack([0 * p, 0 * p, p])), camera), np.array(0.0), {}


def striped(mended):
    """A card that is red right of a place in the world, and blue left of it; `mended`, it is a ramp."""

    def scene(p):
        def shader(theta, gbuffer, camera):
            xp, x = rts.namespace(p), gbuffer["position"][:, :1] - p[1]
            red = 1 / (1 + xp.exp(-x / 1.5)) if mended else xp.where(x > 0.2, 1.0 + 0 * x, 0 * x)
            return xp.concat([constant(p, RED) * red + constant(p, BLUE) * (1 - red), 1 + 0 * x], axis=1)

        shader.opaque = True
        return moved(NEAR.replace(shader=shader), p[:1]), CAMERA

    return scene, np.array([0.1, 0.3]), {"entries": 2}


SCENES = {
    striped: "steps",
    outside: "outside",
    behind: "outside",
    hidden: "hidden",
    hidden_by_itself: "hidden",
    culled: "culled",
    outlines: "outlines",
    transparent: "transparent",
    layers: "layers",
    reach: "reach",
    bounded: "bounded",
    numpy_transform: "constant",
    all_numpy: "constant",
    cut: "constant",
    infinite: "infinite",
    held: "hidden",
    unused: "unused",
    gauge: "undetermined",
    depth: "undetermined",
}


@functools.cache
def check(make, mended, **options):
    scene, start, given = make(mended)
    usual = {"budget_s": 600, "samples": 5, "entries": 1}
    options = usual | given | options
    return rts.check_gradient(scene, arrays("torch-cpu", start), SIZE, **options)


@pytest.mark.parametrize("make", SCENES)
def test_what_is_broken_is_named(make):
    found = check(make, mended=False)
    kind = SCENES[make]
    named = [r for r in found.reasons if r.kind == kind]
    assert named and found.reasons[0].kind == kind
    assert all(r.kind in KINDS for r in found.reasons)
    for reason in named:
        assert reason.text in str(found)
        if reason.color != "none" and reason.pixels.any():
            assert f"{reason.color} = {reason.kind}" in str(found)


@pytest.mark.parametrize("make", quick(SCENES, 8))
def test_what_is_mended_is_not_named(make):
    assert SCENES[make] not in {r.kind for r in check(make, mended=True).reasons}


@pytest.mark.parametrize("at", [0.3, 0.37])
def test_steps_are_named_where_a_number_moves_nothing_else(at):
    """The place of the step itself: at 0.3 it lies on centres of pixels, else between these."""
    scene, _, _ = striped(False)
    start = arrays("torch-cpu", np.array([0.1, at]))
    found = rts.check_gradient(scene, start, SIZE, budget_s=600, samples=5)
    reasons = [r for r in found.reasons if "parameters[1]" in r.parameters]
    assert [r.kind for r in reasons] == ["steps"] and "colours of part 0 step" in reasons[0].text
    columns = np.flatnonzero(reasons[0].pixels.any(axis=0))
    assert len(columns) and np.abs(columns + 0.5 - (16.2 + at)).max() < 4


def test_a_gradient_that_agrees_needs_no_reason():
    found = check(culled, mended=True)
    assert found.ok and found.reasons == [] and "picture" not in str(found)


def test_the_text_names_what_is_changed_where_and_what_to_do():
    (found,) = check(all_numpy, mended=False).reasons
    assert found.parameters == ["parameters[0]", "parameters[1]"]
    assert "part 0's theta.vertices changes with it, but is NumPy" in found.text
    assert f"{found.pixels.sum()} pixels, 100% of the disagreement" in found.text
    assert "torch arrays throughout" in found.text
    (found,) = check(outside, mended=False).reasons
    assert "part 0 lies outside of the view, beyond its right edge" in found.text and not found.pixels.any()
    (found,) = check(gauge, mended=False).reasons
    assert "with" in found.text and "gain" not in found.parameters and "color[0]" in found.text


def test_the_advice_on_layers_is_enough():
    found = check(layers, mended=False)
    assert "Raise layers to 2" in found.reasons[0].text
    assert not check(layers, mended=False, layers=2).reasons


def test_a_splatter_may_be_an_object():
    found = check(layers, mended=False, splatter=rts.plugin("rts.splatters", "multi")())
    assert [r.kind for r in found.reasons] == ["layers"]


def test_a_splatter_without_forward_mode_is_told():
    import torch

    class Backward(torch.autograd.Function):
        @staticmethod
        def forward(ctx, x):
            return 1.0 * x

        @staticmethod
        def backward(ctx, *g):
            return g[0]

    class Front(rts.Splatter):
        def image(self, splats):
            return Backward.apply(rts.plugin("rts.splatters", "none")().image(splats))

    found = check(outlines, mended=True, splatter=Front())
    assert not found.ok and not found.reasons and "forward mode does not go through" in str(found)


def test_arrays_of_changing_length_are_named():
    def scene(p):
        angle = np.linspace(0, 6, int(10 * p.item()) + 3)
        vertices = np.stack([9 * np.cos(angle), 9 * np.sin(angle), 0 * angle], axis=1).astype(np.float32)
        faces = np.array([(0, i, i + 1) for i in range(1, len(angle) - 1)], np.int32)
        return flat(vertices, faces, RED), CAMERA

    (found,) = rts.check_gradient(scene, arrays("torch-cpu", np.array(0.5)), SIZE, samples=3).reasons
    assert found.kind == "constant" and "theta.vertices" in found.text and "change with it, but are NumPy" in found.text


def test_a_minimum_is_not_flat():
    wall = card(-90, 90, -90, 90, 0, RED)
    scene = lambda p: (wall.replace(theta={"vertices": wall.theta["vertices"], "color": p}), CAMERA)  # noqa: E731
    start = arrays("torch-cpu", RED)
    loss = lambda image: ((image[..., :3] - start) ** 2).mean()  # noqa: E731
    assert not rts.check_gradient(scene, start, (8, 64), loss=loss, samples=2).reasons


def test_what_a_spent_budget_leaves_out_of_a_number_is_told(monkeypatch):
    clock = iter([True] * 3)
    scene, start, _ = outlines(False)
    monkeypatch.setattr(shared_budget.Clock, "going", lambda self, share=1.0: share < 1 or next(clock, False))
    monkeypatch.setattr(disagreeing, "EXPERIMENTS", disagreeing.EXPERIMENTS[:1] * 9)
    found = rts.check_gradient(scene, arrays("torch-cpu", start), SIZE, splatter="none", samples=3)
    assert not found.reasons and "or not all, in 2 of them" in found.note


@pytest.fixture
def costly(monkeypatch):
    """A clock on which only hard renders take time; the square roots of their samples a pixel, and the numbers."""
    now, drawn, hard = [0.0], [], Subject.hard

    def slow(subject, direction, by, samples, change=None):
        now[0] += 0.15 * samples**2  # A number by 8² and 9² samples takes a minute.
        if by:
            drawn.append((samples, tuple(np.concatenate([np.ravel(x) for x in leaves(direction)]))))
        return hard(subject, direction, by, samples, change)

    monkeypatch.setattr(shared_budget, "perf_counter", lambda: now[0])
    monkeypatch.setattr(Subject, "hard", slow)
    return now, drawn


@pytest.mark.parametrize("budget, finest", [(60, 4), (130, 6), (500, 9)])
def test_every_number_has_its_turn_within_the_budget(costly, budget, finest):
    now, drawn = costly
    scene, start, given = outlines(True)
    found = rts.check_gradient(scene, arrays("torch-cpu", start), SIZE, budget_s=budget, **given)
    numbers = {number for _, number in drawn}
    assert now[0] <= budget and len(found.slopes) == len(numbers) == 2
    assert max(samples for samples, _ in drawn) == finest
    if finest < 9:
        first = drawn[: len(drawn) // 2]
        assert {number for _, number in first} == numbers and all(samples <= 3 for samples, _ in first)
        assert "the differences of 2 are of fewer samples than asked for" in found.note


def test_reasons_are_looked_for_in_every_number_before_any_is_tried_twice(monkeypatch):
    now, tried = [0.0], []

    def slow(case, touched):
        now[0] += 5
        tried.append(case.number.slope.name)

    scene, start, _ = outlines(False)
    monkeypatch.setattr(shared_budget, "perf_counter", lambda: now[0])
    monkeypatch.setattr(disagreeing, "EXPERIMENTS", (slow,) * 4)
    found = rts.check_gradient(scene, arrays("torch-cpu", start), SIZE, splatter="none", samples=3, budget_s=20)
    first, second = (s.name for s in found.slopes)
    assert tried == [first, first, second, second]
    now[0], tried[:] = 0.0, []
    rts.check_gradient(scene, arrays("torch-cpu", start), SIZE, splatter="none", samples=3, budget_s=42)
    assert tried == [first] * 4 + [second] * 4


def test_pixels_are_where_the_derivatives_disagree():
    found = check(outlines, mended=False)
    (reason,) = found.reasons
    inside = np.zeros(SIZE, bool)
    inside[12:18, 13:18] = True
    assert reason.pixels.any() and not (reason.pixels & inside).any()
    on = found.picture[reason.pixels]
    assert found.picture.shape == (*SIZE, 3) and (on[:, 0] > 5 * on[:, 1]).all()  # Red, as the legend says.
    assert np.ptp(found.picture[inside], axis=-1).max() < 1e-6  # Grey.


def test_a_picture_can_be_saved(tmp_path):
    from PIL import Image

    rts.save_image(tmp_path / "why.png", check(hidden, mended=False).picture)
    pixels = np.asarray(Image.open(tmp_path / "why.png"))
    assert tuple(KINDS["hidden"][1]) in set(map(tuple, pixels.reshape(-1, 3)))


def test_shares_tell_what_explains_most():
    """A splatter without outlines."""
    found = check(outlines, mended=False)
    assert {r.kind for r in found.reasons} == {"outlines"} and "% of the disagreement" in found.reasons[0].text


def test_a_budget_that_is_spent_is_told():
    begun = time.perf_counter()
    found = check(numpy_transform, mended=False, budget_s=1e-3)
    assert time.perf_counter() - begun < 10
    assert len(found.slopes) == 1 and "1 of 4 numbers were looked at" in found.note and found.note in str(found)
    assert "reasons were not looked for, or not all, in 1 of them" in found.note and not found.reasons


def test_progress_is_shown_where_it_is_wanted(capsys):
    check.__wrapped__(culled, mended=False, progress=True)
    told = capsys.readouterr().err
    assert "derivatives" in told and "reasons" in told
    check.__wrapped__(culled, mended=False, budget_s=1e-3)
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize(
    "change, said",
    [
        ({"budget_s": 0}, "budget_s is 0; expected a positive number of seconds"),
        ({"budget_s": "60"}, "budget_s is '60'; expected a positive number"),
        ({"budget_s": float("nan")}, "budget_s is nan; expected a positive number"),
        ({"budget_s": True}, "budget_s is True; expected a positive number"),
        ({"progress": "yes"}, "progress is 'yes'; expected True, False, or None"),
    ],
)
def test_bad_budgets_are_refused(change, said):
    with pytest.raises(rts.InputError, match=said) as error:
        check(culled, mended=True, **change)
    assert "\n" not in str(error.value)


def test_colours_of_kinds_are_distinct():
    used = [color for _, color in KINDS.values() if color is not None]
    names = [name for name, color in KINDS.values() if color is not None]
    assert len(set(used)) == len(used) == len(set(names)) >= 11
