"""Where what is seen ends between the centres of cells: gaps, the crossings in them, and the outlines these make."""
