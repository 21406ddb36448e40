"""A surface and a sampler for rts."""
