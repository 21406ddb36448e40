"""Limit surfaces of subdivision, by OpenSubdiv."""
