"""Spherical wavelets on nested triangulations: the paper's sections 2.4 and 3.1."""

from omtwarp.geometry.sphere_hierarchy import SphereHierarchy, level_for, sphere_hierarchy
from omtwarp.wavelets.sampling import SphereSampler
from omtwarp.wavelets.transform import SphericalWavelets, WaveletPreconditioner

__all__ = [
    "SphereHierarchy",
    "SphereSampler",
    "SphericalWavelets",
    "WaveletPreconditioner",
    "level_for",
    "sphere_hierarchy",
]
