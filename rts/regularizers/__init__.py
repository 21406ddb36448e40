"""Energies of deformed meshes, to be added to a loss: what is smooth, evenly spaced, or bent but not stretched.

Each is made once for a mesh and is then a function of its vertices: `energy(vertices)`, a scalar, and
`energy.residuals(vertices)`, whose sum of squares it is.
"""

from rts.regularizers.arap import ARAP
from rts.regularizers.edge_length import EdgeLength
from rts.regularizers.laplacian import Laplacian
from rts.regularizers.normal_consistency import NormalConsistency
from rts.regularizers.regularizer import Regularizer

__all__ = ["ARAP", "EdgeLength", "Laplacian", "NormalConsistency", "Regularizer"]
