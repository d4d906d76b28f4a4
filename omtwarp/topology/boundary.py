"""Boundary loops of oriented manifold triangle meshes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from omtwarp.errors import OmtwarpError


def boundary_half_edges(faces: NDArray, vertex_count: int) -> NDArray[np.int64]:
    """Return the directed edges (tail, head) of faces that no other face runs through the other way, shape [B, 2].

    Args:
        faces: vertex indices of an oriented mesh, shape [F, 3].
        vertex_count: V.
    """
    tail = np.asarray(faces, dtype=np.int64).ravel()
    head = np.roll(np.asarray(faces, dtype=np.int64), -1, axis=1).ravel()
    alone = ~np.isin(tail * vertex_count + head, head * vertex_count + tail)
    return np.stack([tail[alone], head[alone]], axis=1)


def boundary_loops(faces: NDArray, vertex_count: int) -> list[NDArray[np.int64]]:
    """Return the closed loops of boundary vertices, each in the direction in which the faces run through them.

    The loops are ordered by their smallest vertex, and each begins there, so that the same mesh gives the same loops.

    Args:
        faces: vertex indices of an oriented manifold mesh, shape [F, 3].
        vertex_count: V.

    Raises:
        OmtwarpError: two loops, or one loop twice, run through the same vertex.
    """
    half = boundary_half_edges(faces, vertex_count)
    tails, counts = np.unique(half[:, 0], return_counts=True)
    if (counts > 1).any():
        vertex = int(tails[np.argmax(counts > 1)])
        raise OmtwarpError(
            f"the boundary runs through vertex {vertex} more than once: split the vertex in a mesh editor"
        )
    following = dict(half.tolist())
    loops = []
    for start in tails.tolist():
        if start not in following:
            continue
        loop, at = [start], following.pop(start)
        while at != start:
            loop.append(at)
            at = following.pop(at)
        loops.append(np.array(loop, dtype=np.int64))
    return loops


def loop_length(vertices: NDArray[np.float64], loop: NDArray[np.int64]) -> float:
    """Return the length of a closed loop of vertices, in the units of the input."""
    points = vertices[loop]
    return float(np.linalg.norm(np.roll(points, -1, axis=0) - points, axis=1).sum())
