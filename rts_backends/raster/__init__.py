"""The sampler that draws triangles on all cores."""
