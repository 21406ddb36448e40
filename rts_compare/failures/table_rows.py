"""The rows of the table: ways to fail."""

from __future__ import annotations

from functools import partial

import numpy as np

from rts_compare.failures import failure_scenes, library_only_rows
from rts_compare.failures.row_measures import CLOSE, Derivative, Fitted, Several, Vanishing
from rts_compare.failures.table_cells import Row

FIT = f"Figure: converged (within {CLOSE} pixels) and the median pixels off. Degraded below 90 %, failed below 50 %."
ERROR = (
    "Figure: low-passed relative L2 error of the derivative image (largest derivative of a pixel over the true "
    "one). Degraded above 0.2, failed above 0.5."
)
ERRORS = "Figures: low-passed relative L2 errors of derivative images. Degraded above 0.2, failed above 0.5; the worst."
GRID = (
    "Figure: the mean absolute error at the end (over the least on the way), medians of five starts. Degraded above "
    "1.2, failed above 2, or where the least is more than half of that at the start."
)
NO_EDGES = "`none` has no derivative at outlines, by construction."
ONE_LAYER = "`single` knows nothing of what lies behind."
OPAQUE_ALONE = "`single` and `multi` take layers to be opaque."
FRONT_ALONE = "`edges` shows the front alone."
THIN = "What is thinner than a pixel is met by some rays only, and nothing tells of it between them: more samples help."
COARSE = "An error of one sample a pixel, which tells only between which two centres an edge is: more samples help."


def _spread(sizes: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Random amounts (n,), each up to its one of `sizes` (n,) in either direction."""
    return rng.uniform(-1, 1, len(sizes)) * sizes


def _ring(near: float, far: float, rng: np.random.Generator) -> np.ndarray:
    """A random offset (2,) whose length is between `near` and `far`."""
    angle = rng.uniform(0, 2 * np.pi)
    return rng.uniform(near, far) * np.array([np.cos(angle), np.sin(angle)])


def _at(*middle: float, spread: float = 2.0):
    """A function, random numbers → amounts that differ from `middle` by at most `spread` each."""
    return partial(_near, np.array(middle), spread)


def _near(middle: np.ndarray, spread: float, rng: np.random.Generator) -> np.ndarray:
    return middle + rng.uniform(-spread, spread, len(middle))


POSE = partial(_spread, np.array([4, 4, 4, 4, 4, 4.0]))
SLIDE = partial(_spread, np.array([8.0]))

ROWS: tuple[Row, ...] = (
    Row(
        "pose of a box",
        f"A colour a corner, before a pattern; six numbers, from 4 pixels off along each. {FIT}",
        Fitted(failure_scenes.colored_box, POSE),
        NO_EDGES,
    ),
    Row(
        "square slides behind bunny",
        f"The bunny's faces that look away culled; from up to 8 pixels off. {FIT}",
        Fitted(failure_scenes.square_behind_bunny, SLIDE),
        NO_EDGES,
    ),
    Row(
        "… behind an open bunny",
        f"Nothing is culled: the square is the third layer. {FIT}",
        Fitted(failure_scenes.square_behind_open_bunny, SLIDE),
        NO_EDGES,
    ),
    Row(
        "card behind a shell",
        f"A closed sphere, both sides drawn, before a card that moves: the third layer. {ERROR}",
        Derivative(failure_scenes.shells),
        f"{NO_EDGES} {ONE_LAYER}",
    ),
    Row(
        "stacks of 2, 4, 6, 8 cards",
        f"The card in the middle moves. {ERRORS}",
        Several(tuple(Derivative(partial(failure_scenes.stack, count)) for count in (2, 4, 6, 8))),
        f"{NO_EDGES} {ONE_LAYER}",
    ),
    Row(
        "pane of glass",
        f"It lets half of the light through, and slides over a card. {ERROR}",
        Derivative(failure_scenes.pane, pixel=1.0),
        f"{NO_EDGES} {OPAQUE_ALONE} {FRONT_ALONE}",
    ),
    Row(
        "card behind glass",
        f"It moves behind a pane and a closed ball of glass: the fourth layer. {ERROR}",
        Derivative(failure_scenes.behind_glass, pixel=1.0),
        f"{NO_EDGES} {OPAQUE_ALONE} Two layers are too few; 'auto' takes all.",
    ),
    Row(
        "coplanar surfaces",
        f"Two cards in one plane overlap; one slides. {ERROR}",
        Derivative(failure_scenes.coplanar),
        (
            f"{NO_EDGES} {ONE_LAYER} Depths tie, so that one card is taken for the continuation of the other, and "
            "they are averaged; see below."
        ),
    ),
    Row(
        "… 1e-3 apart",
        f"As before. {ERROR}",
        Derivative(partial(failure_scenes.coplanar, 1e-3)),
        f"{NO_EDGES} {ONE_LAYER} {COARSE}",
    ),
    Row(
        "interpenetrating surfaces",
        f"Two spheres cross; one moves. {ERROR}",
        Derivative(failure_scenes.crossing),
        f"{NO_EDGES} Near outlines of closed surfaces `multi` takes the back for the front; `edges` does not.",
    ),
    Row(
        "wires of 1, 0.5, 0.25 pixels",
        f"Seven of them over black, slanted. {ERRORS}",
        Several(tuple(Derivative(partial(failure_scenes.wires, width)) for width in (1.0, 0.5, 0.25))),
        f"{NO_EDGES} {THIN}",
    ),
    Row(
        "gaps of 1, 0.5, 0.25 pixels",
        f"Between two cards of which one moves; white shows through. {ERRORS}",
        Several(tuple(Derivative(partial(failure_scenes.gap, width)) for width in (1.0, 0.5, 0.25))),
        f"{NO_EDGES} {ONE_LAYER} {THIN}",
    ),
    Row(
        "several edges in a pixel",
        f"Teeth of 0.7 pixels, 1.3 apart. {ERROR}",
        Derivative(failure_scenes.comb),
        f"{NO_EDGES} {THIN}",
    ),
    Row(
        "upright edges",
        f"A card exactly along the pixels. {ERROR}",
        Derivative(failure_scenes.upright),
        f"{NO_EDGES} {COARSE}",
    ),
    Row(
        "grazing sheet",
        f"Striped, seen from three degrees above; it rises. {ERROR}",
        Derivative(failure_scenes.grazing),
        f"{NO_EDGES} {COARSE}",
    ),
    Row(
        "silhouette leaves the image",
        f"On two sides. {ERROR}",
        Derivative(failure_scenes.leaving),
        f"{NO_EDGES} {COARSE}",
    ),
    Row(
        "slides through the near plane",
        f"A slanted card, cut off there. {ERROR}",
        Derivative(failure_scenes.through_near),
        f"{NO_EDGES} {COARSE}",
    ),
    Row(
        "… and comes nearer",
        f"The card moves towards the camera, and the cut across it. {ERROR}",
        Derivative(failure_scenes.through_near, pixel=1.0, mode="tz"),
        (
            "Samples move with the card, and the edge that the near plane cuts does not: splatters of "
            "samples move it along. `edges` keeps it at the plane."
        ),
    ),
    Row(
        "reaches behind the camera",
        f"A band on the floor. {ERROR}",
        Derivative(failure_scenes.past_camera, pixel=1.0),
        f"{NO_EDGES} {COARSE}",
    ),
    Row(
        "empty view",
        "A sphere beside the image. Figure: the norm of the derivative, which is zero.",
        Vanishing(failure_scenes.empty, (0.0, 0.0)),
    ),
    Row(
        "wholly hidden",
        "A sphere behind a card. Figure: the norm of its derivative, which is zero, over that of the card's.",
        Vanishing(failure_scenes.covered, (0.01, 0.1)),
        NO_EDGES,
    ),
    Row(
        "round object that turns",
        "A sphere of one colour turns about its middle, and nothing changes. Figure: the low-passed norm of the "
        "derivative over that of the sphere moving. Degraded above 0.1, failed above 0.3.",
        Vanishing(failure_scenes.turning_ball, (0.1, 0.3)),
        (
            "Coverage moves with the samples inside the outline, and these turn; the back of the ball, "
            "turning the other way, is what cancels it in `multi`."
        ),
    ),
    Row(
        "slivers, triangles of no area",
        f"Among those of a sphere before a card. {ERROR}",
        Several((Derivative(failure_scenes.with_slivers, failure_scenes.plain),)),
        f"{NO_EDGES} {ONE_LAYER} {COARSE}",
    ),
    Row(
        "scale 1e-4",
        f"A sphere before a card. {ERROR}",
        Derivative(partial(failure_scenes.scaled, 1e-4), failure_scenes.plain),
        f"{NO_EDGES} {ONE_LAYER} {COARSE}",
    ),
    Row(
        "scale 1e4",
        f"As before. {ERROR}",
        Derivative(partial(failure_scenes.scaled, 1e4), failure_scenes.plain),
        f"{NO_EDGES} {ONE_LAYER} {COARSE}",
    ),
    Row(
        "1e5 away from the origin",
        f"As before, vertices and camera in float64, derivatives in float32. {ERROR}",
        Derivative(partial(failure_scenes.scaled, 1.0, 1e5), failure_scenes.plain),
        (
            "Triangles are sampled in float32, whose steps there are 0.008, a third of a pixel: keep "
            "vertices near the origin of their part."
        ),
    ),
    Row(
        "… by a transform, in float64",
        f"As before; vertices are near the origin of their part, derivatives in float64. {ERROR}",
        Derivative(partial(failure_scenes.offset, 1e5), failure_scenes.plain, double=True),
        NO_EDGES,
    ),
    Row(
        "float32 against float64",
        "A sphere before a card. Figure: what the derivative in float32 is off from that in float64, low-passed "
        "relative L2. Degraded above 1e-3, failed above 0.1.",
        library_only_rows.precision,
        NO_EDGES,
    ),
    Row(
        "lattice ties",
        "An isosurface through lattice points, values exactly −0. Figure: the largest gradient over that of "
        "values a fifth of a cell off. Degraded above 3, failed above 30, or where one is not finite.",
        library_only_rows.lattice_ties,
    ),
    Row(
        "near-singular crossings",
        "An isosurface of two balls that all but touch. Figure: as before. Degraded above 30, failed above 300.",
        library_only_rows.singular_crossings,
    ),
    Row(
        "density grid by Adam",
        f"The 16³ values of a lattice, one view. {GRID}",
        partial(library_only_rows.density_grid, "adam", 0.03),
        "Steps are as long for values that are seen once in a while as for others, and debris gathers: take SGD.",
    ),
    Row(
        "… by SGD",
        f"As before. {GRID}",
        partial(library_only_rows.density_grid, "sgd", 100.0),
        f"{NO_EDGES} Debris of one sample a pixel is left: more samples help.",
    ),
    Row(
        "symmetric trap",
        "A sphere swept along a circle, fitted to a torus seen from its axis (§4.5). Figure: the radii, truly 0.60 and "
        "0.25. Degraded above 0.02 off, failed above 0.1.",
        library_only_rows.swept_trap,
        "The outer outline fixes the sum of the radii, and nothing that is seen opens the hole: take another view.",
    ),
    Row(
        "… seen from aside",
        "As before, from where the hole is not hidden by symmetry.",
        library_only_rows.swept_turned,
        NO_EDGES,
    ),
    Row(
        "card turned, from facing",
        f"About its upright axis by half a radian, from where its silhouette is widest. {FIT}",
        Fitted(failure_scenes.turning_card, _at(failure_scenes.facing_card(), spread=0.0)),
        NO_EDGES,
    ),
    Row(
        "too far for overlap",
        f"A card of 16 × 12 pixels that begins 18 to 22 pixels off. {FIT}",
        Fitted(failure_scenes.far_card, partial(_ring, 18.0, 22.0), rate=1.5),
        (
            f"{NO_EDGES} Images that do not overlap have no slope towards one another; some fits find "
            "theirs by chance. Blur them."
        ),
    ),
    Row(
        "… images blurred at first",
        f"As before; both images through a Gaussian of 12 pixels that shrinks to none. {FIT}",
        Fitted(failure_scenes.far_card, partial(_ring, 18.0, 22.0), rate=1.5, blur=12.0),
        NO_EDGES,
    ),
    Row(
        "fit from behind another",
        f"A card that begins wholly hidden. {FIT}",
        Fitted(failure_scenes.hidden_card, _at(-45.0, 0.0, spread=2.0)),
        "What is hidden changes no image, so nothing says where it is: start elsewhere, or take another view.",
    ),
    Row(
        "gauge freedom, LM",
        f"A pose made of two: six combinations of twelve numbers change nothing. {FIT}",
        library_only_rows.gauge_freedom,
        NO_EDGES,
    ),
)
