"""The optimal map of a doubled surface among its mirror-symmetric maps, at the cost of solving on one half.

On symmetric maps the energy of the double is twice that of the half, and a step that keeps the symmetry is one of the
half in which vertices of the boundary slide along the equator: the natural condition. So the saddle-point system of
:mod:`omtwarp.optimal.solver` is solved on the half alone, with half the cells, masses and areas at the boundary and no
motion across it; the other half moves as the mirror image, and the boundary has z = 0 to the last bit.
"""

import numpy as np
from numpy.typing import NDArray

from omtwarp.device.arrays import Workspace, vectors
from omtwarp.device.start import wp
from omtwarp.mesh.arrays import Floats, normalised, tangential_parts
from omtwarp.mesh.surface import Surface
from omtwarp.optimal.cells import Cells, TriangleCells
from omtwarp.optimal.sphere import Sphere
from omtwarp.solvers.cholesky import dissect
from omtwarp.solvers.cholesky.saddle import COORDINATES, SaddleMatrix
from omtwarp.solvers.mesh_factor import SaddlePointFactor, cell_saddle_factor, solve_parts, vertex_saddle_factor
from omtwarp.topology.closing import Double

ACROSS = np.array([1.0, 1.0, -1.0])  # what the reflection about the equator does to coordinates


def folded(double: Double, vectors_: Floats) -> Floats:
    """Symmetrise points or tangent vectors: the copy gets mirror images of the surface's, the boundary z = 0.

    Args:
        double: the surface and its copy, W vertices.
        vectors_: shape [W, 3].
    """
    out = vectors_.copy()
    out[double.on_boundary, 2] = 0.0
    out[double.copied] = out[double.mirror[double.copied]] * ACROSS
    return out


def folded_map(double: Double, sphere: Floats) -> Floats:
    """Symmetrise a map, shape [W, 3], by :func:`folded`, and normalise the boundary to its circle."""
    out = folded(double, sphere)
    rim = np.flatnonzero(double.on_boundary & (sphere[:, 2] != 0.0))
    out[rim] = normalised(out[rim])
    return out


class MirroredSphere(Sphere):
    """The sphere with a plane of symmetry, as the domain of the maps of a double, symmetric to the last bit.

    Args:
        double: the surface and its copy, W vertices.
        surface: the double as a surface.
        device: a Warp device.
    """

    def __init__(self, double: Double, surface: Surface, device: wp.Device):
        super().__init__(surface, device)
        self._double, self._examined = double, surface.face_count // 2  # not the mirror images

    def moved(self, points: wp.array, direction: wp.array, share: wp.array, length: float) -> wp.array:
        """Return a symmetric map after a step of the surface's own vertices, vec3d, shape [W]."""
        return vectors(folded_map(self._double, super().moved(points, direction, share, length).numpy()), self.device)

    def joined(self, freed: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Return vertices that move on their own, shape [W], with their mirror images."""
        return freed | freed[self._double.mirror]

    def completed(self, points: wp.array, multipliers: wp.array) -> tuple[wp.array, wp.array]:
        """Return a map and its multipliers with those of the copies, where vertices of the surface moved."""
        numbers, copied = multipliers.numpy().copy(), self._double.copied
        numbers[copied] = numbers[self._double.mirror[copied]]
        folded_ = vectors(folded(self._double, points.numpy()), self.device)
        return folded_, wp.array(numbers, dtype=wp.float64, device=self.device)

    def factor(self, cells: Cells, workspace: Workspace | None) -> SaddlePointFactor:
        """Solve on the half the systems of the double."""
        return MirrorFactor(self, self._double, cells.vertices if isinstance(cells, TriangleCells) else None)


class MirrorFactor(SaddlePointFactor):
    """Solves symmetric saddle-point systems of a double for their symmetric solutions, on the half.

    Args:
        sphere: where the vertices of the double move.
        double: the surface and its copy, W vertices.
        cells: of a quartered mesh, which multipliers belong to: the vertices of every cell, each on one side of the
            boundary, the copies in the second half, shape [N, K]; where it is None they belong to vertices.
    """

    def __init__(self, sphere: Sphere, double: Double, cells: NDArray[np.int32] | None):
        self._sphere, self._double, self._device = sphere, double, sphere.device
        self._half, edges = double.half, sphere.surface.edges
        number = np.full(len(double.mirror), -1, dtype=np.int32)
        number[self._half] = np.arange(len(self._half))
        self._kept = np.flatnonzero((number[edges] >= 0).all(axis=1))
        self._edges = own = number[edges[self._kept]]
        on_rim = double.on_boundary[self._half]
        self._rim = np.flatnonzero(on_rim)
        self._share = np.where(on_rim, 0.5, 1.0)[:, None]
        self._edge_share = np.where(on_rim[own].all(axis=1), 0.5, 1.0)[:, None]  # of edges of the boundary a half
        places = sphere.surface.scaled_vertices[self._half]
        # Of the multipliers and of the pairs of derivatives, which are the half's, in which shares, and whose.
        if cells is None:
            self._cells, self._cell_share = self._half, self._share[:, 0]
            self._of_copies = number[np.minimum(double.mirror, np.arange(len(double.mirror)))]
            # The areas of the first end by the second one's coordinates come first.
            self._pairs, self._pair_ends = np.r_[self._kept, len(edges) + self._kept], np.r_[own[:, 1], own[:, 0]]
            self._pair_share = np.tile(self._edge_share, (2, 1))
            self._factor = vertex_saddle_factor(len(places), own, lambda: dissect(places, own))
        else:
            own_cells = number[cells[: len(cells) // 2]]
            self._cells, self._cell_share = np.arange(len(own_cells)), np.ones(len(own_cells))
            self._of_copies = np.tile(self._cells, 2)
            self._pairs, self._pair_ends = np.arange(own_cells.size), own_cells.ravel()
            self._pair_share = np.ones((own_cells.size, 1))
            self._factor = cell_saddle_factor(places, own, own_cells)
        self._points: wp.array | None = None
        self._normals = np.zeros((len(self._half), 2))

    def factorise(self, matrix: SaddleMatrix) -> None:
        """Factorise a matrix of the double.

        Raises:
            NotPositiveDefinite: it is not definite on the half.
        """
        self._points = matrix.points
        up = np.zeros((len(self._double.mirror), 3))
        up[self._half[self._rim], 2] = 1.0
        self._normals = self._coordinates(up)[self._half]
        diagonal, off_diagonal, gradients, compliance = matrix.on_host()
        own, others = self._halved(diagonal, off_diagonal)
        slopes = gradients.reshape(-1, COORDINATES)[self._pairs] * self._pair_share  # none crosses the boundary
        slopes = tangential_parts(self._normals[self._pair_ends], slopes)
        self._factor.factorise(SaddleMatrix.of(own, others, slopes, compliance[self._cells] * self._cell_share))

    def _halved(self, diagonal: Floats, off_diagonal: Floats) -> tuple[Floats, Floats]:
        """Return the blocks of the half's vertices and edges from those of the double.

        No motion crosses the boundary: its component is projected out and gets a pivot of its own.
        """
        rim, normal = self._rim, self._normals[self._rim]
        outer = normal[:, :, None] * normal[:, None, :]
        projection = np.eye(2) - outer
        own = diagonal[self._half] * self._share[..., None]
        own[rim] = projection @ own[rim] @ projection + np.trace(own[rim], axis1=1, axis2=2)[:, None, None] * outer
        others = off_diagonal[self._kept] * self._edge_share[..., None]
        for end in self._edges.T:  # the columns of a block belong to the first end, the rows to the second
            others = tangential_parts(self._normals[end][:, None], others.transpose(0, 2, 1))
        return own, others

    def solve(self, right: wp.array) -> wp.array:
        """Solve for coordinates and multipliers of a symmetric right-hand side, shape [2 W + N]."""
        numbers, split = right.numpy(), COORDINATES * len(self._double.mirror)
        first = tangential_parts(self._normals, numbers[:split].reshape(-1, COORDINATES)[self._half] * self._share)
        u, q = solve_parts(self._factor, first, numbers[split:][self._cells] * self._cell_share)
        numbers = np.zeros((len(self._double.mirror), COORDINATES))
        numbers[self._half] = u
        step = self._sphere.vectors(self._points, wp.array(numbers, dtype=wp.float64, device=self._device))
        whole = [self._coordinates(folded(self._double, step.numpy())).ravel(), q[self._of_copies]]
        return wp.array(np.concatenate(whole), dtype=wp.float64, device=self._device)

    def _coordinates(self, tangent: Floats) -> Floats:
        """Convert tangent vectors, shape [W, 3], to coordinates in the bases of the map, shape [W, 2]."""
        return self._sphere.coordinates(self._points, self._sphere.sent(tangent)).numpy()
