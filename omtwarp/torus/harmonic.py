"""The conformal map of a surface of genus 1 to a flat torus, from two harmonic one-forms.

A closed one-form is written as the differential of a function at vertices plus integers at the corners of triangles,
which jump across a loop. The integers of two loops that cross once span all classes of closed forms with integer
periods; the function that makes each form harmonic is the solution of one Poisson problem. With positive weights the
two forms together map every triangle with its orientation [1]_. The lattice is the one for which the map is as
conformal as a linear change of the plane can make it [2]_.

.. [1] S. Gortler, C. Gotsman, D. Thurston, "Discrete one-forms on meshes and applications to 3D mesh parameterization",
   CAGD 23 (2006).
.. [2] X. Gu, S.-T. Yau, "Global conformal surface parameterization", SGP (2003).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse import csgraph
from scipy.sparse.linalg import splu

from omtwarp.errors import OmtwarpError
from omtwarp.geometry.operators import corner_cotangents
from omtwarp.mesh.surface import SPHERE_AREA, Surface
from omtwarp.topology.handles import cut_handles

Floats = NDArray[np.float64]

# Coordinates are whole multiples of 2^-40, so that adding whole numbers to them is exact.
QUANTUM = 2.0**-40
LEAST_WEIGHT = 1e-3  # of a corner's cotangent: positive weights keep every triangle's orientation


@dataclass(frozen=True)
class FlatTorus:
    """A map of a surface to a flat torus.

    The corner ``k`` of triangle ``f`` lies at ``(coordinates[faces[f, k]] + wraps[f, k]) @ lattice`` in the plane.

    Attributes:
        coordinates: of the vertices, in multiples of the lattice's vectors, float64, shape [V, 2].
        wraps: whole numbers at corners, shape [F, 3, 2].
        lattice: the two vectors that the torus repeats along, as rows, shape [2, 2]; their parallelogram's area is 4π.
    """

    coordinates: Floats
    wraps: NDArray[np.int64]
    lattice: Floats

    def corners(self, faces: NDArray) -> Floats:
        """Corners of the triangles in multiples of the lattice's vectors, exactly, shape [F, 3, 2]."""
        return self.coordinates[faces] + self.wraps


def conformal_torus(surface: Surface) -> FlatTorus:
    """Map a surface of genus 1 to a flat torus, as conformally as its mesh allows.

    Args:
        surface: closed, connected, of genus 1.

    Raises:
        OmtwarpError: the mesh is too coarse for two loops that cross once.
    """
    points, faces = surface.scaled_vertices, surface.faces.astype(np.int64)
    jumps = np.stack(_two_loops(points, faces), axis=2)
    halves = 0.5 * np.maximum(corner_cotangents(points, faces), LEAST_WEIGHT)
    tail, head = np.roll(faces, -1, axis=1), np.roll(faces, -2, axis=1)
    steps = np.roll(jumps, -2, axis=1) - np.roll(jumps, -1, axis=1)  # of the integers along the side opposite a corner
    count = len(points)
    weights = sparse.coo_array((halves.ravel(), (tail.ravel(), head.ravel())), shape=(count, count)).tocsr()
    weights = weights + weights.T
    laplacian = (sparse.diags_array(weights.sum(axis=1)) - weights).tocsc()
    flow = halves[..., None] * steps
    right = np.zeros((count, 2))
    for k in (0, 1):
        right[:, k] = np.bincount(tail.ravel(), flow[..., k].ravel(), minlength=count)
        right[:, k] -= np.bincount(head.ravel(), flow[..., k].ravel(), minlength=count)
    inner = splu(laplacian[1:, 1:]).solve(right[1:])
    values = np.concatenate([np.zeros((1, 2)), inner])
    forms = values[head] - values[tail] + steps
    gram = np.einsum("fk,fki,fkj->ij", halves, forms, forms)
    corner = values[faces] + jumps
    first, second = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    if (first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]).sum() < 0.0:
        values, jumps, gram = values[:, ::-1], jumps[..., ::-1], gram[::-1, ::-1]
    lattice = np.linalg.inv(np.linalg.cholesky(gram))  # rows: lattice' gram lattice is a multiple of the identity
    return _reduced(values, jumps, lattice.T * np.sqrt(SPHERE_AREA / abs(np.linalg.det(lattice))))


def _reduced(values: Floats, jumps: NDArray[np.int64], lattice: Floats) -> FlatTorus:
    """Change to the shortest vectors of the torus's lattice, the first along the x axis (Gauss's reduction)."""
    change = np.eye(2, dtype=np.int64)
    while True:
        if lattice[1] @ lattice[1] < lattice[0] @ lattice[0] * (1.0 - 1e-12):
            turn = np.array([[0, 1], [-1, 0]])
        else:
            whole = round(float(lattice[1] @ lattice[0] / (lattice[0] @ lattice[0])))
            if not whole:
                break
            turn = np.array([[1, 0], [-whole, 1]])
        lattice, change = turn @ lattice, turn @ change
    back = np.round(np.linalg.inv(change)).astype(np.int64)
    values, jumps = values @ back, jumps @ back
    cos, sin = lattice[0] / np.linalg.norm(lattice[0])
    lattice = lattice @ np.array([[cos, -sin], [sin, cos]])
    return FlatTorus(quantised(values), jumps, lattice)


def quantised(values: Floats) -> Floats:
    """Coordinates rounded to the multiples that whole numbers can be added to without rounding."""
    return np.round(values / QUANTUM) * QUANTUM


def _two_loops(points: Floats, faces: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Integers at corners, shape [F, 3] each, that jump by one across two loops that cross once."""
    cut = cut_handles(points, faces, 1)
    one, other = cut.sides[0]
    count = len(cut.vertices)
    edges = Surface(cut.vertices, cut.faces).edges
    rim = np.zeros(count, dtype=bool)
    rim[one] = rim[other] = True
    twin = dict(zip(cut.vertex_origin[other].tolist(), other.tolist(), strict=True))
    lengths = np.linalg.norm(cut.vertices[edges[:, 0]] - cut.vertices[edges[:, 1]], axis=1)
    for start in one.tolist():
        end = twin[int(cut.vertex_origin[start])]
        free = ~rim
        free[[start, end]] = True
        usable = free[edges].all(axis=1)
        graph = sparse.csr_array((lengths[usable], edges[usable].T), shape=(count, count))
        _, before = csgraph.dijkstra(graph, directed=False, indices=start, return_predecessors=True)
        if before[end] < 0:
            continue
        path = [end]
        while path[-1] != start:
            path.append(int(before[path[-1]]))
        crossing = cut.vertex_origin[np.array(path[1:])]
        again = cut_handles(points, faces, 1, loops=[crossing])
        return _jumps(cut.faces, other), _jumps(again.faces, again.sides[0][1])
    raise OmtwarpError("the mesh is too coarse for two loops that cross once: use a finer one")


def _jumps(faces: NDArray, side: NDArray[np.int64]) -> NDArray[np.int64]:
    return np.isin(faces, side).astype(np.int64)


__all__ = ["QUANTUM", "FlatTorus", "conformal_torus", "quantised"]
