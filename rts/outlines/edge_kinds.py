"""Kinds of breaks: which surface ends there."""

BEFORE_ENDS, BEHIND_ENDS, CROSS, SEAM = range(4)
"""`Breaks.near`: the surface before a break ends there, or the one behind it; two pass through one another; or one goes
on across edges that its triangles do not share, so that colours may change, or two parts meet at an edge of both."""
