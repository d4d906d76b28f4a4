"""The conformal map of section 4.1 (Haker et al. 2000), and the discrete harmonic map that transport is measured from.

For the first a triangle ABC is removed, the Dirichlet problems D x = a and D y = b map the other triangles to the
complex plane, and inverse stereographic projection takes the plane to the sphere with the removed triangle around the
north pole. A Möbius transformation then centres the map. It is exact to first order in the size of the triangles.

From there the second minimises the Dirichlet energy on the sphere itself (Gu, Wang, Chan, Thompson and Yau 2004) [1]_,

    E(y) = ½ Σ w_ij |y_i - y_j|²   subject to   |y_v| = 1,   Σ m_v y_v = 0,

with the cotangent weights w of the intrinsic Delaunay triangulation, which are positive, and with m the areas around
vertices. The second condition chooses one of the maps that differ by a Möbius transformation, and keeps the image from
shrinking to a point. The minimum is exact to second order; triangles may be flipped in it, as it is a set of points.

Steps are conjugate gradients, preconditioned by the Laplacian, which is factorised once. On a sphere, and by conformal
invariance near every minimum, the second derivative is 1 - 2 / l (l + 1) times the Laplacian on harmonics of degree l:
between 2/3 and 1 times, since the condition on the mean takes away degree 1. Each step divides the error by ten.

.. [1] X. Gu, Y. Wang, T. Chan, P. Thompson, S.-T. Yau, "Genus zero surface conformal mapping and its application to
   brain surface mapping", IEEE Transactions on Medical Imaging 23 (2004).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from omtwarp.conformal.centring import centre_points
from omtwarp.device.policy import resolve_device
from omtwarp.device.threads import blas_threads
from omtwarp.errors import OmtwarpError
from omtwarp.geometry.axes import OBLIQUE, principal_axes
from omtwarp.geometry.intrinsic import intrinsic_edges
from omtwarp.geometry.sphere_hierarchy import triangle_solid_angles
from omtwarp.mesh.arrays import Floats, Ints, dots, normalised, squared_norms, tangential_parts
from omtwarp.mesh.surface import SPHERE_AREA, MeshLike, Surface, as_sphere, as_surface, triangle_areas
from omtwarp.options import Progress, Record, tell
from omtwarp.solvers.poisson import EdgeLaplacianSolver, cotangent_solver, edge_laplacian


@dataclass(frozen=True)
class ConformalMap:
    """A conformal map to the sphere and its density.

    Attributes:
        sphere: unit vectors, float64, shape [V, 3].
        removed_face: the triangle around the north pole before centring.
        centring_steps: Newton steps of the Möbius centring.
        solver: the factorised cotangent matrix D, ready for more right-hand sides; on a conformal image the matrix is
            the same.
        history: empty: two linear systems make the map.
        converged: True, for the same reason; centring that fails is an error.
    """

    sphere: Floats
    removed_face: int
    centring_steps: int
    solver: EdgeLaplacianSolver
    history: tuple[Record, ...] = ()
    converged: bool = True


@blas_threads(1)
def conformal_map(
    surface: MeshLike, *, intrinsic: bool = False, device: str | None = "auto", progress: Progress | None = None
) -> ConformalMap:
    """Map a closed genus-0 surface to the sphere conformally, centred (section 4.1).

    The triangle removed is the one nearest to equilateral: the paper leaves the choice open, and a thin one would spoil
    the map around the pole. D is assembled from all triangles, as in Haker et al. (2000), and factorised once for both
    coordinates. The dipole on one triangle makes the map exact to first order in that triangle's size.

    Args:
        surface: a mesh in any form that :func:`omtwarp.map_to_sphere` takes.
        intrinsic: assemble D from the triangles of the intrinsic Delaunay triangulation (Bobenko and Springborn 2007),
            whose weights are never negative: on meshes of long triangles far fewer are flipped, and vertices lie nearer
            to where the conformal map of the surface takes them.
        device: a device; the map is made on the host.
        progress: called as ``progress("conformal", done, 4, details)`` before, with the matrix factorised, with both
            systems solved, and after.

    Returns:
        The map. Obtuse triangles can flip, and the tips of long limbs can shrink below what float64 resolves.

    Raises:
        OmtwarpError: the mesh cannot be mapped, the linear systems cannot be solved, or the map cannot be centred.

    Example:
        >>> import omtwarp
        >>> surface = omtwarp.shapes.blob(seed=3, sphere=320)
        >>> start = omtwarp.conformal_map(surface, device="cpu")
        >>> start.sphere.shape == surface.vertices.shape
        True
        >>> omtwarp.distortion(surface, start.sphere, device="cpu").angle["median"] < 2.2
        True
    """
    surface = as_surface(surface)
    tell(progress, "conformal", 0, 4, {})
    resolve_device(device)  # an unknown one is an error here as elsewhere
    points = surface.scaled_vertices
    face = most_regular_face(points @ principal_axes(surface).frame.T, surface.faces)
    pinned = int(surface.faces[face, 0])
    solver = intrinsic_solver(surface, pinned) if intrinsic else cotangent_solver(surface, points, pinned)
    tell(progress, "conformal", 2, 4, {})
    corners = surface.faces[face]
    plane = solver.solve(dipole(surface.vertex_count, corners, points[corners]))
    tell(progress, "conformal", 3, 4, {})
    sphere, steps = centre_points(plane_to_sphere(plane, surface.vertex_areas), surface.vertex_areas)
    tell(progress, "conformal", 4, 4, {})
    return ConformalMap(sphere, face, steps, solver)


def density(surface: Surface, sphere: Floats) -> tuple[Floats, Floats]:
    """Return the density μ of a map: area on the surface over area on the sphere (section 4.1).

    Args:
        surface: the surface, scaled to area 4π internally.
        sphere: its image, unit vectors, float64, shape [V, 3]; flat areas are scaled to 4π too.

    Returns:
        μ of every triangle, shape [F], and of every vertex, shape [V] (areas around the vertex, surface over sphere).
        Infinite where a triangle of the image has no area.
    """
    image = triangle_areas(sphere, surface.faces)
    image *= SPHERE_AREA / image.sum()
    with np.errstate(divide="ignore"):
        return surface.face_areas / image, surface.vertex_areas / (surface.sum_to_vertices(image) / 3.0)


def most_regular_face(points: Floats, faces: Ints) -> int:
    """Return the face nearest to equilateral: largest area over summed squared edge lengths.

    Of equals, as on symmetric shapes, the one that lies farthest in a direction along none of the axes: the order of
    the faces plays no role.
    """
    p0, p1, p2 = points.take(faces.T, axis=0)
    squares = ((p1 - p0) ** 2).sum(1) + ((p2 - p1) ** 2).sum(1) + ((p0 - p2) ** 2).sum(1)
    regularity = triangle_areas(points, faces) / squares
    # Faces that differ by less are equally regular but for rounding.
    best = np.flatnonzero(regularity >= (1.0 - 1e-9) * regularity.max())
    return int(best[np.argmax((p0 + p1 + p2)[best] @ OBLIQUE)])


def intrinsic_solver(surface: Surface, pinned: int = 0) -> EdgeLaplacianSolver:
    """Factorise the cotangent Laplacian of the intrinsic Delaunay triangulation of a surface."""
    edges, weights = intrinsic_edges(surface)
    return EdgeLaplacianSolver(surface, weights, pinned, edges=edges)


def dipole(count: int, face: Ints, corners: Floats) -> Floats:
    """Return the right-hand sides a and b of section 4.1, whose solutions are x and y, as columns, shape [V, 2].

    Args:
        count: number of vertices.
        face: the three of a triangle.
        corners: where they are, shape [3, 3].
    """
    a, b, c = corners
    ab = b - a
    length = float(np.linalg.norm(ab))
    theta = ab @ (c - a) / length**2
    height = float(np.linalg.norm(c - (a + theta * ab)))
    right = np.zeros((count, 2))
    right[face, 0] = [-1.0 / length, 1.0 / length, 0.0]
    # The paper prints both entries of b at A and B with the sign of C's; they have to sum to zero with it (Haker et al.
    # 2000, equation 10), so A and B carry the opposite sign.
    right[face, 1] = [-(1.0 - theta) / height, -theta / height, 1.0 / height]
    return right


def plane_to_sphere(plane: Floats, masses: Floats) -> Floats:
    """Shift and scale the plane so that half of the area falls in the unit disc, and project it to the sphere.

    Args:
        plane: coordinates, shape [V, 2].
        masses: the areas, shape [V].

    Returns:
        Unit vectors, shape [V, 3].

    Raises:
        OmtwarpError: the plane is not finite.
    """
    if not np.isfinite(plane).all():
        raise OmtwarpError("the conformal map is not finite: the surface has triangles too thin for it; remesh them")
    plane = plane - [_median(coordinates, masses) for coordinates in plane.T]
    plane /= _median(np.hypot(*plane.T), masses)
    share = 2.0 / (1.0 + squared_norms(plane)[:, None])
    return np.hstack([share * plane, 1.0 - share])


def _median(values: Floats, masses: Floats) -> float:
    """Return the weighted median: the value below which half of the mass lies."""
    order = np.argsort(values)
    return float(values[order[np.searchsorted(np.cumsum(masses[order]), masses.sum() / 2)]])


STEPS = 60  # most steps
GAIN = 1e-13  # relative to the energy: a step that is expected to gain less is not taken


@dataclass(frozen=True)
class HarmonicMap:
    """The points of a discrete harmonic map.

    Attributes:
        sphere: unit vectors, float64, shape [V, 3]; their mean, weighted by area, is 0.
        history: one record per step, the start first: ``energy``, and ``length``, that of the step.
        converged: whether the last step was expected to gain a share of ``GAIN`` or less.
        collapsed: whether steps led to a map of another degree than 1, so that the points are those they began with.
    """

    sphere: Floats
    history: list[Record]
    converged: bool
    collapsed: bool = False


@blas_threads(1)
def harmonic_points(
    surface: MeshLike, *, start: ArrayLike | None = None, device: str | None = "auto", progress: Progress | None = None
) -> HarmonicMap:
    """Return the discrete harmonic map of a closed genus-0 surface, Möbius-centred.

    A long limb with few vertices around it has none: its last triangles grow over the sphere, and all points end on a
    circle. Where steps lead to a map of another degree than 1, the points are those they began with.

    Args:
        surface: a mesh in any form that :func:`omtwarp.map_to_sphere` takes, V vertices.
        start: points near the map, unit vectors, shape [V, 3]; section 4.1's map with the same weights if left out.
        device: a device; the points are found on the host.
        progress: called as ``progress("conformal", step, most, record)``, the last time with the most.

    Returns:
        The points. Their second-order error falls with the square of the triangles' size on closed forms.

    Raises:
        OmtwarpError: the mesh cannot be mapped, or its points crowd so that they cannot be centred.

    Example:
        >>> import omtwarp
        >>> ball = omtwarp.shapes.icosphere(8)
        >>> found = omtwarp.harmonic_points(ball, device="cpu")
        >>> found.converged, omtwarp.distortion(ball, found.sphere).angle["surface"] < 2.0001
        (True, True)
    """
    surface = as_surface(surface)
    if start is None:
        mapped = conformal_map(surface, intrinsic=True, device=device)
        given, solver = mapped.sphere, mapped.solver
    else:
        given, solver = as_sphere(start, surface), intrinsic_solver(surface)
    masses = surface.vertex_areas
    energy = _DirichletEnergy(surface, solver)
    sphere, _ = centre_points(given, masses)
    began, value = sphere, energy.value(sphere)
    history: list[Record] = [{"iteration": 0, "energy": value, "length": 0.0}]
    before: tuple[Floats, Floats, float] | None = None  # direction, slope and gain of the step before
    converged = False
    for number in range(1, STEPS + 1):
        tell(progress, "conformal", number - 1, STEPS, history[-1])
        pull = energy.pull(sphere)
        slope = tangential_parts(sphere, pull)
        steepest = energy.preconditioned(sphere, slope)
        gain = float((slope * steepest).sum())
        if gain <= GAIN * value:
            converged = True
            break
        direction = -steepest
        if before is not None:
            turned = max(float((steepest * (slope - before[1])).sum()) / before[2], 0.0)
            conjugate = direction + turned * tangential_parts(sphere, before[0])
            direction = conjugate if float((conjugate * slope).sum()) < 0.0 else direction
        curvature = energy.curvature(sphere, pull, direction)
        length = -float((direction * slope).sum()) / curvature if curvature > 0.0 else 1.0
        shortest, moved = 2.0**-10 * length, None  # below this share of a step none lowers the energy
        while length >= shortest:
            moved = _centred(normalised(sphere + length * direction), masses)
            if moved is not None and (lower := energy.value(moved)) < value:
                break
            moved, length = None, 0.5 * length
        if moved is None:
            break
        before = direction, slope, gain
        sphere, value = moved, lower
        history.append({"iteration": number, "energy": value, "length": length})
    tell(progress, "conformal", STEPS, STEPS, history[-1])
    if not covers_once(sphere, surface.faces):
        return HarmonicMap(began, history[:1], converged=False, collapsed=True)
    return HarmonicMap(sphere, history, converged)


def covers_once(sphere: Floats, faces: Ints) -> bool:
    """Return whether a map is of degree 1, and its flipped triangles cover less than half of the sphere.

    Args:
        sphere: unit vectors, shape [V, 3].
        faces: shape [F, 3].
    """
    shares = triangle_solid_angles(*sphere.take(faces.T, axis=0)) / SPHERE_AREA
    return bool(abs(shares.sum() - 1.0) < 0.5 and np.abs(shares).sum() < 2.0)


class _DirichletEnergy:
    """The Dirichlet energy of centred maps of a surface to the sphere, and its derivatives.

    Args:
        surface: closed, V vertices.
        solver: of the Laplacian of its intrinsic Delaunay triangulation.
    """

    def __init__(self, surface: Surface, solver: EdgeLaplacianSolver):
        self._ends, self._weights = intrinsic_edges(surface)
        self._masses, self._solver = surface.vertex_areas, solver
        self._laplacian = edge_laplacian(self._ends, self._weights, surface.vertex_count)

    def value(self, sphere: Floats) -> float:
        """Return ½ Σ w |y_i - y_j|²."""
        i, j = self._ends.T
        return 0.5 * float(self._weights @ squared_norms(sphere.take(i, axis=0) - sphere.take(j, axis=0)))

    def pull(self, sphere: Floats) -> Floats:
        """Return L y, shape [V, 3]; its tangent part is the gradient."""
        return np.asarray(self._laplacian @ sphere)

    def curvature(self, sphere: Floats, pull: Floats, direction: Floats) -> float:
        """Return the second derivative d · (L - y · L y) d along a tangent direction d, from L y."""
        normal = dots(sphere, pull)
        return float((direction * (self._laplacian @ direction - normal[:, None] * direction)).sum())

    def preconditioned(self, sphere: Floats, slope: Floats) -> Floats:
        """Return the tangent step z that L and the condition on the mean give a slope r, shape [V, 3].

        With B = m P, P the projections to the tangent planes, L u + B p = r and Bᵀ u = 0 determine u, and z = P u.
        """
        masses = self._masses[:, None]
        mean = float(masses.sum()) * np.eye(3) - (masses * sphere).T @ sphere  # Σ B
        pull = np.asarray(np.linalg.solve(mean, np.ones(len(slope)) @ slope), dtype=np.float64)
        moved = self._solver.solve(slope - masses * tangential_parts(sphere, pull))
        shift = np.linalg.solve(mean, self._masses @ tangential_parts(sphere, moved))
        return tangential_parts(sphere, moved - shift)


def _centred(sphere: Floats, masses: Floats) -> Floats | None:
    """Return points moved by the Möbius transformation that centres them; None where there is none."""
    try:
        return centre_points(sphere, masses)[0]
    except OmtwarpError:
        return None
