"""Where what is seen ends between the centres of cells: gaps, the breaks in them, and the outlines these make."""
