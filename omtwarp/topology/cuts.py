"""Which loops a surface with handles is cut along: around its handles, or through its holes.

Every handle has two kinds of loops that do not separate the surface: around the handle, which leaves two limbs where
it was, and through the hole that it makes, which closes the hole. Either opens the handle. The first are the shortest
there are, so that textures have the shortest seams. The second leave fewer and thicker limbs, and limbs need vertices
around them to keep their areas, see :mod:`omtwarp.geometry.limbs`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse import csgraph

from omtwarp.geometry.limbs import thinnest_ring, vertices_needed
from omtwarp.mesh.surface import Surface
from omtwarp.options import CutAlong
from omtwarp.topology.boundary import boundary_loops
from omtwarp.topology.filling import fill_holes
from omtwarp.topology.handles import CutSurface, cut_handles


def cut_open(
    vertices: NDArray[np.float64], faces: NDArray, genus: int, along: CutAlong = CutAlong.AUTO
) -> tuple[CutSurface, list[str]]:
    """Cut a surface along one loop for each handle, so that genus 0 is left.

    Args:
        vertices: float64, shape [V, 3].
        faces: a connected, oriented manifold mesh, shape [F, 3].
        genus: number of its handles.
        along: ``handles``, the shortest loops; ``holes``, for each of them the shortest that crosses it once and no
            other, where one keeps clear of the others; ``auto``, the shortest unless they leave limbs with few
            vertices around, and then those of either kind that leave thicker ones.

    Returns:
        The surface cut open, and the kind of each loop, ``handles`` or ``holes``.

    Raises:
        OmtwarpError: the mesh is too coarse for loops that do not touch.
    """
    cut = cut_handles(vertices, faces, genus)
    around = [cut.vertex_origin[one] for one, _ in cut.sides]
    kinds: list[str] = [CutAlong.HANDLES] * genus
    if genus == 0 or along == CutAlong.HANDLES:
        return cut, kinds
    thickness = _thickness(cut) if along == CutAlong.AUTO else -np.inf
    # Vertices around the thinnest limb for those needed, above which the shortest loops are taken unseen. Of thirteen
    # surfaces of 2 to 5 handles and 2,600 to 13,200 faces, area distortion was at most 2.005 at 1.98 and above, and
    # 2.02 to 2.15 below; and each had less with the loops that leave the larger ratio.
    if thickness >= 1.9:
        return cut, kinds
    through = loops_through_holes(cut)

    def choice(taken: list[bool]) -> CutSurface:
        loops = [around[k] if each is None or not taken[k] else each for k, each in enumerate(through)]
        return cut_handles(vertices, faces, genus, loops)

    taken = [each is not None for each in through]
    other = choice(taken)
    if along == CutAlong.AUTO:
        best = _thickness(other)
        if best <= thickness:
            taken, other, best = [False] * genus, cut, thickness
        for k in range(genus):  # each handle by itself
            if through[k] is None or genus == 1:
                continue
            turned = [each != (number == k) for number, each in enumerate(taken)]
            candidate = choice(turned)
            thick = _thickness(candidate)
            if thick > best:
                taken, other, best = turned, candidate, thick
    return other, [CutAlong.HOLES if each else CutAlong.HANDLES for each in taken]


def loops_through_holes(cut: CutSurface) -> list[NDArray[np.int64] | None]:
    """Find for each cut the shortest loop of edges that crosses it once and no other.

    Args:
        cut: a surface cut along loops around its handles.

    Returns:
        The given vertices of the loops, in order, which touch neither each other, nor other cuts, nor the boundary;
        None for a cut that none such crosses.
    """
    faces, origin = cut.faces.astype(np.int64), cut.vertex_origin
    count = len(cut.vertices)
    ends = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    ends = np.unique(np.sort(ends, axis=1), axis=0)
    lengths = np.linalg.norm(cut.vertices[ends[:, 0]] - cut.vertices[ends[:, 1]], axis=1)
    lengths = np.maximum(lengths, np.finfo(float).eps * lengths.max())
    rims = boundary_loops(faces, count)
    closed = np.zeros(count, dtype=bool)  # vertices that no loop may pass
    for rim in rims:
        closed[rim] = True
    loops: list[NDArray[np.int64] | None] = []
    for one, other in cut.sides:
        partner = dict(zip(origin[other].tolist(), other.tolist(), strict=True))
        shortest, path = np.inf, None
        for start in one.tolist():
            end = partner[int(origin[start])]
            free = ~closed
            free[[start, end]] = True
            kept = free[ends].all(axis=1)
            graph = sparse.csr_array((lengths[kept], ends[kept].T), shape=(count, count))
            steps, before = csgraph.dijkstra(
                graph, directed=False, indices=start, return_predecessors=True, limit=shortest
            )
            if steps[end] < shortest:
                shortest, path = float(steps[end]), [end]
                while path[-1] != start:
                    path.append(int(before[path[-1]]))
        loop = None if path is None else origin[np.array(path[:-1])]
        if loop is not None:
            closed |= np.isin(origin, loop)
        loops.append(loop)
    return loops


def _thickness(cut: CutSurface) -> float:
    """Return the vertices around the thinnest limb of a cut surface, all its holes filled, for those needed there."""
    loops = boundary_loops(cut.faces, len(cut.vertices))
    filled = fill_holes(cut.vertices, cut.faces, loops)
    surface = Surface(filled.vertices, filled.faces)
    ring = thinnest_ring(surface)
    return np.inf if ring is None else ring.around / vertices_needed(ring.share, surface.face_count)
