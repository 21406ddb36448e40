"""The splatters of `rts.splatting`, compiled for the CPU."""
