"""The splatters of `rts.splatting`, compiled for the CPU.

Each cell splats onto the 3 × 3 cells around it. A source is the cell that a splat comes from, a target one that it goes
to; the front is a cell's nearest layer. Targets are plain if all their sources are paired with them front to front, as
one surface is; others are mixed.
"""
