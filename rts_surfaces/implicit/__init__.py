"""Surfaces where a field has one value: isosurfaces of lattices and of functions, and fields cast by rays."""
