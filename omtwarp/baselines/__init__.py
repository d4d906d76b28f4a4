"""The systems the paper compares with that are not stages of its own: spherical barycentric maps."""

from omtwarp.baselines.barycentric import BarycentricMap, barycentric_map, barycentric_weights

__all__ = ["BarycentricMap", "barycentric_map", "barycentric_weights"]
