"""Kinds of crossings: which surface ends there."""

BEFORE_ENDS, BEHIND_ENDS, INTERSECT, SEAM = range(4)
"""`Crossings.kind`: the surface before a crossing ends there, or the one behind it; two pass through one another; or
one goes on across edges that its triangles do not share, so that colours may change, or two parts meet there.
"""
