"""Where the vertices and faces of a surface come from that was made from another, and data that follow them."""

from dataclasses import dataclass, field
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from omtwarp.errors import OmtwarpError
from omtwarp.mesh.arrays import Indices, Ints

Numbers = TypeVar("Numbers", bound=np.generic)


@dataclass(frozen=True, eq=False)
class Origins:
    """What the vertices and faces of a surface are in the one that it was made from: cut, filled, split, repaired, ...

    Attributes:
        vertex_origin: the vertex that each vertex is or is a copy of, shape [V]; -1 for new ones.
        face_origin: the face that each face is or is a part of, shape [F]; -1 for new ones.
        split_edges: the two vertices of this surface that each of its first K new vertices lies halfway between,
            shape [K, 2].
        given: number of vertices of the surface that it was made from, where that is known.
    """

    vertex_origin: Indices
    face_origin: Indices
    split_edges: Indices = field(default_factory=lambda: np.zeros((0, 2), dtype=np.int64), kw_only=True)
    given: int | None = field(default=None, kw_only=True)

    def compose(self, later: "Origins") -> "Origins":
        """Return the origins, in the surface that this one was made from, of another that was made from this one."""
        kept, given = later.vertex_origin >= 0, len(self.vertex_origin)
        vertices = np.where(kept, self.vertex_origin[later.vertex_origin], -1)
        faces = np.where(later.face_origin >= 0, self.face_origin[later.face_origin], -1)
        ends = Origins(later.vertex_origin, faces, given=given).places()[self._ends()[later.vertex_origin]]
        ends = np.where(kept[:, None], ends, later._ends())[vertices < 0]
        known = np.logical_and.accumulate((ends >= 0).all(axis=1))
        return Origins(vertices, faces, split_edges=ends[known], given=self.given)

    def places(self) -> Indices:
        """Return the first vertex of this surface that is, or is a copy of, each of the one that it was made from.

        It is -1 for those that are gone, and at the end, so that -1 leads to -1: shape [N + 1].
        """
        place = np.full(self._count() + 1, -1)
        place[self.vertex_origin[::-1]] = np.arange(len(self.vertex_origin))[::-1]
        place[-1] = -1
        return place

    def _count(self) -> int:
        return max(self.given or 0, int(self.vertex_origin.max(initial=-1)) + 1)

    def _ends(self) -> Indices:
        """Return the two vertices that each new one lies halfway between, -1 where none are known, shape [V, 2]."""
        new = np.flatnonzero(self.vertex_origin < 0)[: len(self.split_edges)]
        ends = np.full((len(self.vertex_origin), 2), -1)
        ends[new] = self.split_edges[: len(new)]
        return ends

    def whole_faces(self, faces: Ints) -> Ints:
        """Return the corners, vertices of this surface, of the face that each face is a part of, shape [F, 3].

        A face without new corners is returned as it is, and so is a part of one whose corners are not all known.
        """
        old, whole = self.vertex_origin[faces] >= 0, faces.copy()
        pairs = np.unique(np.column_stack([np.repeat(self.face_origin, 3), faces.ravel()])[old.ravel()], axis=0)
        first, end = (np.searchsorted(pairs[:, 0], self.face_origin, side) for side in ("left", "right"))
        part = ~old.all(axis=1) & (self.face_origin >= 0) & (end - first == 3)
        whole[part] = pairs[first[part, None] + np.arange(3), 1]
        return whole

    def prolong(self, values: NDArray[np.generic]) -> NDArray[np.generic]:
        """Carry data at the vertices of the surface that this one was made from to the vertices of this one.

        A vertex in the middle of an edge has the mean of the edge's ends, whole numbers such as labels those of the
        first end. Data of another length, as those of this surface itself, are returned as they are.

        Args:
            values: shape [N] or [N, K].
        """
        left, ends = self.vertex_origin < 0, self._ends()
        if values.ndim == 0 or len(values) != self._count() or (ends[left] < 0).any():
            return values
        carried = values[self.vertex_origin]
        while left.any():  # an end can be the middle of another edge
            ready = left & ~left[ends].any(axis=1)
            if not ready.any():
                return values
            first, second = carried[ends[ready, 0]], carried[ends[ready, 1]]
            carried[ready] = 0.5 * first + 0.5 * second if values.dtype.kind == "f" else first
            left = left & ~ready
        return carried

    def restrict(self, values: NDArray[Numbers]) -> NDArray[Numbers]:
        """Carry data at the vertices of this surface back to those of the one that it was made from.

        Of several copies of a vertex, the first counts. Where a vertex is gone, there is no number: NaN.

        Args:
            values: shape [V] or [V, K].

        Returns:
            Shape [N] or [N, K].

        Raises:
            OmtwarpError: another length, or whole numbers, of which none is NaN, where vertices are gone.
        """
        place = self.places()[:-1]
        gone = np.flatnonzero(place < 0)
        if values.ndim == 0 or len(values) != len(self.vertex_origin):
            raise OmtwarpError(f"data of shape {list(values.shape)} for {len(self.vertex_origin)} vertices")
        if len(gone) and values.dtype.kind != "f":
            raise OmtwarpError(f"{len(gone)} vertices are gone, first vertex {gone[0]}, and have no whole number")
        carried = values[place]
        carried[gone] = np.nan
        return carried


@dataclass(frozen=True, eq=False)
class Derived(Origins):
    """A surface that was made from another, with its origins.

    Attributes:
        vertices: float64, shape [V, 3].
        faces: shape [F, 3].
    """

    vertices: NDArray[np.float64]
    faces: NDArray[np.integer]


def named(origins: Origins | None, kind: str, number: int) -> tuple[int, str]:
    """Return the number in the input, -1 for a new one, of a ``face`` or ``vertex``, and its name for messages."""
    given = number if origins is None else int(vars(origins)[f"{kind}_origin"][number])
    return given, f"{kind} {given}" if given >= 0 else f"an added {kind}"
