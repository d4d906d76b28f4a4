"""Sparse factors of matrices whose pattern is the edges of a surface: one analysis, many factorisations."""

from omtwarp.solvers.cholesky.dissection import Dissection, dissect, part_dissection, surface_dissection
from omtwarp.solvers.cholesky.multifrontal import MultifrontalCholesky

__all__ = ["Dissection", "MultifrontalCholesky", "dissect", "part_dissection", "surface_dissection"]
