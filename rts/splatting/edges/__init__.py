"""The splatter `edges`: areas between outlines. Its rule in array code, and the same image by compiled loops."""

from rts.splatting.edges.splatter import Edges

__all__ = ["Edges"]
