"""A distribution of plugins, one of each of four kinds: a lofted surface, a ray caster, a toon shader, a wide splatter."""
