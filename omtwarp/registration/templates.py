"""Surfaces and spheres that other packages bring, to register to."""

from __future__ import annotations

from omtwarp.errors import OmtwarpError
from omtwarp.mesh.read import read_mesh
from omtwarp.resampling import SpherePoints
from omtwarp.spheres import mesh_grid

HEMISPHERES = {"fsaverage5-left": "left", "fsaverage5-right": "right"}
"""The templates by name, and the hemisphere of each."""


def template(name: str) -> SpherePoints:
    """Read a template: FreeSurfer's average white surface of 10,242 vertices and its sphere, which nilearn brings.

    Args:
        name: one of ``HEMISPHERES``.

    Raises:
        OmtwarpError: nilearn is not installed.
    """
    try:
        from nilearn.datasets import fetch_surf_fsaverage
    except ImportError as error:
        raise OmtwarpError(f"'{name}' is in nilearn, which is not installed") from error
    files, side = fetch_surf_fsaverage("fsaverage5"), HEMISPHERES[name]
    sphere, white = (read_mesh(files[f"{what}_{side}"]) for what in ("sphere", "white"))
    return SpherePoints(mesh_grid(sphere.vertices, sphere.faces, name), white.vertices)
