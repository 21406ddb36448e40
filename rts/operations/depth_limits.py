"""Limits by which pictures of depth are read, in arrays and in compiled loops alike."""

BIAS = 0.1
"""How far in front of a point a cell must be, in changes of depth over a cell."""
NEARER = 0.99 * BIAS
"""A little less than `BIAS`, by which planes that may be in front of a point are told from others."""
OWN = 0.5
"""How far a point may be from the plane of a cell, in changes of depth over a cell, to lie on the same surface."""
FAR = 1e30
"""Depth of empty cells."""
RIM = 1.2
"""How many times as much depth rises in the last step before a smooth rim as in the step before, at least."""
FLAT = 0.5
"""Where the side of a cell of a flat surface lies, in cells from its centre."""
REACH = 2
"""Cells around a picture that its points read."""
