"""The matrix of a Newton step, [A, Bᵀ; B, -C]: two coordinates for every vertex, and multipliers.

Unknowns 2 v and 2 v + 1 are the coordinates of vertex v, 2 V + c is multiplier c. All entries are in one array, in the
order in which factorisations take them, so that a matrix travels between device and host at once.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from omtwarp.device.arrays import empty
from omtwarp.device.start import wp

Numbers = NDArray[np.float64]

COORDINATES = 2  # unknowns of a vertex


class SaddleMatrix:
    """The entries of one matrix on a mesh, written in parts.

    Args:
        vertices: V, of the mesh.
        edges: E.
        multipliers: N; none for a matrix of the coordinates alone.
        slopes: number of entries of B.
        device: a Warp device.

    Attributes:
        entries: all of them, float64; what follows are parts of it.
        diagonal: of A, shape [2 V].
        compliance: the diagonal of -C, shape [N].
        off_diagonal: A's blocks of the edges (i, j), rows of i, columns of j, shape [E, 4].
        slopes: B's entries. Of multipliers of vertices: of every edge, row i by the coordinates of j, then of every
            edge, row j by those of i. Of cells: of every cell by the coordinates of its vertices.
        inner: A's entries between the two coordinates of a vertex, shape [V].
    """

    def __init__(self, vertices: int, edges: int, multipliers: int, slopes: int, device: wp.Device):
        self.vertices, self.multipliers = vertices, multipliers
        sizes = [COORDINATES * vertices, multipliers, 4 * edges, slopes, vertices]
        ends = np.cumsum([0, *sizes]).tolist()
        self.entries, none = (empty(count, wp.float64, device) for count in (ends[-1], 0))
        parts = [self.entries[a:b] if b > a else none for a, b in pairwise(ends)]
        self.diagonal, self.compliance, off_diagonal, self.slopes, self.inner = parts
        self.off_diagonal = off_diagonal.reshape((edges, 4))
        self._ends = ends

    @classmethod
    def of(cls, own: Numbers, others: Numbers, slopes: Numbers, compliance: Numbers) -> SaddleMatrix:
        """Return a matrix on the host.

        Args:
            own: A's blocks of the vertices, shape [V, 2, 2].
            others: A's blocks of the edges, shape [E, 2, 2].
            slopes: B's entries in any shape.
            compliance: C's diagonal, shape [N].
        """
        matrix = cls(len(own), len(others), len(compliance), slopes.size, wp.get_device("cpu"))
        numbers = [own[:, [0, 1], [0, 1]], -compliance, others, slopes, own[:, 0, 1]]
        np.concatenate([part.ravel() for part in numbers], out=matrix.entries.numpy())
        return matrix

    def on_host(self) -> tuple[Numbers, Numbers, Numbers, Numbers]:
        """Return the numbers that :meth:`of` takes; of B flat."""
        diagonal, compliance, others, slopes, inner = np.split(self.entries.numpy(), self._ends[1:-1])
        own = np.empty((self.vertices, 2, 2))
        own[:, [0, 1], [0, 1]] = diagonal.reshape(-1, 2)
        own[:, 0, 1] = own[:, 1, 0] = inner
        return own, others.reshape(-1, 2, 2), slopes, -compliance
