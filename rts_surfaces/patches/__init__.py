"""Surfaces of parametric patches: tiles, triangles by error, and bicubic patches."""
