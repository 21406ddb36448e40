"""A plugin by docs/plugins.md alone: a ray surface, a 5 × 5 splatter, a shader with a network, an operation."""
