"""The compiled operations of found edges, by the kit: their array code is the rule."""

import numpy as np
import pytest
from cards import SIZE, SQUARE, card, flat, in_pixels, turned, two_colors
from found_outlines import noted
from helpers import box, icosphere

import rts
from rts.splatting import layers, stencil
from rts.splatting.layers import LAYERS
from rts.splatting.stencil import SPLAT
from rts.testing import OperationConformance

pytestmark = pytest.mark.splatting


def pane(corners, depth, color, alpha):
    """A sheet that lets light through, at a depth for each corner; colours are of its corners."""
    vertices = np.column_stack([corners, -np.broadcast_to(depth, (4,))]).astype(np.float32)
    colors = np.column_stack([color, np.full(4, alpha)]).astype(np.float32)
    shader = rts.plugin("shaders", "unlit")(opaque=False)
    return rts.Part(rts.Mesh([(0, 1, 2), (0, 2, 3)]), {"vertices": vertices, "colors": colors}, shader)


def panes():
    """Two panes that cross, before a third."""
    colors, slope = np.random.default_rng(2).random((3, 4, 3)), np.array([-2.0, 2, 2, -2])
    return [
        pane(turned(SQUARE, 0.3, (14.2, 11.7)), 20.5 + slope, colors[0], 0.7),
        pane(turned(SQUARE, -0.2, (9, 12)), 20 - slope, colors[1], 0.4),
        pane(turned(1.3 * SQUARE, 0.1, (12.3, 12.4)), 40, colors[2], 0.6),
    ]


def bodies():
    """A box that passes through a ball."""
    parts = []
    for vertices, faces in (icosphere(1, 0.7, (0.2, 0.1, 0)), box(0.5)):
        colors = np.random.default_rng(len(parts)).random((len(vertices), 3)).astype(np.float32)
        parts.append(rts.Part(rts.Mesh(faces), {"vertices": np.float32(vertices), "colors": colors}, "unlit"))
    return parts


def wave(theta, points):
    xp = rts.namespace(points)
    return xp.abs(points[:, 0]) + xp.abs(points[:, 2]) + 0.2 * points[:, 1] ** 2 - theta["radius"]


def diamond():
    """A square on its corner, whose sides pass through centres."""
    corners = 12 + 8 * np.array([(1.0, 0), (0, 1), (-1, 0), (0, -1)])
    return [card(flat(corners), (0.3, 0.9, 0.5))]


def field():
    return [rts.Part(rts.Sdf(wave, 1.6), {"radius": np.float32(0.7)}, "lambert")]


NEAR = rts.Camera.look_at((0.5, 0.7, 3.0), (0, 0, 0), fov_y=40)
SCENES = {
    "cards": (two_colors, in_pixels(), SIZE),
    "a diamond": (diamond, in_pixels(), SIZE),
    "bodies": (bodies, NEAR, (14, 18)),
    "a field": (field, NEAR, (16, 14)),
    "panes": (panes, in_pixels(), SIZE),
}
KNOWN = {}


def drawn(name):
    """What operations, by name, are given where a scene is drawn; and the outlines that its stencil is made from."""
    if name not in KNOWN:
        make, camera, size = SCENES[name]
        known = {}

        def seen(own, called):
            def call(*operands, **params):
                known.setdefault(own, operands)
                return called(*operands, **params)

            return call

        with pytest.MonkeyPatch.context() as patch, noted() as found:
            for module, (own, called) in {stencil: ("SPLAT", SPLAT), layers: ("LAYERS", LAYERS)}.items():
                patch.setattr(module, own, seen(own, called))
            rts.render(make(), camera, size, splatter="edges", layers=3 if name == "panes" else 1)
        KNOWN[name] = known, found[-1][0]
    return KNOWN[name]


def operands_of(name, operation):
    """What an operation, "SPLAT" or "LAYERS", is given where a scene is drawn."""
    return [np.asarray(x) for x in drawn(name)[0][operation]]


SAMPLE, WEIGHT, COLORS = 5, 6, 10
"""The places of `color_sample`, `color_weight` and `motion_colors` in the operands of SPLAT."""


def unseen():
    """Cards, beside some of whose outlines nothing is seen; and with entries of weight 0 at the end."""
    operands = [x.copy() for x in operands_of("cards", "SPLAT")]
    assert (operands[SAMPLE] >= 0).all() and (operands[COLORS] >= 0).all(axis=1).any()
    operands[SAMPLE][::3] = -1
    operands[COLORS][::3, 0], operands[COLORS][1::3, 1] = -1, -1
    for weight in (WEIGHT, COLORS - 1):
        operands[weight][-5:] = 0
    return operands


def test_scenes_have_pairs_and_lines_of_intersection():
    for name in ("bodies", "panes"):
        assert (drawn(name)[1].kind == 2).any()
    assert (drawn("a field")[1].rows[:, 4:] >= 0).any()


class TestSplat(OperationConformance):
    @pytest.fixture
    def operation(self):
        return SPLAT

    @pytest.fixture(params=[*SCENES, "cards, some sides unseen"])
    def operands(self, request):
        return unseen() if request.param not in SCENES else operands_of(request.param, "SPLAT")

    @pytest.fixture(params=[(0, 1), (3, 2)])
    def params(self, request):
        return dict(zip(("border", "supersample"), request.param, strict=True))


class TestLayers(OperationConformance):
    @pytest.fixture
    def operation(self):
        return LAYERS

    @pytest.fixture(params=["panes", "panes, some layers empty", "panes, some of alpha 1"])
    def operands(self, request):
        positions, rgba, row, joined, stacks = operands_of("panes", "LAYERS")
        assert len(stacks) > 100 and joined.any()
        if request.param == "panes, some of alpha 1":
            rgba = rgba.copy()
            rgba[::2, -1] = 1
        elif request.param != "panes":
            row, stacks = row.copy(), stacks.copy()
            row[0, ::3], row[1, :, ::4], stacks[::4, 0] = -1, -1, -1
            assert ((row[0] < 0) & (row[1] >= 0)).any()
        return [positions, rgba, row, joined, stacks]


def test_empty_layers_read_no_sample():
    positions, rgba, row, joined, stacks = operands_of("panes", "LAYERS")
    row, stacks = row.copy(), stacks.copy()
    row[row == 0], stacks[stacks == 0] = -1, -1
    assert (row < 0).any() and (stacks < 0).any()
    rgba = np.concatenate([np.full_like(rgba[:1], np.nan), rgba[1:]])
    assert np.isfinite(LAYERS(positions, rgba, row, joined, stacks)).all()
