"""The engine of torch tensors."""
