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

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from omtwarp.errors import OmtwarpError
from omtwarp.geometry.intrinsic import WeightedEdges, delaunay_edges
from omtwarp.geometry.operators import corner_cotangents
from omtwarp.mesh.arrays import ROUND_OFF, TINY, Floats, edge_keys, summed
from omtwarp.mesh.surface import SPHERE_AREA, Surface, plane_areas
from omtwarp.metrics.dual import edge_steps
from omtwarp.solvers.cholesky import dissect
from omtwarp.solvers.factor import MeshFactor, MeshMatrix, NotPositiveDefinite
from omtwarp.solvers.mesh_factor import mesh_factor, surface_factor
from omtwarp.topology.handles import cut_handles, loops_across
from omtwarp.topology.kind import on_boundary

# Coordinates are whole multiples of 2^-40, so that adding whole numbers to them is exact.
QUANTUM = 2.0**-40
# Half and twice of each of LEAST_WEIGHT, MOST_WEIGHT, PATIENCE and EVEN_AREAS, and 0.6 and 0.9 for RELAXATION, leave
# the area distortion of a mug the same to 0.0001, and its gap to 2 %, after 8 to 10 steps of transport.
LEAST_WEIGHT, MOST_WEIGHT = 0.05, 20.0  # of edges of the mesh itself, so that slivers are neither loose nor rigid
STIFFER = (0.0, 1e-14, 1e-12, 1e-10)  # added to the diagonal where rounding leaves a pivot of the wrong sign
RELAXATIONS = 60  # largest number of steps that change weights towards equal areas; EVEN_AREAS or PATIENCE end it
RELAXATION = 0.8  # share of a vertex's area error, as a logarithm, by which its weights change in a step
PATIENCE = 10  # steps without more even areas after which the iteration ends
EVEN_AREAS = 0.02  # logarithms of areas around vertices, rms: sufficient for a start
MOST_SOFTNESS = 200.0  # logarithms of weights; long limbs need 60


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

    @property
    def points(self) -> Floats:
        """Where the vertices lie in the plane, shape [V, 2]."""
        return self.coordinates @ self.lattice

    @property
    def shift(self) -> Floats:
        """What is added to these points at the corners of triangles, shape [F, 3, 2]."""
        return self.wraps @ self.lattice

    def at(self, points: Floats) -> FlatTorus:
        """Return another map to the same torus, whose vertices lie at these points of the plane."""
        return replace(self, coordinates=points @ np.linalg.inv(self.lattice))

    def corners(self, faces: NDArray) -> Floats:
        """Return the corners of the triangles in multiples of the lattice's vectors, exactly, shape [F, 3, 2]."""
        return self.coordinates[faces] + self.wraps


def conformal_torus(surface: Surface) -> FlatTorus:
    """Map a surface of genus 1 to the flat torus that it is conformal to.

    The energy is that of the intrinsic Delaunay triangulation, whose weights are never negative: it maps the triangles
    of that with their orientation. Triangles of the mesh itself may be turned over.

    Args:
        surface: closed, connected, of genus 1.

    Raises:
        OmtwarpError: the mesh is too coarse for two loops that cross once.
    """
    points, faces = surface.scaled_vertices, surface.faces
    cut = cut_handles(points, faces, 1, thorough=False)  # any two loops will do
    crossing = next(loops_across(cut, cut.sides[0], on_boundary(cut.faces, len(cut.vertices))), None)
    if crossing is None:
        raise OmtwarpError("the mesh is too coarse for two loops that cross once: use a finer one")
    again = cut_handles(points, faces, 1, loops=[crossing])
    # Integers at corners that jump by one across two loops that cross once
    jumps = np.stack([np.isin(each.faces, each.sides[0][1]).astype(np.int64) for each in (cut, again)], axis=2)
    edges = delaunay_edges(surface, jumps)
    values = _harmonic(surface.vertex_count, points, edges)
    forms = values[edges.ends[:, 1]] - values[edges.ends[:, 0]] + edges.steps
    gram = np.einsum("e,ei,ej->ij", edges.weights, forms, forms)
    if plane_areas(values[surface.faces] + jumps).sum() < 0.0:
        values, jumps, gram = values[:, ::-1], jumps[..., ::-1], gram[::-1, ::-1]
    lattice = np.linalg.inv(np.linalg.cholesky(gram))  # rows: lattice' gram lattice is a multiple of the identity
    return _reduced(values, jumps, lattice.T * np.sqrt(SPHERE_AREA / abs(np.linalg.det(lattice))))


def embedded_torus(surface: Surface, torus: FlatTorus) -> FlatTorus:
    """Map the triangles of a surface without flips, where the conformal map may turn some over.

    Every vertex lies at the mean of its neighbours under positive weights, which gives an embedding [1]_. Weights
    are the cotangents at first, bounded away from zero, and are lowered where areas are too small, as long as areas
    come nearer to those of the surface (S. Yoshizawa, A. Belyaev, H.-P. Seidel, "A fast and simple stretch-minimizing
    mesh parameterization", Shape Modeling International (2004)).

    Args:
        surface: closed, connected, of genus 1.
        torus: its conformal map; the wraps and the lattice are taken from it.

    Raises:
        OmtwarpError: triangles are turned over, by floating point.
    """
    cotangents = corner_cotangents(surface.scaled_vertices, surface.faces).ravel()
    own = np.clip(0.5 * cotangents[surface.edge_corners].sum(axis=1), LEAST_WEIGHT, MOST_WEIGHT)
    ends, steps = surface.edges.astype(np.int64), edge_steps(surface, torus.wraps)
    masses = surface.vertex_areas
    factor = surface_factor(surface)
    softness = np.zeros(surface.vertex_count)  # logarithms of what weights are divided by
    best: tuple[float, Floats] | None = None
    worse = 0
    for _ in range(RELAXATIONS):
        weights = own * np.exp(-0.5 * softness[ends].sum(axis=1))
        values = _solved(factor, ends, weights, steps, surface.vertex_count)
        areas = plane_areas((values[surface.faces] + torus.wraps) @ torus.lattice)
        wrong = np.log(masses / np.maximum(surface.sum_to_vertices(areas) / 3.0, TINY))
        spread = float(np.sqrt(masses @ wrong**2 / SPHERE_AREA))
        if (areas > 0.0).all():
            if best is None or spread < best[0]:
                best, worse = (spread, values), 0
            else:
                worse += 1
            if spread < EVEN_AREAS or worse == PATIENCE:
                break
        softness = np.clip(softness + RELAXATION * wrong, -MOST_SOFTNESS, MOST_SOFTNESS)
        softness -= softness.mean()
    if best is None:
        raise OmtwarpError("parts of the surface are so narrow that no map to the torus without flips was found")
    return FlatTorus(best[1], torus.wraps, torus.lattice)


def _harmonic(count: int, points: Floats, edges: WeightedEdges) -> Floats:
    """Return the functions at vertices whose differences and the steps make harmonic forms, shape [V, 2]."""
    apart = edges.ends[:, 0] != edges.ends[:, 1]
    unique, which = np.unique(edge_keys(edges.ends, count)[apart], return_inverse=True)
    # Edges of the same two vertices act as one, whose step is the weighted mean.
    forward = np.where(edges.ends[apart, 0] < edges.ends[apart, 1], 1.0, -1.0)
    weights: Floats = np.bincount(which, edges.weights[apart], len(unique)).astype(np.float64)
    flow = summed((edges.weights[apart] * forward)[:, None] * edges.steps[apart], which, len(unique))
    ends = np.stack([unique // count, unique % count], axis=1)
    factor = mesh_factor(count, ends.astype(np.int32), lambda: dissect(points, ends.astype(np.int32)))
    return _solved(factor, ends, weights, flow / np.maximum(weights, np.finfo(float).tiny)[:, None], count)


def _solved(factor: MeshFactor, ends: NDArray[np.int64], weights: Floats, steps: NDArray, count: int) -> Floats:
    """Minimise Σ w |u_j - u_i + s|² over the edges (i, j); the first vertex lies at 0."""
    i, j = ends.T
    diagonal: Floats = (np.bincount(i, weights, count) + np.bincount(j, weights, count)).astype(np.float64)
    flow = weights[:, None] * steps
    right = summed(flow, i, count) - summed(flow, j, count)
    for stiffer in STIFFER:
        held = diagonal * (1.0 + stiffer) + stiffer * diagonal.mean()
        held[0] *= 2.0  # one vertex is fixed: the sum of all right-hand sides is zero
        try:
            factor.factorise(MeshMatrix(held, -weights))
        except NotPositiveDefinite:
            continue
        values = factor.solve(right)
        return values - values[0]
    raise OmtwarpError("triangles of the surface are too thin for a map to the torus: use evenly shaped ones")


def _reduced(values: Floats, jumps: NDArray[np.int64], lattice: Floats) -> FlatTorus:
    """Change to the shortest vectors of the torus's lattice, the first along the x axis (Gauss's reduction)."""
    change = np.eye(2, dtype=np.int64)
    while True:
        if lattice[1] @ lattice[1] < lattice[0] @ lattice[0] * (1.0 - ROUND_OFF):
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
    """Round coordinates to multiples of a step, so that adding whole numbers to them is exact."""
    return np.round(values / QUANTUM) * QUANTUM
