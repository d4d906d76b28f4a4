"""Conjugate gradients and algebraic multigrid on the device, in place of a factorisation on the host."""

from omtwarp.multigrid.conjugate_gradient import DeviceSum, MultigridSolver, Outcome
from omtwarp.multigrid.hierarchy import MeshHierarchy

__all__ = ["DeviceSum", "MeshHierarchy", "MultigridSolver", "Outcome"]
