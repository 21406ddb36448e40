"""Operations of the library that `rts.plugin_api.operations` leaves out."""

from rts.operations.linear import affine_map, matmul
from rts.operations.projection import projective_map
from rts.operations.texels import texels

__all__ = ["affine_map", "matmul", "projective_map", "texels"]
