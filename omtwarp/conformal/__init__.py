"""Section 4.1: the conformal map to the sphere, its centring and its density."""

from omtwarp.conformal.centring import CentredMap, centre_points, mobius_centring
from omtwarp.conformal.maps import ConformalMap, HarmonicMap, conformal_map, density, harmonic_points

__all__ = [
    "CentredMap",
    "ConformalMap",
    "HarmonicMap",
    "centre_points",
    "conformal_map",
    "density",
    "harmonic_points",
    "mobius_centring",
]
