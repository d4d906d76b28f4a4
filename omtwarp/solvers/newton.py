"""Newton matrices: the blocks that Hessians of triangles add up to, and those of patches with a kept order."""

from __future__ import annotations

from omtwarp.device.arrays import Workspace, sent
from omtwarp.device.start import KERNEL_OPTIONS, wp
from omtwarp.device.threads import FIRST_THREAD, Each, computed, launch_parts
from omtwarp.errors import OmtwarpError
from omtwarp.mesh.arrays import Floats
from omtwarp.mesh.patches import Patches
from omtwarp.mesh.surface import Surface
from omtwarp.solvers.cholesky import part_dissection
from omtwarp.solvers.cholesky.saddle import COORDINATES, SaddleMatrix
from omtwarp.solvers.factor import MeshMatrix, NotPositiveDefinite
from omtwarp.solvers.mesh_factor import mesh_factor

wp.set_module_options(KERNEL_OPTIONS)


@wp.func
def packed(row: int, column: int) -> int:
    """Return the index of an entry in a symmetric 6x6 matrix stored by its upper triangle, row by row."""
    return (row * (11 - row)) // 2 + column


@wp.func
def corner_block(t: int, i: int, j: int, blocks: wp.array2d[wp.float64]) -> wp.vec4d:
    """Return a triangle's 2x2 block with rows of its corner i and columns of its corner j, row by row."""
    low, high = wp.min(i, j), wp.max(i, j)
    upper, lower = packed(2 * low, 2 * high), packed(2 * low + 1, 2 * high)
    below = blocks[t, lower]
    if i == j:
        below = blocks[t, upper + 1]  # only what is above the diagonal is stored
    if i > j:
        return wp.vec4d(blocks[t, upper], below, blocks[t, upper + 1], blocks[t, lower + 1])
    return wp.vec4d(blocks[t, upper], blocks[t, upper + 1], below, blocks[t, lower + 1])


@wp.func
def ends_in(corner: int, end: int, faces: wp.array[wp.vec3i]):
    """Return the two corners of a triangle beside one of its corners, that at a given vertex first."""
    one, other = (corner + 1) % 3, (corner + 2) % 3
    if faces[corner // 3][one] == end:
        return one, other
    return other, one


@wp.kernel
def vertex_entries(
    offsets: wp.array[wp.int32],
    corners: wp.array[wp.int32],
    blocks: wp.array2d[wp.float64],
    weight: wp.float64,
    metric: wp.array[wp.vec4d],
    first: int,
    # Data out:
    diagonal: wp.array[wp.vec2d],
    inner: wp.array[wp.float64],
):
    """Compute the entries of every vertex: weight times those of the triangles around it, plus its own."""
    v = first + wp.tid()
    total = wp.vec4d()
    for k in range(offsets[v], offsets[v + 1]):
        total += corner_block(corners[k] // 3, corners[k] % 3, corners[k] % 3, blocks)
    block = weight * total + metric[v]
    diagonal[v] = wp.vec2d(block[0], block[3])
    inner[v] = block[1]


@wp.kernel
def gather_edge_blocks(
    edges: wp.array[wp.vec2i],
    faces: wp.array[wp.vec3i],
    corners: wp.array[wp.vec2i],
    blocks: wp.array2d[wp.float64],
    weight: wp.float64,
    # Data out:
    off_diagonal: wp.array[wp.vec4d],
):
    """Compute the block of every edge, rows of its first end and columns of the other, times a weight."""
    e = wp.tid()
    total = wp.vec4d()
    for k in range(2):
        corner = corners[e][k]
        if corner >= 0:
            i, j = ends_in(corner, edges[e][0], faces)
            total += corner_block(corner // 3, i, j, blocks)
    off_diagonal[e] = weight * total


def gather_blocks(
    matrix: SaddleMatrix, rows: list[wp.array], sides: list[object], hessians: wp.array, weight: float, metric: wp.array
) -> None:
    """Write what the Hessians of triangles add up to, at vertices and along edges, to a matrix.

    Args:
        matrix: on the mesh, V vertices and E edges.
        rows: corners around the vertices: offsets and corners, int32.
        sides: ends of the edges, corners of the triangles, and the two corners opposite to every edge.
        hessians: of every triangle, on and above the diagonal, shape [F, 21].
        weight: that they are multiplied by.
        metric: what is added at the vertices, vec4d, shape [V].
    """
    diagonal, factor = matrix.diagonal.reshape((-1, COORDINATES)).view(wp.vec2d), wp.float64(weight)
    inputs = [*rows, hessians, factor, metric, FIRST_THREAD]
    launch_parts(vertex_entries, matrix.vertices, inputs, [diagonal, matrix.inner], metric.device)
    computed(gather_edge_blocks, [*sides, hessians, factor], matrix.off_diagonal.view(wp.vec4d))


SUFFICIENT_DECREASE = 1e-4  # share of the decrease that the slope predicts (Nocedal and Wright 2006, chapter 3)
# Where rounding still leaves a pivot that is not positive, the diagonal grows by these parts of itself.
DIAGONAL_SHIFTS = (0.0, 1e-12, 1e-9, 1e-6, 1e-3)


class PatchMatrix:
    """The Newton matrix of the freed vertices of patches; order of elimination and storage are kept.

    Args:
        patches: what may move.
        surface: the surface that they are part of.
        growth: what is added to the diagonal, relative to its mean at each vertex.
    """

    def __init__(self, patches: Patches, surface: Surface, growth: float):
        count, mesh = patches.free, Surface(surface.vertices[patches.vertices], patches.faces)
        inner = (mesh.edges < count).all(axis=1)
        edges, edge_corners, (offsets, corners) = mesh.edges[inner], mesh.side_corners[inner], mesh.vertex_corners

        self._sides = [Each(sent(edges, wp.vec2i)), sent(mesh.faces, wp.vec3i), Each(sent(edge_corners, wp.vec2i))]
        self._rows = [sent(offsets[: count + 1], wp.int32), sent(corners, wp.int32)]
        self._metric = wp.zeros(count, dtype=wp.vec4d, device="cpu")
        self._matrix = SaddleMatrix(count, len(edges), 0, 0, self._metric.device)
        factor = mesh_factor(
            count, edges, lambda: part_dissection(surface, patches.vertices[:count], edges), 2, Workspace()
        )
        self._growth, self._factor = growth, factor

    def factorise(self, blocks: Floats) -> None:
        """Factorise the matrix of the blocks of triangles, [F, 21], with a diagonal that grows until it is definite.

        What is added is relative to each vertex, which does not depend on the basis of its tangent plane.

        Raises:
            OmtwarpError: the blocks are not finite, or far from semidefinite.
        """
        gather_blocks(self._matrix, self._rows, self._sides, sent(blocks, wp.float64), 1.0, self._metric)
        diagonal, off_diagonal, _, _ = self._matrix.on_host()
        own = diagonal[:, [0, 1], [0, 1]]
        of_vertices = own.mean(axis=1, keepdims=True)
        for part in DIAGONAL_SHIFTS:
            self.diagonal = own + (self._growth + part) * of_vertices
            diagonal[:, [0, 1], [0, 1]] = self.diagonal
            try:
                self._factor.factorise(MeshMatrix(diagonal, off_diagonal))
                return
            except NotPositiveDefinite:
                continue
        raise OmtwarpError("the distortion of the map is not finite")

    def solve(self, right: Floats) -> Floats:
        """Solve for tangent coordinates, shape [V, 2]."""
        return self._factor.solve(right)
