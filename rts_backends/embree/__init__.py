"""The sampler that casts rays by Embree."""
