"""Where the vertices and faces of a surface come from that was made from another, and data that follow them."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Ints = NDArray[np.int64]


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

    vertex_origin: Ints
    face_origin: Ints
    split_edges: Ints = field(default_factory=lambda: np.zeros((0, 2), dtype=np.int64), kw_only=True)
    given: int | None = field(default=None, kw_only=True)

    def compose(self, later: "Origins") -> "Origins":
        """Return the origins, in the surface that this one was made from, of another that was made from this one."""
        vertices = np.where(later.vertex_origin >= 0, self.vertex_origin[later.vertex_origin], -1)
        faces = np.where(later.face_origin >= 0, self.face_origin[later.face_origin], -1)
        return Origins(vertices, faces, split_edges=later.split_edges, given=self.given)

    def prolong(self, values: NDArray[np.generic]) -> NDArray[np.generic]:
        """Carry data at the vertices of the surface that this one was made from to the vertices of this one.

        A vertex in the middle of an edge has the mean of the edge's ends, whole numbers such as labels those of the
        first end. Data of another length, as those of this surface itself, are returned as they are.

        Args:
            values: shape [N] or [N, K].
        """
        given = int(self.vertex_origin.max(initial=-1)) + 1 if self.given is None else self.given
        new = np.flatnonzero(self.vertex_origin < 0)
        if values.ndim == 0 or len(values) != given or len(new) > len(self.split_edges):
            return values
        carried = values[self.vertex_origin]
        left = np.ones(len(carried), dtype=bool)
        left[self.vertex_origin >= 0] = False
        ends = self.split_edges[: len(new)]
        while left.any():  # an end can be the middle of another edge
            ready = left[new] & ~left[ends].any(axis=1)
            if not ready.any():
                return values
            first, second = carried[ends[ready, 0]], carried[ends[ready, 1]]
            carried[new[ready]] = 0.5 * first + 0.5 * second if values.dtype.kind == "f" else first
            left[new[ready]] = False
        return carried


@dataclass(frozen=True, eq=False)
class Derived(Origins):
    """A surface that was made from another, with its origins.

    Attributes:
        vertices: float64, shape [V, 3].
        faces: int32, shape [F, 3].
    """

    vertices: NDArray[np.float64]
    faces: NDArray[np.int32]


def named_face(names: Origins | None, face: int) -> tuple[int, str]:
    """Return a face's number in the input (-1 for a new one) and its name for messages."""
    number = face if names is None else int(names.face_origin[face])
    return number, f"face {number}" if number >= 0 else "an added face"


def named_vertex(names: Origins | None, vertex: int) -> tuple[int, str]:
    """Return a vertex's number in the input (-1 for a new one) and its name for messages."""
    number = vertex if names is None else int(names.vertex_origin[vertex])
    return number, f"vertex {number}" if number >= 0 else "an added vertex"
