"""A start map that always exists: simplify to a tetrahedron, then put the vertices back on the sphere round by round.

Praun and Hoppe, "Spherical parametrization and remeshing" (2003); Hu, Fu and Liu, "Advanced hierarchical spherical
parameterizations" (2018). A vertex returns inside the kernel of its ring's spherical polygon, never empty where
the coarser map has no flip, and moves only where all triangles around it stay positive: so no triangle flips at any
level, whatever the shape. Coarse triangles have the area of the part of the surface that they replace, so that a long
limb keeps its share of the sphere where a conformal map would shrink it exponentially.

Of a surface with one boundary loop there is a start map to the hemisphere. A fan around one vertex, the pole, closes
the hole; the pole stays at the south pole. Vertices of the boundary are removed along it, return to the equator between
their neighbours there, and move along it. So the boundary is on the equator to the last bit however long limbs are, and
the map with its mirror image is one of the doubled surface.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from omtwarp.device.arrays import sent
from omtwarp.device.policy import resolve_device
from omtwarp.device.start import wp
from omtwarp.errors import OmtwarpError
from omtwarp.flips.exact import count_flips
from omtwarp.geometry.axes import order_by_place
from omtwarp.mesh.arrays import TINY, Floats, InOneLine, Ints, marked, real_number, squared_norms
from omtwarp.mesh.surface import MeshLike, Surface, as_surface, triangle_areas
from omtwarp.options import Progress, tell
from omtwarp.solvers.triangle import AREA_WEIGHT
from omtwarp.start.decimation import Hierarchy, Level, Removal, Vertex, simplify
from omtwarp.start.hierarchical_kernels import insert_vertices, relax_vertices
from omtwarp.topology.kind import boundary_half_edges

# Moves of every vertex on a level, and once more at the end. Of 56 made surfaces areas and angles are the same in the
# mean with 8 to 30; more take longer.
SWEEPS = 12
# The same where a boundary slides along the equator, which takes longer to settle: the part of a long tube ends at an
# area distortion of 2.036 with 12, 2.028 with 30 and 2.001 with 60 or 100.
HEMISPHERE_SWEEPS = 100
# The weight of area is at least this number over n on a level of n vertices, a quarter of all or fewer, whose areas are
# exact and whose shapes only approximate: more trades shapes for areas (a tube 30 girths long has an area distortion of
# 5.6 with it and 7.1 without).
COARSE_WEIGHT = 1e4
# A determinant below this after an insertion is not safely positive in float64.
_LEAST_DETERMINANT = 1e-15


@dataclass(frozen=True, repr=False)
class HierarchicalEmbedding(InOneLine):
    """A map without flips that was made from coarse to fine.

    Attributes:
        sphere: unit vectors, float64, shape [V, 3], in the order of the input's vertices; det[a, b, c] > 0 for every
            face.
        history: one record per level, the coarsest first: ``iteration`` and ``vertices`` placed.
        converged: True: every vertex was placed.
    """

    sphere: Floats
    history: list[dict[str, int]] = field(default_factory=list)
    converged: bool = True


def hierarchical_embedding(
    surface: MeshLike,
    *,
    area_weight: float = AREA_WEIGHT,
    device: str | None = "auto",
    progress: Progress | None = None,
) -> HierarchicalEmbedding:
    """Map a closed genus-0 mesh to the sphere without a flipped triangle, area roughly preserved.

    Args:
        surface: a mesh in any form that :func:`omtwarp.map_to_sphere` takes.
        area_weight: Weight of area distortion (D + 1/D) against angle distortion in the energy of every level. 2 keeps
            shapes, 100 areas; at 10 the smallest triangle of a limbed shape is two to five times larger than at 2.
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
    kinds = np.full(given.vertex_count, Vertex.INSIDE, dtype=np.int32)
    return _embedded(given, kinds, area_weight, device, progress)


def _embedded(
    given: Surface, kinds: Ints, area_weight: float, device: str | None, progress: Progress | None
) -> HierarchicalEmbedding:
    """Embed a closed surface, whose vertices are of these kinds.

    Raises:
        OmtwarpError: float64 cannot separate its vertices on the sphere.
    """
    order, where = order_by_place(given), resolve_device(device)
    # Of equally cheap collapses the simplification takes one by the number of its vertex. With the numbers of the
    # input, another order of the same vertices gave embeddings of a body with thin limbs that were up to 1.5 radians
    # apart.
    areas, kinds = given.face_areas if given.weighted else None, kinds[order]
    surface = Surface(given.vertices[order], np.argsort(order)[given.faces], areas)
    history: list[dict[str, int]] = []
    embedding = Embedding(surface, simplify(surface, where, kinds=kinds), kinds, area_weight, where)
    for placed in embedding.refined():
        history.append({"iteration": len(history), "vertices": placed})
        tell(progress, "start", placed, surface.vertex_count, {})
    sphere = np.empty((surface.vertex_count, 3))
    sphere[order] = embedding.sphere.numpy()
    flips = count_flips(sphere, given.faces)
    if flips:
        raise OmtwarpError(f"the coarse-to-fine embedding has {flips} triangle(s) that float64 cannot keep positive")
    return HierarchicalEmbedding(sphere, history)


class Embedding:
    """Positions on the sphere of one level's vertices; no call leaves a triangle of that level flipped.

    Vertices of a boundary are on the equator, and the pole of the fan that closes its hole is the south pole.

    Args:
        surface: of the finest level.
        hierarchy: its levels; the vertices of the coarsest are placed.
        kinds: of the vertices, see :func:`omtwarp.start.decimation.simplify`, shape [V].
        area_weight: see :func:`hierarchical_embedding`.
        device: where vertices move.

    Attributes:
        sphere: Unit vectors of all vertices of the input, those placed so far valid.
        colours: Colours of these vertices; neighbours' differ. Vertices of a round are no neighbours, and edges between
            older vertices only vanish on the way to finer levels: a colour given once stays valid.
        pole: the pole; -1 of a surface without a boundary.
    """

    def __init__(self, surface: Surface, hierarchy: Hierarchy, kinds: Ints, area_weight: float, device: wp.Device):
        self.hierarchy, self.kinds, self.area_weight, self.device = hierarchy, kinds, area_weight, device
        self.points = surface.scaled_vertices
        closed = Vertex.POLE not in kinds
        self.pole = -1 if closed else int(np.flatnonzero(kinds == Vertex.POLE)[0])
        self.boundary = [sent(kinds, wp.int32, device), self.pole]  # what kernels read of it
        self.sweeps = SWEEPS if closed else HEMISPHERE_SWEEPS
        level, start = hierarchy.levels[-1], np.zeros((surface.vertex_count, 3))
        place = self.place_tetrahedron if closed else self.place_on_equator
        place(level.vertices, hierarchy.coarsest, start)
        colours = np.zeros(surface.vertex_count, dtype=np.int32)
        colours[level.vertices] = np.arange(len(level.vertices))
        self.sphere: wp.array = wp.array(start, dtype=wp.vec3d, device=device)
        self.colours = sent(colours, wp.int32, device)
        self.enter(level)

    def place_tetrahedron(self, vertices: Ints, coarsest: Ints, sphere: Floats) -> None:
        """Put the vertices of the coarsest level, a tetrahedron, on the sphere; ``sphere`` has shape [V, 3]."""
        sphere[vertices] = np.array([[1.0, 1, 1], [-1, -1, 1], [-1, 1, -1], [1, -1, -1]]) / np.sqrt(3.0)
        if np.linalg.det(sphere[coarsest[0]]) < 0:
            sphere[vertices] *= -1.0

    def place_on_equator(self, vertices: Ints, coarsest: Ints, sphere: Floats) -> None:
        """Put three vertices on the equator and one at each pole."""
        top = vertices[self.kinds[vertices] == Vertex.INSIDE][0]
        sphere[top], sphere[self.pole] = (0.0, 0.0, 1.0), (0.0, 0.0, -1.0)
        face = next(face for face in coarsest if top in face)
        first, second = np.roll(face, -int(np.flatnonzero(face == top)[0]))[1:]
        third = np.setdiff1d(vertices, [top, self.pole, first, second])[0]
        angles = 2.0 * np.pi / 3.0 * np.arange(3)
        sphere[[first, second, third], 0], sphere[[first, second, third], 1] = np.cos(angles), np.sin(angles)

    def refined(self) -> Iterator[int]:
        """Put all vertices of the hierarchy back, and yield how many are placed after each level."""
        for level, removal in zip(self.hierarchy.levels[-2::-1], self.hierarchy.removals[::-1], strict=True):
            self.insert(removal)
            self.enter(level)
            # The new vertices first, no two of which are neighbours
            new = sent(np.searchsorted(level.vertices, removal.vertices), wp.int32, self.device)
            self.move_of(new).launch()
            self.sweep()
            yield len(level.vertices)
        self.sweep()

    def insert(self, removal: Removal) -> None:
        """Insert removed vertices; where a kernel is too thin for float64, relax the coarser map and try again."""
        insertion_attempts = 8
        rows = [sent(x, wp.int32, self.device) for x in (removal.vertices, removal.rings, removal.valences)]
        least: wp.array = wp.empty(len(removal.vertices), dtype=wp.float64, device=self.device)
        inputs = [*rows, *self.boundary, self.sphere, self.colours]
        for _ in range(insertion_attempts):
            wp.launch(insert_vertices, dim=len(removal.vertices), inputs=inputs, outputs=[least], device=self.device)
            worst = float(least.numpy().min())
            if worst > _LEAST_DETERMINANT:
                return
            self.sweep()
        raise OmtwarpError(
            f"the coarse-to-fine embedding found no place for a vertex among {len(self.level.vertices)} others "
            f"(determinant {worst:.1e}): float64 cannot separate them"
        )

    def enter(self, level: Level) -> None:
        """Begin a level whose vertices are all placed."""
        self.level = level
        rows = (level.vertices, level.offsets, level.heads, level.thirds)
        coefficients = sent(self.coefficients_of(level), wp.vec4d, self.device)
        self.mesh = [*(sent(numbers, wp.int32, self.device) for numbers in rows), coefficients]
        colour = self.colours.numpy()[level.vertices]
        slots = np.split(np.argsort(colour, kind="stable"), np.cumsum(np.bincount(colour))[:-1])
        # Kept, as recorded launches read them
        self.slots = [sent(of_colour, wp.int32, self.device) for of_colour in slots if len(of_colour)]
        # Recorded launches: on small levels a launch costs more than its kernel.
        self.moves = [self.move_of(of_colour) for of_colour in self.slots]

    def coefficients_of(self, level: Level) -> Floats:
        """Return cotangents at vertex, head and third of the triangle in space, and its area, for every half-edge.

        Adding one number to all three squared lengths adds an equilateral triangle's metric: slivers, and the flattened
        limbs of coarse levels, get a shape that can be reached.
        """
        part = 0.001  # of an equilateral triangle
        tails = np.repeat(level.vertices, np.diff(level.offsets))
        p, q, r = (self.points[ends] for ends in (tails, level.heads, level.thirds))
        squares = np.stack([squared_norms(one - other) for one, other in ((r, q), (p, r), (q, p))])
        squares += part * squares.sum(axis=0) + TINY
        # Heron: 16 area^2; the added metric keeps it away from 0.
        heron = squares.sum(axis=0) ** 2 - 2.0 * (squares**2).sum(axis=0)
        cotangents = (squares.sum(axis=0) - 2.0 * squares) / np.sqrt(np.maximum(heron, TINY))
        return np.column_stack([cotangents.T, level.face_masses[level.half_edge_faces]])

    def sweep(self) -> None:
        """Move every vertex ``sweeps`` times, colour by colour."""
        for _ in range(self.sweeps):
            for move in self.moves:
                move.launch()

    def move_of(self, slots: wp.array) -> wp.Launch:
        """Return a recorded launch that moves the vertices in these slots of the level, no two of them neighbours."""
        area_weight, count = self.area_weight, len(self.level.vertices)
        if 4 * count <= len(self.sphere):
            area_weight = max(area_weight, COARSE_WEIGHT / count)
        inputs = [slots, *self.mesh, *self.boundary, area_weight]
        outputs, device = [self.sphere], self.device
        move = wp.launch(relax_vertices, dim=len(slots), inputs=inputs, outputs=outputs, device=device, record_cmd=True)
        assert move is not None
        return move


def hemispherical_embedding(
    vertices: Floats,
    faces: Ints,
    areas: Floats | None = None,
    *,
    device: str | None = "auto",
    progress: Progress | None = None,
) -> Floats:
    """Map a disk to the northern hemisphere without a flipped triangle, area roughly preserved.

    Args:
        vertices: float64, shape [V, 3].
        faces: an oriented mesh with one boundary loop, no handle, and no inner edge between boundary vertices, shape
            [F, 3].
        areas: of the triangles on the sphere, in any unit, shape [F]; those of the triangles by default.
        device: ``auto``, ``cpu`` or ``cuda:N``.
        progress: called as ``progress("start", placed, vertices, {})`` after every level.

    Returns:
        Unit vectors, shape [V, 3], z = 0 at the boundary.

    Raises:
        OmtwarpError: the mesh is no such disk, or float64 cannot separate its vertices on the sphere.
    """
    count = len(vertices)
    rim = boundary_half_edges(faces, count)
    on_rim = marked(count, rim)
    fan = np.stack([rim[:, 1], rim[:, 0], np.full(len(rim), count)], axis=1)
    closed = np.concatenate([faces, fan]).astype(np.int32)
    points = np.concatenate([vertices, vertices[on_rim].mean(axis=0, keepdims=True)])
    own = triangle_areas(points, closed)
    if areas is not None:
        own[len(faces) :] *= areas.sum() / own[: len(faces)].sum()
        own[: len(faces)] = areas
    kinds = np.append(np.where(on_rim, Vertex.RIM, Vertex.INSIDE), Vertex.POLE).astype(np.int32)
    return _embedded(Surface(points, closed, own), kinds, AREA_WEIGHT, device, progress).sphere[:count]
