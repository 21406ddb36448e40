"""DEODR and Mitsuba, which come with the extra `bench`, on scenes of ours."""
