"""Measures other than area: weights on a surface, and a prescribed density on the sphere."""

from omtwarp.measures.target import TargetDensity
from omtwarp.measures.weights import weighted_surface

__all__ = ["TargetDensity", "weighted_surface"]
