"""Other renderers on the library's scenes: DEODR and Mitsuba, installed with the extra `bench`."""
