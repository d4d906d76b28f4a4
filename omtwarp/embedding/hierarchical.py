"""A start map that always exists: simplify to a tetrahedron, then put the vertices back on the sphere round by round.

Praun and Hoppe, "Spherical parametrization and remeshing" (2003); Hu, Fu and Liu, "Advanced hierarchical spherical
parameterizations" (2017). A vertex returns inside the kernel of its ring's spherical polygon, never empty where
the coarser map has no flip, and moves only where all triangles around it stay positive: so no triangle flips at any
level, whatever the shape. Coarse triangles carry the area of the surface they stand for, so that a long limb keeps its
share of the sphere where a conformal map would shrink it exponentially.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from omtwarp._warp import resolve_device, wp
from omtwarp.embedding.decimation import Hierarchy, Level, Removal, integers, simplify
from omtwarp.embedding.decimation_kernels import MAX_VALENCE
from omtwarp.embedding.hierarchical_kernels import insert_vertices, relax_vertices, triangle_coefficients
from omtwarp.embedding.predicates import count_flips
from omtwarp.errors import OmtwarpError
from omtwarp.mesh.surface import Surface

# Part of an equilateral triangle mixed into each coarse triangle's metric.
_ROUNDING = 0.001
# Levels with fewer vertices than this cost nothing and carry the global layout: they are relaxed well.
_SMALL_LEVEL = 1000
_SMALL_SWEEPS = 30
_SWEEPS = 8
_FINAL_SWEEPS = 20
# A determinant below this after an insertion is not safely positive in float64.
_LEAST_DETERMINANT = 1e-15
_INSERTION_ATTEMPTS = 8


def hierarchical_embedding(
    surface: Surface,
    *,
    area_weight: float = 10.0,
    device: str | None = "auto",
    progress: Callable[[float], None] | None = None,
) -> NDArray[np.float64]:
    """Map a closed genus-0 mesh to the sphere without a flipped triangle, area roughly preserved.

    Args:
        surface: Closed, oriented, connected manifold of genus 0.
        area_weight: Weight of area distortion (D + 1/D) against angle distortion in the energy of every level. 2 keeps
            shapes, 100 areas; at 10 the smallest triangle of a limbed shape is two to five times larger than at 2.
        device: ``auto``, ``cpu`` or ``cuda:N``.
        progress: Called with the part of the vertices placed so far, 0 to 1.

    Returns:
        Unit vectors, float64, shape [V, 3], in the order of the input's vertices; det[a, b, c] > 0 for every face.

    Raises:
        OmtwarpError: the mesh is not a closed manifold of genus 0, the weight is not positive, or the mesh is too
            irregular for float64 to separate its vertices on the sphere.
    """
    if not (area_weight > 0.0 and np.isfinite(area_weight)):
        raise OmtwarpError(f"the weight of area must be a positive number, not {area_weight}")
    where = resolve_device(device)
    hierarchy = simplify(surface, where)
    sphere = _embed(surface, hierarchy, area_weight, where, progress)
    flips = count_flips(sphere, surface.faces)
    if flips:
        raise OmtwarpError(f"the coarse-to-fine embedding has {flips} triangle(s) that float64 cannot keep positive")
    return sphere


def _embed(
    surface: Surface,
    hierarchy: Hierarchy,
    area_weight: float,
    device: wp.Device,
    progress: Callable[[float], None] | None,
) -> NDArray[np.float64]:
    count = surface.vertex_count
    start = np.zeros((count, 3))
    corners = hierarchy.levels[-1].vertices
    start[corners] = np.array([[1.0, 1, 1], [-1, -1, 1], [-1, 1, -1], [1, -1, -1]]) / np.sqrt(3.0)
    if np.linalg.det(start[hierarchy.tetrahedron[0]]) < 0:
        start[corners[:2]] = start[corners[1::-1]]
    colour = np.zeros(count, dtype=np.int32)
    colour[corners] = np.arange(4)
    sphere: wp.array = wp.array(start, dtype=wp.vec3d, device=device)
    colours = integers(colour, device)
    points: wp.array = wp.array(surface.scaled_vertices, dtype=wp.vec3d, device=device)
    coarser = _Relaxation(hierarchy.levels[-1], points, sphere, colours, area_weight, device)
    for level, removal in zip(hierarchy.levels[-2::-1], hierarchy.removals[::-1], strict=True):
        _insert(removal, sphere, colours, coarser, device)
        coarser = _Relaxation(level, points, sphere, colours, area_weight, device)
        coarser.relax_only(removal.vertices)
        coarser.sweep(_SMALL_SWEEPS if len(level.vertices) < _SMALL_LEVEL else _SWEEPS)
        if progress is not None:
            progress(len(level.vertices) / count)
    coarser.sweep(_FINAL_SWEEPS)
    return sphere.numpy().copy()


def _insert(removal: Removal, sphere: wp.array, colours: wp.array, coarser: _Relaxation, device: wp.Device) -> None:
    """Put removed vertices back; where a kernel is too thin for float64, relax the coarser map and try again."""
    size = len(removal.vertices)
    vertices = integers(removal.vertices, device)
    rings = integers(removal.rings, device)
    valences = integers(removal.valences, device)
    normals: wp.array = wp.empty(size * MAX_VALENCE, dtype=wp.vec3d, device=device)
    least: wp.array = wp.empty(size, dtype=wp.float64, device=device)
    for _ in range(_INSERTION_ATTEMPTS):
        wp.launch(
            insert_vertices,
            dim=size,
            inputs=[vertices, rings, valences, normals, sphere, colours],
            outputs=[least],
            device=device,
        )
        worst = least.numpy().min()
        if worst > _LEAST_DETERMINANT:
            return
        coarser.sweep(_SMALL_SWEEPS)
    raise OmtwarpError(
        f"the coarse-to-fine embedding found no room for a vertex among {len(coarser.level.vertices)} others "
        f"(determinant {worst:.1e}): float64 cannot separate them"
    )


class _Relaxation:
    """Moves of one level's vertices, colour by colour, that lower its energy and flip nothing."""

    def __init__(
        self,
        level: Level,
        points: wp.array,
        sphere: wp.array,
        colours: wp.array,
        area_weight: float,
        device: wp.Device,
    ):
        self.area_weight = area_weight
        self.level = level
        self.sphere = sphere
        self.device = device
        self.vertices, self.offsets, self.heads, self.thirds = (
            integers(x, device) for x in (level.vertices, level.offsets, level.heads, level.thirds)
        )
        self.coefficients: wp.array = wp.empty(len(level.heads), dtype=wp.vec4d, device=device)
        wp.launch(
            triangle_coefficients,
            dim=len(level.vertices),
            inputs=[
                self.vertices,
                self.offsets,
                self.heads,
                self.thirds,
                integers(level.half_edge_faces, device),
                wp.array(level.face_masses, dtype=wp.float64, device=device),
                points,
                _ROUNDING,
            ],
            outputs=[self.coefficients],
            device=device,
        )
        colour = colours.numpy()[level.vertices]
        order = np.argsort(colour, kind="stable").astype(np.int32)
        ends = np.cumsum(np.bincount(colour))
        slots = integers(order, device)
        self.classes = [
            slots[begin:end] for begin, end in zip(np.append(0, ends[:-1]), ends, strict=True) if end > begin
        ]

    def relax_only(self, vertices: NDArray[np.int32]) -> None:
        """Move these vertices, no two of which are neighbours."""
        slots = np.searchsorted(self.level.vertices, vertices).astype(np.int32)
        self._relax(integers(slots, self.device))

    def sweep(self, times: int) -> None:
        """Move every vertex ``times`` times."""
        for _ in range(times):
            for slots in self.classes:
                self._relax(slots)

    def _relax(self, slots: wp.array) -> None:
        wp.launch(
            relax_vertices,
            dim=len(slots),
            inputs=[slots, self.vertices, self.offsets, self.heads, self.thirds, self.coefficients, self.area_weight],
            outputs=[self.sphere],
            device=self.device,
        )
