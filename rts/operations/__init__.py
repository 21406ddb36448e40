"""Functions of arrays that have a specification in array code and compiled code for the host, side by side."""
