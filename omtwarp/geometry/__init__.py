"""Discrete exterior calculus on triangle meshes: the paper's section 3.2 and appendices A and B."""

from omtwarp.geometry.operators import (
    DifferentialOperators,
    circumcentric_coordinates,
    corner_cotangents,
    cotangent_laplacian,
)

__all__ = ["DifferentialOperators", "circumcentric_coordinates", "corner_cotangents", "cotangent_laplacian"]
