"""Photographs with cameras in, a textured mesh out: an application of `rts`, on its public names alone."""

from rts_reconstruct.reconstruction import Reconstruction, Watch, reconstruct

__all__ = ["Reconstruction", "Watch", "reconstruct"]
