"""The cells whose areas a map keeps: the triangles around every vertex, or every triangle of a mesh that is quartered.

To keep the areas of all triangles of a mesh would leave its map no freedom: 2V - 5 conditions on 2V - 3 coordinates.
To keep the areas around vertices, on which the paper's density is defined, leaves half of it, as in the smooth problem.
In a quartered mesh (:mod:`omtwarp.mesh.quarter`) the triangles c of the mesh, each the sum of four parts, can be kept:
this is the element P1-iso-P2/P0 of incompressible elasticity, which does not lock. A triangle's mass lies on its six
vertices, a twelfth on each corner and a quarter on each middle of an edge, so that the vertices' masses are those of
the quartered mesh.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable

import numpy as np

from omtwarp.device.arrays import Workspace
from omtwarp.device.start import KERNEL_OPTIONS, wp
from omtwarp.device.sums import SparseProduct, scaled
from omtwarp.device.threads import FIRST_THREAD, launch_parts
from omtwarp.location import combined
from omtwarp.mesh.arrays import Floats, Ints
from omtwarp.mesh.quarter import PARTS, QuarteredSurface
from omtwarp.mesh.surface import Surface
from omtwarp.optimal.kernels import edge_slopes
from omtwarp.solvers.mesh_factor import SaddlePointFactor, cell_saddle_factor, coordinate_factor, surface_saddle_factor

wp.set_module_options(KERNEL_OPTIONS)


CORNER_SHARE, MIDDLE_SHARE = 1.0 / 12.0, 1.0 / 4.0  # of a triangle's mass, on each of its six vertices
# Largest root mean square and largest single relative error of areas that count as kept: of those around vertices, and
# of triangles, which are corrected afterwards.
MAX_RING_RMS, MAX_RING_ERROR = 2e-4, 9e-3
MAX_CELL_RMS, MAX_CELL_ERROR = 1e-3, 0.05


@wp.kernel
def cell_slopes(
    of_parts: wp.array2d[wp.vec2d],
    # Data out:
    slopes: wp.array2d[wp.vec2d],
):
    """Sum the derivatives of the parts' areas to those of every cell by its six vertices, shape [N, 6]."""
    c = wp.tid()
    begin = PARTS * c
    for k in range(3):
        slopes[c, k] = of_parts[begin + k, 0]
        # The middle of the edge from corner k to the next is in the parts of both, and in the one in the middle.
        slopes[c, 3 + k] = of_parts[begin + k, 1] + of_parts[begin + (k + 1) % 3, 2] + of_parts[begin + 3, k]


class Cells:
    """N cells that cover a surface once, or several times.

    Arrays of cells, vertices and triangles are float64 on the device of the maps.

    Args:
        surface: V vertices and F triangles.
        of_triangles: the cells that every triangle belongs to, shape [F, K].
        wanted: their areas, shape [N].
        slope_count: number of derivatives that :meth:`slopes` writes.
        device: a Warp device.

    Attributes:
        wanted: their areas, on the host, shape [N].
        tolerances: root mean square and largest relative error up to which areas count as kept.
        areas: returns the areas of the cells, shape [N], from those of the triangles, shape [F].
        on_triangles: returns the sum of the potentials, shape [N], of the cells that a triangle belongs to, shape [F].
        means: returns the mean over every cell's mass, shape [N], of a number per vertex, shape [V].
        masses: divides the areas of the cells among the vertices as their masses are, shape [V]; 4π times a factor in
            all.
        multipliers: N; 0 where areas are measured and not kept.
        slope_count: see above.
    """

    tolerances: tuple[float, float]
    means: Callable[[wp.array], wp.array]
    masses: Callable[[wp.array, float], wp.array]

    def __init__(self, surface: Surface, of_triangles: Ints, wanted: Floats, slope_count: int, device: wp.Device):
        self._surface, self._device, self._mesh = surface, device, surface.on(device)
        self.wanted, self.multipliers, self.slope_count = wanted, len(wanted), slope_count
        belongs = combined(of_triangles, np.ones(of_triangles.shape), len(wanted))
        self.areas, self.on_triangles = SparseProduct(belongs.T, device), SparseProduct(belongs, device)

    @abstractmethod
    def slopes(self, of_triangles: wp.array, out: wp.array) -> None:
        """Write the derivatives of the areas as :class:`omtwarp.solvers.cholesky.saddle.SaddleMatrix` has them.

        Args:
            of_triangles: derivatives of the triangles' areas by their corners, vec2d, shape [F, 3].
            out: shape [slope_count].
        """

    @abstractmethod
    def factor(self, workspace: Workspace | None = None) -> SaddlePointFactor:
        """Return what factorises matrices with a multiplier for every cell."""


class RingCells(Cells):
    """The triangles around every vertex: N = V cells, which cover the surface three times.

    Args:
        surface: V vertices.
        device: a Warp device.
    """

    tolerances = (MAX_RING_RMS, MAX_RING_ERROR)

    def __init__(self, surface: Surface, device: wp.Device):
        super().__init__(surface, surface.faces, 3.0 * surface.vertex_areas, 4 * len(surface.edges), device)

    def means(self, values: wp.array) -> wp.array:
        """Return the numbers of the vertices themselves, shape [V]."""
        return values

    def masses(self, areas: wp.array, factor: float) -> wp.array:
        """Return a third of the areas around vertices, times a factor, shape [V]."""
        return scaled(areas, factor / 3.0)

    def slopes(self, of_triangles: wp.array, out: wp.array) -> None:
        """Write the derivatives across every edge, both ways."""
        mesh, edges = self._mesh, len(self._surface.edges)
        both = out.reshape((2, edges, 2)).view(wp.vec2d)
        inputs = [of_triangles, mesh.faces, mesh.edges, mesh.edge_corners, FIRST_THREAD]
        launch_parts(edge_slopes, edges, inputs, [both], self._device)

    def factor(self, workspace: Workspace | None = None) -> SaddlePointFactor:
        """Return what factorises matrices with a multiplier for every vertex."""
        return surface_saddle_factor(self._surface, workspace)


class MeasuredRings(RingCells):
    """The triangles around every vertex, whose areas are measured and not kept."""

    tolerances = (np.inf, np.inf)

    def __init__(self, surface: Surface, device: wp.Device):
        super().__init__(surface, device)
        self.multipliers = self.slope_count = 0

    def factor(self, workspace: Workspace | None = None) -> SaddlePointFactor:
        """Return what factorises matrices of the vertices' coordinates alone."""
        return coordinate_factor(self._surface, workspace)


class TriangleCells(Cells):
    """The triangles of a mesh, each the sum of four parts in the quartered mesh.

    Args:
        quartered: the mesh's N triangles in four parts each.
        device: a Warp device.

    Attributes:
        vertices: of every cell, its corners, then the middles of the edges that begin there, shape [N, 6].
    """

    tolerances = (MAX_CELL_RMS, MAX_CELL_ERROR)

    def __init__(self, quartered: QuarteredSurface, device: wp.Device):
        surface = quartered.surface
        corners = surface.faces.reshape(-1, PARTS, 3)[:, :3, 0]
        self.vertices: Ints = np.concatenate([corners, quartered.middles], axis=1)
        wanted = quartered.sum_of_parts(surface.face_areas)
        super().__init__(surface, quartered.parents[:, None], wanted, 2 * self.vertices.size, device)
        share = np.tile(np.repeat([CORNER_SHARE, MIDDLE_SHARE], 3), (len(self.vertices), 1))
        shares = combined(self.vertices, share, surface.vertex_count)
        self.means, self.masses = SparseProduct(shares, device), SparseProduct(shares.T, device)

    def slopes(self, of_triangles: wp.array, out: wp.array) -> None:
        """Write the derivatives by every triangle's six vertices."""
        slopes = out.reshape((self.multipliers, 6, 2)).view(wp.vec2d)
        wp.launch(cell_slopes, dim=self.multipliers, inputs=[of_triangles], outputs=[slopes], device=self._device)

    def factor(self, workspace: Workspace | None = None) -> SaddlePointFactor:
        """Return what factorises matrices with a multiplier for every triangle."""
        return cell_saddle_factor(self._surface.scaled_vertices, self._surface.edges, self.vertices)
