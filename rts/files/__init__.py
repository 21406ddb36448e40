"""Models and pictures, from files and to files."""
