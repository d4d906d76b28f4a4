"""A start map that always exists: simplify to a tetrahedron, then put the vertices back on the sphere round by round.

Praun and Hoppe, "Spherical parametrization and remeshing" (2003); Hu, Fu and Liu, "Advanced hierarchical spherical
parameterizations" (2018). A vertex returns inside the kernel of its ring's spherical polygon, never empty where
the coarser map has no flip, and moves only where all triangles around it stay positive: so no triangle flips at any
level, whatever the shape. Coarse triangles have the area of the part of the surface that they replace, so that a long
limb keeps its share of the sphere where a conformal map would shrink it exponentially.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from omtwarp.device.policy import resolve_device
from omtwarp.device.start import wp
from omtwarp.errors import OmtwarpError
from omtwarp.flips.predicates import count_flips
from omtwarp.geometry.axes import order_by_place
from omtwarp.mesh.arrays import real_number
from omtwarp.mesh.checks import MeshLike, as_surface
from omtwarp.mesh.surface import Surface
from omtwarp.options import Progress
from omtwarp.start.decimation import Level, Removal, integers, simplify
from omtwarp.start.decimation_kernels import MAX_VALENCE
from omtwarp.start.hierarchical_kernels import insert_vertices, relax_vertices, triangle_coefficients

# The areas of coarse triangles are exact, their shapes only approximate: on a level of n vertices, a quarter of all or
# fewer, the weight of area is at least this number over n. This lowers the area distortion of long tubes (5.6 instead
# of 7.1 at 30 girths) and does not change that of compact shapes.
_COARSE_AREA_WEIGHT = 1e4
# Part of an equilateral triangle mixed into each coarse triangle's metric.
_ROUNDING = 0.001
# Levels with fewer vertices than this are cheap and determine the global layout: they get more sweeps.
_SMALL_LEVEL = 1000
_SMALL_SWEEPS = 30
_SWEEPS = 8
_FINAL_SWEEPS = 20
# Where asked to be thorough: on an octopus of 17,000 vertices, with an area weight of 30, area distortion is 2.64 in
# place of 3.14, and angle distortion 24 in place of 20.
_THOROUGH_SWEEPS = (60, 30, 100)
# Of vertices that were removed by distance: there needles slow the moves down.
_SWEEPS_BY_DISTANCE = (60, 20, 100)
# A determinant below this after an insertion is not safely positive in float64.
_LEAST_DETERMINANT = 1e-15
_INSERTION_ATTEMPTS = 8


@dataclass(frozen=True)
class HierarchicalEmbedding:
    """A map without flips that was made from coarse to fine.

    Attributes:
        sphere: unit vectors, float64, shape [V, 3], in the order of the input's vertices; det[a, b, c] > 0 for every
            face.
        history: one record per level, the coarsest first: ``iteration`` and ``vertices`` placed.
        converged: True: every vertex was placed.
    """

    sphere: NDArray[np.float64]
    history: list[dict[str, int]] = field(default_factory=list)
    converged: bool = True


def hierarchical_embedding(
    surface: MeshLike,
    *,
    area_weight: float = 10.0,
    by_distance: bool = False,
    thorough: bool = False,
    device: str | None = "auto",
    progress: Progress | None = None,
) -> HierarchicalEmbedding:
    """Map a closed genus-0 mesh to the sphere without a flipped triangle, area roughly preserved.

    Args:
        surface: a mesh in any form that :func:`omtwarp.map_to_sphere` takes.
        area_weight: Weight of area distortion (D + 1/D) against angle distortion in the energy of every level. 2 keeps
            shapes, 100 areas; at 10 the smallest triangle of a limbed shape is two to five times larger than at 2.
        by_distance: simplify by removing the vertices nearest to others first, and keep the areas of coarse triangles:
            for drawn parts, whose triangles differ in area by orders of magnitude. By default those with the smallest
            triangles around them go first.
        thorough: move every vertex two to five times as often, which takes twice as long.
        device: ``auto``, ``cpu`` or ``cuda:N``.
        progress: called as ``progress("start", placed, vertices, {})`` after every level.

    Returns:
        The embedding and its levels.

    Raises:
        OmtwarpError: the mesh cannot be mapped, the weight is not positive, or the mesh is too
            irregular for float64 to separate its vertices on the sphere.

    Example:
        >>> import omtwarp
        >>> surface = omtwarp.shapes.limbs(length=2.0, sharpness=9.0, sphere=980)
        >>> sphere = omtwarp.hierarchical_embedding(surface, device="cpu").sphere
        >>> omtwarp.certify(surface, sphere, device="cpu").bijective
        True
    """
    area_weight = real_number(area_weight, "the weight of area", above=0.0)
    given = as_surface(surface)
    order = order_by_place(given)
    surface = renumbered(given, order)
    where = resolve_device(device)
    history: list[dict[str, int]] = []
    hierarchy = simplify(surface, where, by_distance=by_distance)
    small, usual, final = _THOROUGH_SWEEPS if thorough else (_SMALL_SWEEPS, _SWEEPS, _FINAL_SWEEPS)
    if by_distance:
        small, usual, final = _SWEEPS_BY_DISTANCE
    embedding = _Embedding(surface, hierarchy.levels[-1], hierarchy.tetrahedron, area_weight, where)
    for level, removal in zip(hierarchy.levels[-2::-1], hierarchy.removals[::-1], strict=True):
        embedding.insert(removal)
        embedding.enter(level)
        embedding.relax(removal.vertices)
        embedding.sweep(small if len(level.vertices) < _SMALL_LEVEL else usual)
        history.append({"iteration": len(history), "vertices": len(level.vertices)})
        if progress is not None:
            progress("start", len(level.vertices), surface.vertex_count, {})
    embedding.sweep(final)
    sphere = np.empty((surface.vertex_count, 3))
    sphere[order] = embedding.sphere.numpy()
    flips = count_flips(sphere, given.faces)
    if flips:
        raise OmtwarpError(f"the coarse-to-fine embedding has {flips} triangle(s) that float64 cannot keep positive")
    return HierarchicalEmbedding(sphere, history)


def renumbered(surface: Surface, order: NDArray[np.intp]) -> Surface:
    """Return the surface with its vertices in an order, given by their numbers, shape [V].

    Of equally cheap collapses the simplification takes one by the number of its vertex. With the numbers of the input,
    another order of the same vertices gave embeddings of a body with thin limbs that were up to 1.5 radians apart.
    """
    places = np.empty(len(order), dtype=np.int32)
    places[order] = np.arange(len(order), dtype=np.int32)
    areas = surface.face_areas if surface.weighted else None
    return Surface(surface.vertices[order], places[surface.faces], areas)


class _Embedding:
    """Positions on the sphere of one level's vertices; no call leaves a triangle of that level flipped.

    Attributes:
        sphere: Unit vectors of all vertices of the input, those placed so far valid.
        colours: Colours of these vertices; neighbours' differ. Vertices of a round are no neighbours, and edges between
            older vertices only vanish on the way to finer levels: a colour given once stays valid.
    """

    def __init__(
        self, surface: Surface, level: Level, tetrahedron: NDArray[np.int32], area_weight: float, device: wp.Device
    ):
        start = np.zeros((surface.vertex_count, 3))
        start[level.vertices] = np.array([[1.0, 1, 1], [-1, -1, 1], [-1, 1, -1], [1, -1, -1]]) / np.sqrt(3.0)
        if np.linalg.det(start[tetrahedron[0]]) < 0:
            start[level.vertices] *= -1.0
        colours = np.zeros(surface.vertex_count, dtype=np.int32)
        colours[level.vertices] = np.arange(4)
        self.device = device
        self.area_weight = area_weight
        self.points: wp.array = wp.array(surface.scaled_vertices, dtype=wp.vec3d, device=device)
        self.sphere: wp.array = wp.array(start, dtype=wp.vec3d, device=device)
        self.colours = integers(colours, device)
        self.enter(level)

    def insert(self, removal: Removal) -> None:
        """Insert removed vertices; where a kernel is too thin for float64, relax the coarser map and try again."""
        size = len(removal.vertices)
        vertices, rings, valences = (
            integers(x, self.device) for x in (removal.vertices, removal.rings, removal.valences)
        )
        normals: wp.array = wp.empty(size * MAX_VALENCE, dtype=wp.vec3d, device=self.device)
        least: wp.array = wp.empty(size, dtype=wp.float64, device=self.device)
        for _ in range(_INSERTION_ATTEMPTS):
            wp.launch(
                insert_vertices,
                dim=size,
                inputs=[vertices, rings, valences, normals, self.sphere, self.colours],
                outputs=[least],
                device=self.device,
            )
            worst = least.numpy().min()
            if worst > _LEAST_DETERMINANT:
                return
            self.sweep(_SMALL_SWEEPS)
        raise OmtwarpError(
            f"the coarse-to-fine embedding found no place for a vertex among {len(self.level.vertices)} others "
            f"(determinant {worst:.1e}): float64 cannot separate them"
        )

    def enter(self, level: Level) -> None:
        """Begin a level whose vertices are all placed."""
        self.level = level
        self.vertices, self.offsets, self.heads, self.thirds = (
            integers(x, self.device) for x in (level.vertices, level.offsets, level.heads, level.thirds)
        )
        self.coefficients: wp.array = wp.empty(len(level.heads), dtype=wp.vec4d, device=self.device)
        wp.launch(
            triangle_coefficients,
            dim=len(level.vertices),
            inputs=[
                self.vertices,
                self.offsets,
                self.heads,
                self.thirds,
                integers(level.half_edge_faces, self.device),
                wp.array(level.face_masses, dtype=wp.float64, device=self.device),
                self.points,
                _ROUNDING,
            ],
            outputs=[self.coefficients],
            device=self.device,
        )
        colour = self.colours.numpy()[level.vertices]
        self.slots = integers(np.argsort(colour, kind="stable"), self.device)
        ends = np.cumsum(np.bincount(colour))
        # Recorded launches: on small levels a launch costs more than its kernel.
        self.moves = [
            self._move(self.slots[begin:end])
            for begin, end in zip(np.append(0, ends[:-1]), ends, strict=True)
            if end > begin
        ]

    def relax(self, vertices: NDArray[np.int32]) -> None:
        """Move these vertices, no two of which are neighbours."""
        slots = integers(np.searchsorted(self.level.vertices, vertices), self.device)
        self._move(slots).launch()

    def sweep(self, times: int) -> None:
        """Move every vertex ``times`` times, colour by colour."""
        for _ in range(times):
            for move in self.moves:
                move.launch()

    def _move(self, slots: wp.array) -> wp.Launch:
        """Return a recorded launch that moves the vertices in these slots of the level.

        The caller keeps ``slots`` alive.
        """
        area_weight, count = self.area_weight, len(self.level.vertices)
        if 4 * count <= len(self.sphere):
            area_weight = max(area_weight, _COARSE_AREA_WEIGHT / count)
        move = wp.launch(
            relax_vertices,
            dim=len(slots),
            inputs=[slots, self.vertices, self.offsets, self.heads, self.thirds, self.coefficients, area_weight],
            outputs=[self.sphere],
            device=self.device,
            record_cmd=True,
        )
        assert move is not None
        return move
