"""Arrays of any engine: which engine owns them, trees of them, and checks of numbers that callers give."""
