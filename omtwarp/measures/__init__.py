"""Measures other than area: weights on a surface, and a density on the sphere that a map is to reach."""

from omtwarp.measures.target import TargetDensity
from omtwarp.measures.weights import weighted_surface

__all__ = ["TargetDensity", "weighted_surface"]
