"""Scenes looked into: which samplers they get, where time goes, what they look like."""
