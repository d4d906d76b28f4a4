"""A start map of a surface with one boundary loop to the hemisphere, made from coarse to fine like that of a sphere.

As in :mod:`omtwarp.start.hierarchical` vertices return level by level, and none flips a triangle. A fan around one
vertex, the pole, closes the hole; the pole stays at the south pole. Vertices of the boundary are removed along it,
return to the equator between their neighbours there, and move along it. So the boundary is on the equator to the last
bit however long limbs are, and the map with its mirror image is one of the doubled surface.
"""

from __future__ import annotations

import numpy as np

from omtwarp.device.policy import resolve_device
from omtwarp.device.start import wp
from omtwarp.errors import OmtwarpError
from omtwarp.flips.predicates import count_flips
from omtwarp.geometry.axes import order_by_place
from omtwarp.mesh.arrays import Floats, Ints
from omtwarp.mesh.surface import Surface, triangle_areas
from omtwarp.options import Progress, tell
from omtwarp.start.decimation import Level, Removal, integers, simplify
from omtwarp.start.decimation_kernels import Vertex
from omtwarp.start.hierarchical import Embedding, renumbered, sweeps
from omtwarp.start.hierarchical_kernels import insert_on_equator, relax_vertices, slide_on_equator
from omtwarp.topology.kind import boundary_half_edges

AREA_WEIGHT = 10.0  # of area distortion against angle distortion, as by default on the whole sphere


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
    count, where = len(vertices), resolve_device(device)
    rim = boundary_half_edges(faces, count)
    on_rim = np.zeros(count, dtype=bool)
    on_rim[rim] = True
    fan = np.stack([rim[:, 1], rim[:, 0], np.full(len(rim), count)], axis=1)
    closed = np.concatenate([faces, fan]).astype(np.int32)
    points = np.concatenate([vertices, vertices[on_rim].mean(axis=0, keepdims=True)])
    own = triangle_areas(points, closed)
    if areas is not None:
        own[len(faces) :] *= areas.sum() / own[: len(faces)].sum()
        own[: len(faces)] = areas
    given = Surface(points, closed, own)
    kinds = np.append(np.where(on_rim, Vertex.RIM, Vertex.INSIDE), Vertex.POLE).astype(np.int32)
    order = order_by_place(given)
    surface = renumbered(given, order)
    hierarchy = simplify(surface, where, kinds=kinds[order])
    embedding = _HemisphereEmbedding(
        surface, hierarchy.levels[-1], hierarchy.coarsest, AREA_WEIGHT, where, kinds=kinds[order]
    )
    for placed in embedding.refined(hierarchy, *sweeps(thorough=True)):
        tell(progress, "start", placed, surface.vertex_count, {})
    sphere = np.empty((count + 1, 3))
    sphere[order] = embedding.sphere.numpy()
    flips = count_flips(sphere, faces)
    if flips:
        raise OmtwarpError(f"the coarse-to-fine embedding has {flips} triangle(s) that float64 cannot keep positive")
    return sphere[:count]


class _HemisphereEmbedding(Embedding):
    """Positions on the sphere of one level's vertices, those of the boundary on the equator.

    Args:
        kinds: of the vertices, see :func:`omtwarp.start.decimation.simplify`, shape [V].
    """

    def __init__(
        self, surface: Surface, level: Level, coarsest: Ints, area_weight: float, device: wp.Device, *, kinds: Ints
    ):
        self.kinds = kinds
        self.pole = int(np.flatnonzero(kinds == Vertex.POLE)[0])
        super().__init__(surface, level, coarsest, area_weight, device)

    def place(self, vertices: Ints, coarsest: Ints, sphere: Floats) -> None:
        """Put three vertices on the equator and one at each pole."""
        top = vertices[self.kinds[vertices] == Vertex.INSIDE][0]
        sphere[top], sphere[self.pole] = (0.0, 0.0, 1.0), (0.0, 0.0, -1.0)
        face = next(face for face in coarsest if top in face)
        first, second = np.roll(face, -int(np.flatnonzero(face == top)[0]))[1:]
        third = np.setdiff1d(vertices, [top, self.pole, first, second])[0]
        angles = 2.0 * np.pi / 3.0 * np.arange(3)
        sphere[[first, second, third], 0], sphere[[first, second, third], 1] = np.cos(angles), np.sin(angles)

    def put_back(self, removal: Removal) -> float:
        """Place removed vertices, those of the boundary on the equator, and colour them."""
        on_rim = self.kinds[removal.vertices] == Vertex.RIM
        inside = Removal(removal.vertices[~on_rim], removal.rings[~on_rim], removal.valences[~on_rim])
        worst = super().put_back(inside) if len(inside.vertices) else np.inf
        if on_rim.any():
            rows = (removal.vertices[on_rim], removal.rings[on_rim], removal.valences[on_rim])
            inputs = [*(integers(values, self.device) for values in rows), self.pole]
            least: wp.array = wp.empty(int(on_rim.sum()), dtype=wp.float64, device=self.device)
            wp.launch(
                insert_on_equator,
                dim=len(least),
                inputs=[*inputs, self.sphere, self.colours],
                outputs=[least],
                device=self.device,
            )
            worst = min(worst, float(least.numpy().min()))
        return worst

    def moves_of(self, slots: wp.array) -> list[wp.Launch]:
        """Return recorded launches that move vertices inside, and along the boundary."""
        places = slots.numpy()
        kinds = self.kinds[self.level.vertices[places]]
        moves = []
        for kind, kernel, more in ((Vertex.INSIDE, relax_vertices, ()), (Vertex.RIM, slide_on_equator, (self.pole,))):
            if (kinds == kind).any():
                own = integers(places[kinds == kind], self.device)
                self.kept.append(own)
                moves.append(self.recorded(kernel, own, *more))
        return moves
