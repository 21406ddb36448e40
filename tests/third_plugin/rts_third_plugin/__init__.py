"""Plugins of four kinds: a lofted surface, a ray caster, a toon shader, a command."""
