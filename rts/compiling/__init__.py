"""How compiled loops are made and kept on disk, and how they are compiled ahead of their first call."""
