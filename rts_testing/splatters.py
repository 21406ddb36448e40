"""Checks that every splatter must pass."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from rts.plugin_api.records import Cells, Splats
from rts.tool_api.plugins import check_splatter, promised
from rts_testing import derivatives
from rts_testing.claims import claim, claim_close, no_error
from rts_testing.conformance import Conformance
from rts_testing.derivatives import DIFFERENTIABLE, ENGINES, differentiating, engine_or_skip

HEIGHT, WIDTH, LAYERS = 8, 9, 2
CELLS = HEIGHT * WIDTH * LAYERS
TOLERANCE = 1e-5


class SplatterConformance(Conformance):
    """Checks of a splatter.

    Override the fixture `splatter`: its name, or an object. Set `moves_edges = False` if it has no derivative at
    outlines, on purpose.
    """

    moves_edges = True

    @pytest.fixture
    def splatter(self) -> Any:
        """Name or object of the splatter."""
        raise NotImplementedError("override the fixture 'splatter' with the splatter, or its name")

    # ------------------------------------------------------------------------------------------- values

    def test_it_reads_what_there_is(self, splatter: Any) -> None:
        """`reads` names nothing but "outlines" and "colors at centers"."""
        unknown = set(check_splatter(splatter).reads) - {"outlines", "colors at centers"}
        claim(not unknown, f"reads names {sorted(unknown)}; expected 'outlines', 'colors at centers', or nothing")

    def test_a_constant_interior_stays(self, splatter: Any) -> None:
        """An opaque colour is reproduced away from the image's border, from one layer or two."""
        color = np.array([0.2, 0.5, 0.9, 1.0], np.float32)
        for layers in (1, 2):
            splats = everywhere(layers)
            image = _splat(splatter, splats.replace(rgba=np.broadcast_to(color, splats.rgba.shape)))
            claim(image.shape == (HEIGHT, WIDTH, 4), f"the image is {image.shape}; expected {(HEIGHT, WIDTH, 4)}")
            r = check_splatter(splatter).reach
            inside = image[r : HEIGHT - r, r : WIDTH - r]
            expected = np.broadcast_to(color, inside.shape)
            claim_close(inside, expected, TOLERANCE, f"a constant colour of {layers} layers")

    def test_the_front_layer_hides_those_behind(self, splatter: Any) -> None:
        """An opaque front layer that covers everything hides all others."""
        splats = everywhere(LAYERS)
        rgba = splats.rgba.copy()
        rgba[splats.row[0].ravel()] = [1, 0, 0, 1]
        rgba[splats.row[1].ravel()] = [0, 1, 0, 1]
        r = check_splatter(splatter).reach
        image = _splat(splatter, splats.replace(rgba=rgba))[r : HEIGHT - r, r : WIDTH - r]
        claim_close(image, np.broadcast_to([1, 0, 0, 1], image.shape), TOLERANCE, "the color of a covered surface")

    def test_light_passes_through_translucent_layers(self, splatter: Any) -> None:
        """A splatter that promises to be `translucent` composites a front layer of alpha ½ over the one behind."""
        if not promised(check_splatter(splatter), "translucent"):
            pytest.skip("the splatter does not promise to be translucent")
        splats = everywhere(LAYERS)
        rgba = splats.rgba.copy()
        rgba[splats.row[0].ravel()] = [0.5, 0, 0, 0.5]
        rgba[splats.row[1].ravel()] = [0, 1, 0, 1]
        r = check_splatter(splatter).reach
        image = _splat(splatter, splats.replace(rgba=rgba, opaque=False))[r : HEIGHT - r, r : WIDTH - r]
        claim_close(image, np.broadcast_to([0.5, 0.5, 0, 1], image.shape), TOLERANCE, "the colour of two layers")

    def test_empty_cells_stay_empty(self, splatter: Any) -> None:
        """The image is zero where no cell within reach has a sample; a lone sample shows most in its own cell."""
        splats = everywhere(LAYERS)
        image = _splat(splatter, splats.replace(row=np.full_like(splats.row, -1)))
        claim((image == 0).all(), "an image without samples is not zero; row −1 means that there is none")
        row = np.full_like(splats.row, -1)
        row[:, 2, 3] = splats.row[:, 2, 3]
        image = _splat(splatter, splats.replace(row=row))
        far, r = np.ones((HEIGHT, WIDTH), bool), check_splatter(splatter).reach
        far[max(0, 2 - r) : 3 + r, max(0, 3 - r) : 4 + r] = False
        claim((image[far] == 0).all(), f"a sample reaches beyond the cells that `reach` says, {r} on each side")
        own_cell, most = image[2, 3, 3], image[..., 3].max()
        claim(
            0 < own_cell == most, f"a sample shows with {own_cell:.3g} in its own cell, and with {most:.3g} in another"
        )

    def test_colors_stay_premultiplied(self, splatter: Any) -> None:
        """The image of scattered samples has 0 ≤ colour ≤ alpha ≤ 1."""
        image = _splat(splatter, scattered())
        low, alpha = image.min(), image[..., 3].max()
        claim(low >= -TOLERANCE and alpha <= 1 + TOLERANCE, f"values from {low:.3g}, alpha to {alpha:.3g}")
        above = (image[..., :3] - image[..., 3:]).max()
        claim(above <= TOLERANCE, f"a colour exceeds its alpha by {above:.3g}")

    def test_the_order_of_packed_rows_has_no_effect(self, splatter: Any) -> None:
        """The image stays the same if rows are permuted, and `row` with them."""
        splats, order = scattered(), np.random.default_rng(2).permutation(CELLS)
        row = np.where(splats.row >= 0, np.argsort(order)[splats.row], -1).astype(np.int32)
        image = _splat(splatter, Splats(splats.positions[order], splats.rgba[order], Cells(row)))
        claim_close(image, _splat(splatter, splats), TOLERANCE, "the image of permuted rows")

    def test_rows_of_no_cell_have_no_effect(self, splatter: Any) -> None:
        """Padding rows have no effect on the image, whatever their values."""
        splats = scattered()
        unused = np.setdiff1d(np.arange(CELLS), splats.row)
        positions, rgba = splats.positions.copy(), splats.rgba.copy()
        positions[unused], rgba[unused] = [3.5, 4.5, 1e4], 1.0
        image = _splat(splatter, Splats(positions, rgba, splats.cells))
        claim_close(image, _splat(splatter, splats), TOLERANCE, "the image with other values in padded rows")

    def test_cells_of_the_border_only_splat(self, splatter: Any) -> None:
        """`cropped` returns the image that all cells splat into, those of the border too, with the border cut off."""
        whole = _splat(splatter, scattered())
        for border in (1, 2):
            image = np.asarray(check_splatter(splatter).cropped(scattered().replace(border=border)))
            expected = whole[border : HEIGHT - border, border : WIDTH - border]
            claim(image.shape == expected.shape, f"with border={border} it is {image.shape}; not {expected.shape}")
            claim_close(image, expected, TOLERANCE, f"the image with border={border}")

    @pytest.mark.parametrize("engine", ENGINES)
    def test_no_rows_give_an_empty_image(self, splatter: Any, engine: str) -> None:
        """`splat` of no samples at all gives an image of zeros."""
        chosen = engine_or_skip(engine)
        row = np.full((LAYERS, HEIGHT, WIDTH), -1, np.int32)
        empty = derivatives.on(chosen, (np.zeros((0, 3)), np.zeros((0, 4)), row))
        with no_error(f"splat in {engine} with no rows, where nothing can be taken by index"):
            image = chosen.to_numpy(check_splatter(splatter).splat(*empty))
        claim_close(image, np.zeros((HEIGHT, WIDTH, 4)), 0, f"the image of no rows in {engine}")

    # -------------------------------------------------------------------------------------- derivatives

    @pytest.mark.parametrize("engine", DIFFERENTIABLE)
    def test_a_shape_that_moves_brightens_what_it_moves_into(self, splatter: Any, engine: str) -> None:
        """The derivative of a square has the right sign at its edges as it moves to the right, and down."""
        if not self.moves_edges:
            pytest.skip("the splatter deliberately has no derivative at edges")
        chosen, splats = differentiating(engine), square()
        for axis, ahead, astern in ((0, (3, 6), (3, 2)), (1, (5, 4), (1, 4))):
            along = np.zeros_like(splats.positions)
            along[:, axis] = 1
            change = _along(chosen, splatter, splats, along)[..., 3]
            moving = f"in {engine}, moving {('to the right', 'down')[axis]}"
            why = "does the image use `positions`? One that is not to has `moves_edges = False` in its class of tests"
            claim(change[ahead] > 0.05, f"{moving}, the cell ahead changes by {change[ahead]:.3g}; {why}")
            claim(change[astern] < -0.05, f"{moving}, the cell left behind changes by {change[astern]:.3g}; {why}")

    @pytest.mark.parametrize("engine", ENGINES)
    def test_every_engine_gives_the_same_image(self, splatter: Any, engine: str) -> None:
        """The image of every engine with derivatives is NumPy's, to 1e-5."""
        chosen = differentiating(engine)
        for splats in (everywhere(LAYERS), scattered()):
            with no_error(f"splatting in {engine}"):
                image = chosen.to_numpy(check_splatter(splatter).cropped(derivatives.on(chosen, splats)))
            claim_close(image, _splat(splatter, splats), TOLERANCE, f"the image in {engine}")

    def test_engines_agree(self, splatter: Any) -> None:
        """Engines agree on image, gradient and derivative along a direction; forward and reverse mode agree."""
        splats = scattered(LAYERS + 1)
        f, arrays = _of_positions_and_colors(splatter, splats.row), [splats.positions, splats.rgba]
        derivatives.claim_engines_agree(f, arrays, np.asarray(f(arrays)), "the image")

    @pytest.mark.parametrize("engine", DIFFERENTIABLE)
    def test_rows_of_no_cell_have_no_gradient(self, splatter: Any, engine: str) -> None:
        """Rows of no cell have a gradient of zero, not NaN; so have all rows of an empty image."""
        chosen, splats = differentiating(engine), scattered()
        for row in (splats.row, np.full_like(splats.row, -1)):
            f = _of_positions_and_colors(splatter, row)
            weights = np.random.default_rng(0).standard_normal((HEIGHT, WIDTH, 4))
            at, w = derivatives.on(chosen, ([splats.positions, splats.rgba], weights))
            _, gradient = chosen.value_and_grad(lambda x, f=f, w=w: chosen.namespace.sum(f(x) * w))(at)
            unused = np.setdiff1d(np.arange(CELLS), row)
            for what, g in zip(("positions", "colours"), derivatives.host(chosen, gradient), strict=True):
                claim((g[unused] == 0).all(), f"in {engine}, the gradient of the {what} of padded rows is not zero")


# ------------------------------------------------------------------------------------------------ samples


def everywhere(layers: int) -> Splats:
    """A white sample at the centre of every cell, layer k at depth 2 + k; rows are in order of layers, then cells."""
    k, y, x = np.indices((layers, HEIGHT, WIDTH))
    positions = np.stack([x + 0.5, y + 0.5, 2.0 + k], -1).reshape(-1, 3).astype(np.float32)
    return Splats(positions, np.ones((len(positions), 4), np.float32), Cells(_numbered(layers)))


def scattered(layers: int = LAYERS) -> Splats:
    """Samples off the centres of some cells, of random colour and depth; deeper layers only behind others."""
    rng, count = np.random.default_rng(5), HEIGHT * WIDTH * layers
    splats = everywhere(layers)
    off = rng.uniform(-0.2, 0.2, (count, 3)) + np.linspace(0, 1, count)[:, None] * [0, 0, 0.3]
    alpha = rng.uniform(0.3, 1, (count, 1))
    rgba = np.concatenate([alpha * rng.random((count, 3)), alpha], 1).astype(np.float32)
    row = splats.row.copy()
    for k in range(layers):
        row[k][(rng.random((HEIGHT, WIDTH)) < 0.3) | (row[max(k - 1, 0)] < 0)] = -1
    return Splats((splats.positions + off).astype(np.float32), rgba, Cells(row))


def square() -> Splats:
    """A white square of one layer, from cell (2, 3) to (4, 5), each (row, column)."""
    splats = everywhere(LAYERS)
    row = np.full_like(splats.row, -1)
    row[0, 2:5, 3:6] = splats.row[0, 2:5, 3:6]
    return splats.replace(row=row)


def _numbered(layers: int) -> np.ndarray:
    return np.arange(layers * HEIGHT * WIDTH, dtype=np.int32).reshape(layers, HEIGHT, WIDTH)


def _splat(splatter: Any, splats: Splats) -> np.ndarray:
    return np.asarray(check_splatter(splatter).cropped(splats))


def _of_positions_and_colors(splatter: Any, row: np.ndarray) -> Callable[[list], Any]:
    """The image by a direct call with arrays, as a function of a list of positions and colours."""
    return lambda x: check_splatter(splatter).splat(x[0], x[1], row)


def _along(engine: Any, splatter: Any, splats: Splats, along: np.ndarray) -> np.ndarray:
    """The image's derivative (h, w, 4), without border, when positions (N, 3) move along a direction (N, 3)."""
    on_engine, d = derivatives.on(engine, (splats, [along]))
    image = check_splatter(splatter).cropped
    return engine.to_numpy(engine.jvp(lambda x: image(on_engine.replace(positions=x[0])), [on_engine.positions], d)[1])
