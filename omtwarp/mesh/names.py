"""Numbers in the input of vertices and faces whose surface was made from it by cutting, filling or doubling."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class InputNames:
    """Hold the numbers that the vertices and faces of a surface have in the input.

    Attributes:
        vertices: the input's vertex that each vertex is, or is a copy of, shape [V]; -1 for new ones.
        faces: the input's face that each face is, or is a part or a copy of, shape [F]; -1 for new ones.
    """

    vertices: NDArray[np.int64]
    faces: NDArray[np.int64]

    def of(self, vertices: NDArray[np.int64], faces: NDArray[np.int64]) -> InputNames:
        """Return the names of a surface that was made from this one.

        Args:
            vertices: this surface's vertex that each vertex is, or is a copy of; -1 for new ones.
            faces: this surface's face that each face is, or is a part or a copy of; -1 for new ones.
        """
        return InputNames(
            np.where(vertices >= 0, self.vertices[vertices], -1), np.where(faces >= 0, self.faces[faces], -1)
        )


def named_face(names: InputNames | None, face: int) -> tuple[int, str]:
    """Return a face's number in the input (-1 for a new one) and its name for messages."""
    number = face if names is None else int(names.faces[face])
    return number, f"face {number}" if number >= 0 else "an added face"


def named_vertex(names: InputNames | None, vertex: int) -> tuple[int, str]:
    """Return a vertex's number in the input (-1 for a new one) and its name for messages."""
    number = vertex if names is None else int(names.vertices[vertex])
    return number, f"vertex {number}" if number >= 0 else "an added vertex"
