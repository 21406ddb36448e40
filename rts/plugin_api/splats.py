"""The splatters in array code, which compiled ones extend, and cells at outlines."""
