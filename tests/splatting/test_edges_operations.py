"""The compiled operations of found edges, by the kit: their array code is the rule."""

import numpy as np
import pytest
from cards import SIZE, SQUARE, card, flat, in_pixels, turned, two_colors
from helpers import box, icosphere

import rts
from rts.splatting.edges import splatter, stack_sides, stacks
from rts.splatting.edges.splatter import EDGES, FIELDS
from rts.splatting.edges.stack_sides import SIDES
from rts.splatting.edges.stacks import CELLS
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
    "bodies": (bodies, NEAR, (14, 17)),
    "a field": (field, NEAR, (16, 15)),
    "panes": (panes, in_pixels(), SIZE),
}
KNOWN = {}


def operands_of(name, operation):
    """What an operation, "EDGES", "CELLS" or "SIDES", is given where a scene is drawn."""
    if (name, operation) not in KNOWN:
        make, camera, size = SCENES[name]
        known = KNOWN[name, operation] = {}

        def noted(own, called):
            def call(*operands, **params):
                known.setdefault(own, operands)
                return called(*operands, **params)

            return call

        with pytest.MonkeyPatch.context() as patch:
            modules = {splatter: ("EDGES", EDGES), stacks: ("CELLS", CELLS), stack_sides: ("SIDES", SIDES)}
            for module, (own, called) in modules.items():
                patch.setattr(module, own, noted(own, called))
            # NumPy has no derivatives, so that it does without SIDES.
            engine = "torch" if operation == "SIDES" else None
            rts.render(make(), camera, size, splatter="edges", layers=3 if name == "panes" else 1, engine=engine)
    return [np.asarray(x) for x in KNOWN[name, operation][operation]]


def unseen():
    """Cards, beside some of whose breaks nothing is seen."""
    operands = operands_of("cards", "EDGES")
    at = 3 + FIELDS.index("rows")
    rows = operands[at].copy()
    assert (operands[3 + FIELDS.index("inner")][::3, 0] >= 0).any()
    rows[::3, 0] = -1
    operands[at] = rows
    return operands


def test_scenes_have_pairs_and_lines_of_crossing_and_slopes():
    near, pair = 3 + FIELDS.index("near"), 3 + FIELDS.index("pair")
    assert (operands_of("bodies", "EDGES")[near] == 2).any()
    assert (operands_of("panes", "EDGES")[near] == 2).any()
    assert (operands_of("a field", "EDGES")[pair] >= 0).any()


class TestEdges(OperationConformance):
    @pytest.fixture
    def operation(self):
        return EDGES

    @pytest.fixture(params=[*SCENES, "cards, some sides unseen"])
    def operands(self, request):
        return unseen() if request.param not in SCENES else operands_of(request.param, "EDGES")

    @pytest.fixture(params=[0, 3])
    def params(self, request):
        return {"border": request.param}


class TestCells(OperationConformance):
    @pytest.fixture
    def operation(self):
        return CELLS

    @pytest.fixture(params=["panes", "panes, some layers empty", "panes, some of alpha 1"])
    def operands(self, request):
        positions, rgba, row, joined = operands_of("panes", "CELLS")
        if request.param == "panes, some of alpha 1":
            rgba = rgba.copy()
            rgba[::2, -1] = 1
        elif request.param != "panes":
            row = row.copy()
            row[0, ::3], row[1, :, ::4] = -1, -1
            assert ((row[0] < 0) & (row[1] >= 0)).any()
        return [positions, rgba, row, joined]


def test_empty_layers_read_no_sample():
    positions, rgba, row, joined = operands_of("panes", "CELLS")
    row = row.copy()
    row[row == 0] = -1
    assert (row < 0).any()
    rgba = np.concatenate([np.full_like(rgba[:1], np.nan), rgba[1:]])
    assert np.isfinite(CELLS(positions, rgba, row, joined)).all()


class TestSides(OperationConformance):
    @pytest.fixture
    def operation(self):
        return SIDES

    @pytest.fixture
    def operands(self):
        return operands_of("panes", "SIDES")
