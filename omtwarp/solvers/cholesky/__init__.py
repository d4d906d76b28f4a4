"""Sparse factors of matrices whose pattern is the edges of a surface: one analysis, many factorisations."""

from omtwarp.solvers.cholesky.dissection import Dissection, dissect, part_dissection, surface_dissection
from omtwarp.solvers.cholesky.multifrontal import MultifrontalCholesky, NotPositiveDefinite
from omtwarp.solvers.cholesky.saddle import SaddleFactor

__all__ = [
    "Dissection",
    "MultifrontalCholesky",
    "NotPositiveDefinite",
    "SaddleFactor",
    "dissect",
    "part_dissection",
    "surface_dissection",
]
