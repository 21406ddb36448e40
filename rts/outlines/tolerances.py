"""Tolerances and costs of outlines: the unit of each, what it guards against, and what fails if it is larger or less.

`tests/outlines/test_tolerances.py` fails if one of them is twice as large, or half. Compiled loops hold these numbers
as constants, and a loop that is kept on disk is compiled anew only if its own file changes: whoever changes a number
touches the files that import it.
"""

from __future__ import annotations

import numpy as np

TOUCH = 2e-5
"""Cells along a gap, or between two points: places that are closer are one, and a piece that is shorter is none.

It guards against rounding of places, of vertices far outside of the image above all, which splits surfaces that go on,
and ends them beside a centre that lies on their edge. Where it is larger, thin things are lost that count.
"""

ALIKE = 1e-5
"""Share of the depth: surfaces that differ by less are at one depth, and a span is of the surface that a centre sees.

It guards against float32, in which samplers tell depths: smaller, and surfaces that lie in one another take turns.
Where it is larger, something that lies close before something else is not seen between the centres.
"""

BESIDE = 0.1
"""Cells from a crossing to the samples that tell what lies beside it: colours, slopes, the direction of an outline. Of
colours it is half the way to the next crossing, if that is less.

Where it is larger, colours and slopes are those of places farther inside; where it is smaller, normals are those of the
last hair before an outline, which may turn away, and slopes are rounding.
"""

PARALLEL = 1e-3
"""Difference of slopes, in cells along the ray a cell: two surfaces that meet at less do not cross there.

The line between them moves by a cell where one of them comes nearer by so little. Where the number is smaller, rounding
tells how fast; where it is larger, lines between surfaces that do cross stand still.
"""

CUT = 1e-3
"""Cells from where the near or the far plane cuts a triangle: what ends so close to there is the cut, not an edge.

Where it is larger, edges beside a cut stand still as that does; where it is smaller, rounding makes cuts move with the
surface.
"""

RISE = 0.2
"""Share of a cell's width by which depths on a surface without triangles may change more than beside: where they change
by more, it may be another surface, and the gap is searched.

Where it is larger, steps in depth are not seen; where it is smaller, curved surfaces are searched for nothing.
"""

LONE = 2.0
"""Cost of a crossing that stays alone, in cells: an outline ends at another rather than turn by so much.

Where it is larger, outlines that something else hides are joined to those of other things; where it is smaller, those
that turn in a dual cell fall apart.
"""

ASIDE = 0.4
"""Share of a segment's cost, at each end, that is by how far it leads off the direction of the outline there; up to a
half, the rest is by its length. Where it is larger, outlines go straight on to far ends; smaller, to near ones.
"""

ON_ONE_SIDE = 1.5
"""Cost, in cells, of a segment between two crossings on one side of a dual cell.

They may be the two edges of something thin: where the number is larger, it goes on where it ends; where it is smaller,
hair and fences fall to pieces.
"""

OTHER_BEHIND = 0.5
"""Cost, in cells, of a segment between crossings with different parts behind them.

Where it is larger, outlines end where something behind them does; where it is smaller, they go on along other things.
"""

UNLIKE = 1.0
"""Cost, in cells, of a segment between surfaces far from one another along the ray, or between an outline and a line
where surfaces intersect. Where it is larger, surfaces that slope are torn; smaller, outlines go on as those of others.
"""

FAR = 4.0
"""Cells along a ray, each as deep as it is wide: the distance of two surfaces of which half of `UNLIKE` counts.

Where it is larger, outlines go on as those of other things behind them; smaller, and surfaces that slope are torn.
"""

LARGE = 16.0
"""Area in the image, in cells, from which on triangles are large: between two such ones any seam is a crossing.

Each is as expensive as an outline. Where the number is smaller, fine meshes whose triangles share no vertices cost
much more; where it is larger, colours that change at seams in flat surfaces have stairs.
"""

CREASE = np.cos(np.pi / 9)
"""Cosine of the angle, 20°, by which a surface turns at a seam between small triangles, that is then a crossing.

For a larger angle colours have stairs where shading changes; for a smaller one round meshes cost as those of `LARGE`.
"""
