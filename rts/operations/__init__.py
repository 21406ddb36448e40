"""Functions of arrays, most with compiled loops for the host beside a specification: array code for any engine."""
