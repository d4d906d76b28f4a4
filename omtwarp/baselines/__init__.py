"""Maps that the paper compares with and that are not stages of its own method: spherical barycentric maps."""

from omtwarp.baselines.barycentric import BarycentricMap, barycentric_map, barycentric_weights

__all__ = ["BarycentricMap", "barycentric_map", "barycentric_weights"]
