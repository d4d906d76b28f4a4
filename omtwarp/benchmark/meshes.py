"""Meshes to measure: generated shapes of any size, and given meshes, subdivided if asked for."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import TypeAlias

import numpy as np

from omtwarp.errors import OmtwarpError
from omtwarp.mesh import shapes
from omtwarp.mesh.checks import MeshLike, as_surface
from omtwarp.mesh.read import read_mesh
from omtwarp.mesh.surface import Surface

SHAPES = ("blob", "creature", "sphere")


def made(shape: str, face_count: int) -> Surface:
    """Return a generated shape with about so many faces: ``blob`` (a potato), ``creature`` (the demo's) or ``sphere``.

    Raises:
        OmtwarpError: an unknown shape.
    """
    if shape == "blob":
        # Amplitude, of the blob's bumps, in radii: a plain convention, which all published times were taken with
        return shapes.blob(seed=1, amplitude=0.3, sphere=face_count)
    if shape == "creature":
        return shapes.demo_shape(face_count)
    if shape == "sphere":
        return shapes.icosphere_near(face_count)
    raise OmtwarpError(f"unknown shape '{shape}': use {', '.join(SHAPES)}")


def subdivided(surface: Surface) -> Surface:
    """Cut every triangle into four at the midpoints of its edges; the surface itself does not change."""
    edges = surface.edges
    # The edge opposite to a corner, and so the number of its middle.
    middle = np.empty(3 * surface.face_count, dtype=np.int64)
    middle[surface.edge_corners] = surface.vertex_count + np.arange(len(edges))[:, None]
    ends = surface.vertices[edges]
    a, b, c = surface.faces.T
    bc, ca, ab = middle.reshape(-1, 3).T
    faces = np.stack([a, ab, ca, ab, b, bc, ca, bc, c, ab, bc, ca], axis=1).reshape(-1, 3)
    return Surface(np.concatenate([surface.vertices, 0.5 * (ends[:, 0] + ends[:, 1])]), faces)


MeshSource: TypeAlias = str | os.PathLike[str] | MeshLike
"""A mesh to measure: its file, or a surface in any form."""


def all_meshes(
    shapes: tuple[str, ...], sizes: tuple[int, ...], meshes: tuple[MeshSource, ...], subdivisions: int
) -> Iterator[tuple[str, str, Surface]]:
    """Yield the family, name and surface of every mesh to measure, one in memory at a time.

    Args:
        shapes: generated shapes.
        sizes: their numbers of faces.
        meshes: mesh files, or pairs of vertices and faces.
        subdivisions: how many times every given mesh is subdivided as well.

    Raises:
        OmtwarpError: a mesh cannot be read or mapped.
    """
    for shape in shapes:
        for size in sorted(sizes):
            surface = made(shape, size)
            yield shape, f"{shape}_{label(surface.face_count)}", surface
    for number, mesh in enumerate(meshes):
        if isinstance(mesh, str | os.PathLike):
            name = Path(mesh).stem
            read = read_mesh(Path(mesh))
            surface = as_surface((read.vertices, read.faces))
        else:
            name, surface = f"mesh {number + 1}", as_surface(mesh)
        for level in range(subdivisions + 1):
            yield name, name if level == 0 else f"{name} / {4**level}", surface
            if level < subdivisions:
                surface = subdivided(surface)


def label(count: int) -> str:
    """Shorten a number of faces to a few characters: 5k, 1.3M."""
    if count >= 1_000_000:
        return f"{count / 1e6:.1f}M".replace(".0M", "M")
    return f"{count / 1e3:.0f}k" if count >= 1000 else str(count)
