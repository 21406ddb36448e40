"""Functions of arrays, each with a specification in array code and compiled loops for the host."""
