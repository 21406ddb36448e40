"""The engine of torch arrays."""
