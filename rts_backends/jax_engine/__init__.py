"""The engine of jax arrays."""
