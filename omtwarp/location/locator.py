"""A search structure over a triangulated sphere, and its results."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import sparse

from omtwarp.device.arrays import triangles, vectors
from omtwarp.device.policy import resolve_device
from omtwarp.device.start import wp
from omtwarp.device.threads import Arguments, launch_parts
from omtwarp.errors import OmtwarpError
from omtwarp.location.kernels import box_triangles, find_closest, find_faces
from omtwarp.mesh.arrays import normalised


@dataclass(frozen=True)
class Found:
    """Triangles that hold points, and where in them the points lie.

    Attributes:
        faces: triangle of every point, int32, shape [P].
        coordinates: barycentric coordinates there, not negative, sum 1, float64, shape [P, 3].
    """

    faces: NDArray[np.int32]
    coordinates: NDArray[np.float64]

    def matrix(self, faces: NDArray[np.int32], vertex_count: int) -> sparse.csr_matrix:
        """Return the matrix of linear interpolation from the triangulation's vertices to the points, shape [P, V].

        Args:
            faces: the triangulation's, shape [F, 3].
            vertex_count: V.
        """
        count = len(self.faces)
        rows = np.repeat(np.arange(count), 3)
        columns = faces[self.faces].ravel()
        matrix = sparse.csr_matrix((self.coordinates.ravel(), (rows, columns)), shape=(count, vertex_count))
        matrix.eliminate_zeros()
        return matrix

    def on_sphere(self, faces: NDArray[np.int32], sphere: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return where a map of the triangulation to the sphere takes the points, linearly, shape [P, 3].

        Args:
            faces: the triangulation's, shape [F, 3].
            sphere: the map, unit vectors, shape [V, 3].
        """
        return normalised(np.einsum("ij,ijk->ik", self.coordinates, sphere[faces[self.faces]]))


class Locator:
    """Finds where on a triangulated sphere points lie.

    A hierarchy of boxes in single precision selects candidate triangles, and barycentric coordinates in double
    precision decide. Unlike a walk from triangle to triangle, which can go in circles where the triangulation is not
    Delaunay, the search always ends, and triangles may be of any shape.

    Args:
        points: unit vectors, shape [V, 3].
        faces: corners counter-clockwise seen from outside, shape [F, 3]. Triangles that are turned over are never
            found; where a sphere is covered once in all, others lie over them.
        device: ``auto``, ``cpu`` or ``cuda:N``.

    Raises:
        OmtwarpError: no triangles.
    """

    def __init__(self, points: ArrayLike, faces: ArrayLike, *, device: str | None = "auto") -> None:
        self.device = resolve_device(device)
        self._points, self._faces = vectors(points, self.device), triangles(faces, self.device)
        if len(self._faces) == 0:
            raise OmtwarpError("a sphere without triangles: nothing can be located on it")
        lower, upper = (wp.empty(len(self._faces), dtype=wp.vec3, device=self.device) for _ in range(2))
        inputs = [self._points, self._faces]
        wp.launch(box_triangles, dim=len(self._faces), inputs=inputs, outputs=[lower, upper], device=self.device)
        self._boxes = wp.Bvh(lower, upper)

    def find(self, points: ArrayLike | wp.array) -> Found:
        """Return the triangle that holds each point, and where the ray from the centre through the point meets it.

        Args:
            points: of any length but 0, float64, shape [P, 3]; or a Warp array of vec3d.

        Raises:
            OmtwarpError: a point lies in no triangle: the triangulation does not cover the sphere.
        """
        return self._search(points, closest=False)

    def find_closest(self, points: ArrayLike | wp.array) -> Found:
        """Return the flat triangle nearest to each point of the unit sphere, and where in it the nearest point lies.

        This is what Connectome Workbench interpolates with. It differs from :meth:`find` in the second order of the
        triangles' size, and is not continuous across their edges.

        Args:
            points: as for :meth:`find`.

        Raises:
            OmtwarpError: as for :meth:`find`.
        """
        return self._search(points, closest=True)

    def _search(self, points: ArrayLike | wp.array, closest: bool) -> Found:
        queries = vectors(points, self.device)
        count = len(queries)
        found = wp.empty(count, dtype=wp.int32, device=self.device)
        coordinates = wp.empty(count, dtype=wp.vec3d, device=self.device)
        mesh = [self._boxes.id, self._points, self._faces]

        def arguments(part: slice) -> Arguments:
            return [queries[part], *mesh], [found[part], coordinates[part]]

        if count:
            launch_parts(find_faces, count, arguments, self.device)
            if closest:
                launch_parts(find_closest, count, arguments, self.device)
        faces = found.numpy()
        if count and faces.min() < 0:
            missed = np.flatnonzero(faces < 0)
            raise OmtwarpError(
                f"{len(missed)} of {count} points lie in no triangle, first point {missed[0]}: the triangulation does "
                "not cover the sphere"
            )
        return Found(faces, coordinates.numpy().reshape(-1, 3))
