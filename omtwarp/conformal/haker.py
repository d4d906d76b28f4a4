"""The conformal map of section 4.1 (Haker et al. 2000).

A triangle ABC is removed, the Dirichlet problems D x = a and D y = b map the other triangles to the complex plane, and
inverse stereographic projection takes the plane to the sphere with the removed triangle around the north pole. A Möbius
transformation then centres the map.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from omtwarp.conformal.centring import centre_points, project_to_sphere
from omtwarp.device.policy import resolve_device
from omtwarp.device.start import wp
from omtwarp.device.threads import blas_threads
from omtwarp.errors import OmtwarpError
from omtwarp.geometry.axes import OBLIQUE, principal_axes
from omtwarp.geometry.intrinsic import intrinsic_edges
from omtwarp.mesh.arrays import Floats, Ints
from omtwarp.mesh.checks import MeshLike, as_surface
from omtwarp.mesh.surface import SPHERE_AREA, Surface, triangle_areas
from omtwarp.options import Progress, Record, tell
from omtwarp.solvers.poisson import EdgeLaplacianSolver, PoissonSolver, cotangent_solver, solve_arrays


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
    solver: PoissonSolver
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
        device: where the per-vertex kernels run.
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
    points = surface.scaled_vertices
    face = most_regular_face(points @ principal_axes(surface).frame.T, surface.faces)
    pinned = int(surface.faces[face, 0])
    solver: PoissonSolver
    if intrinsic:
        solver = intrinsic_solver(surface, pinned)
    else:
        solver = cotangent_solver(surface, points, pinned)
    tell(progress, "conformal", 2, 4, {})
    where = resolve_device(device)
    dipole = _dipole(points, surface.faces[face])
    rights = [wp.array(np.ascontiguousarray(part), dtype=wp.float64, device=where) for part in dipole.T]
    plane = solve_arrays(solver, rights)
    tell(progress, "conformal", 3, 4, {})
    sphere, steps = centre_points(_to_sphere(plane, surface.vertex_areas), surface.vertex_areas, device=device)
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
    p0, p1, p2 = (points[faces[:, k]] for k in range(3))
    squares = ((p1 - p0) ** 2).sum(1) + ((p2 - p1) ** 2).sum(1) + ((p0 - p2) ** 2).sum(1)
    regularity = triangle_areas(points, faces) / squares
    # Faces that differ by less are equally regular but for rounding.
    best = np.flatnonzero(regularity >= (1.0 - 1e-9) * regularity.max())
    return int(best[np.argmax((p0 + p1 + p2)[best] @ OBLIQUE)])


def intrinsic_solver(surface: Surface, pinned: int = 0) -> EdgeLaplacianSolver:
    """Factorise the cotangent Laplacian of the intrinsic Delaunay triangulation of a surface."""
    edges, weights = intrinsic_edges(surface)
    return EdgeLaplacianSolver(surface, weights, pinned, edges=edges)


def _dipole(points: Floats, face: Ints) -> Floats:
    """Return the right-hand sides a and b of section 4.1, whose solutions are x and y, as columns, shape [V, 2]."""
    a, b, c = (points[k] for k in face)
    ab = b - a
    length = float(np.linalg.norm(ab))
    theta = ab @ (c - a) / length**2
    height = float(np.linalg.norm(c - (a + theta * ab)))
    right = np.zeros((len(points), 2))
    right[face, 0] = [-1.0 / length, 1.0 / length, 0.0]
    # The paper prints both entries of b at A and B with the sign of C's; they have to sum to zero with it (Haker et al.
    # 2000, equation 10), so A and B carry the opposite sign.
    right[face, 1] = [-(1.0 - theta) / height, -theta / height, 1.0 / height]
    return right


def _to_sphere(plane: list[wp.array], masses: Floats) -> wp.array:
    """Shift and scale the plane so that half of the area falls in the unit disc, and project it to the sphere.

    Args:
        plane: both coordinates, float64, shape [V] each.
        masses: the areas, shape [V].

    Returns:
        Unit vectors, vec3d, shape [V], where the coordinates are.

    Raises:
        OmtwarpError: the plane is not finite.
    """
    coordinates = [part.numpy() for part in plane]
    if not all(np.isfinite(part).all() for part in coordinates):
        raise OmtwarpError("the conformal map is not finite: the surface has triangles too thin for it; remesh them")
    half = masses.sum() / 2
    shift = np.array([_median(part, masses, half) for part in coordinates])
    radius = np.hypot(*(part - middle for part, middle in zip(coordinates, shift, strict=True)))
    median = _median(radius, masses, half)
    where = plane[0].device
    sphere = wp.empty(len(masses), dtype=wp.vec3d, device=where)
    inputs = [*plane, wp.vec2d(*shift), wp.float64(1.0 / median)]
    wp.launch(project_to_sphere, dim=len(masses), inputs=inputs, outputs=[sphere], device=where)
    return sphere


def _median(values: Floats, masses: Floats, half: float) -> float:
    """Return the weighted median: the value below which half of the mass lies."""
    order = np.argsort(values)
    return float(values[order[np.searchsorted(np.cumsum(masses[order]), half)]])
