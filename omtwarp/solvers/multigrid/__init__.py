"""Conjugate gradients and algebraic multigrid on the device, in place of a factorisation on the host."""

from omtwarp.solvers.multigrid.conjugate_gradient import MultigridSolver, Outcome
from omtwarp.solvers.multigrid.hierarchy import STRONG_BLOCKS, MeshHierarchy
from omtwarp.solvers.multigrid.laplacian import (
    DeviceLaplacian,
    positioned_hierarchy,
    release_hierarchy,
    surface_hierarchy,
)

__all__ = [
    "STRONG_BLOCKS",
    "DeviceLaplacian",
    "MeshHierarchy",
    "MultigridSolver",
    "Outcome",
    "positioned_hierarchy",
    "release_hierarchy",
    "surface_hierarchy",
]
