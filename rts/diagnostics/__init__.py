"""What a gradient is, and whether it is right."""
