"""Energies of deformed meshes, to be added to a loss; small for smooth, evenly spaced or unstretched meshes.

An energy is made once for a mesh and is then a function of its vertices. `energy(vertices)` is a scalar, the sum of
squares of `energy.residuals(vertices)`.
"""

from rts.regularizers.arap import ARAP
from rts.regularizers.edge_length import EdgeLength
from rts.regularizers.laplacian import Laplacian
from rts.regularizers.normal_consistency import NormalConsistency
from rts.regularizers.regularizer import Regularizer

__all__ = ["ARAP", "EdgeLength", "Laplacian", "NormalConsistency", "Regularizer"]
