"""Samplers and engines that come with the library, one plugin a file."""
