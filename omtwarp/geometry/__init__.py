"""Discrete exterior calculus on triangle meshes: the paper's section 3.2 and appendices A and B."""

from omtwarp.geometry.operators import (
    DifferentialOperators,
    circumcentres,
    circumcentric_coordinates,
    corner_cotangents,
    cotangent_laplacian,
    divergence_matrix,
    dual_edge_lengths,
    face_normals,
    gradient_matrix,
    rotate,
    rotation_matrix,
    voronoi_areas,
)

__all__ = [
    "DifferentialOperators",
    "circumcentres",
    "circumcentric_coordinates",
    "corner_cotangents",
    "cotangent_laplacian",
    "divergence_matrix",
    "dual_edge_lengths",
    "face_normals",
    "gradient_matrix",
    "rotate",
    "rotation_matrix",
    "voronoi_areas",
]
