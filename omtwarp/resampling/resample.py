"""Resampling from one map or sphere to another: the matrix, its two ends, and its application."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias, TypeGuard

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import sparse

from omtwarp.errors import OmtwarpError
from omtwarp.files import as_path, staged
from omtwarp.inputs import holds_array, read_bytes
from omtwarp.limits import LARGEST_MESH_FILE
from omtwarp.mesh.arrays import real_numbers, whole_numbers
from omtwarp.mesh.checks import MeshLike
from omtwarp.mesh.data import read_data
from omtwarp.mesh.read import read_mesh
from omtwarp.mesh.surface import triangle_areas
from omtwarp.options import Interpolation, choose
from omtwarp.resampling import weights
from omtwarp.result import OF_MAPS, MapResult
from omtwarp.spheres import SphereGrid, is_named, mesh_grid, named_grid

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class SpherePoints:
    """One end of a resampling: points on the sphere, and the surface they were mapped from where there is one.

    Attributes:
        grid: the points, their triangles or pixels.
        vertices: the surface's vertices, float64, shape [N, 3]; None for a sphere alone.
    """

    grid: SphereGrid
    vertices: Floats | None = None

    def surface_areas(self) -> Floats:
        """Return the area at every point, shape [N]: a third of the triangles around a vertex, or that of a cell."""
        if self.vertices is None or self.grid.faces is None:
            return self.grid.areas
        shares = np.repeat(triangle_areas(self.vertices, self.grid.faces) / 3.0, 3)
        count = len(self.vertices)
        return np.bincount(self.grid.faces.ravel(), weights=shares, minlength=count).astype(np.float64)


PointsLike: TypeAlias = SpherePoints | SphereGrid | MapResult | str | os.PathLike[str] | MeshLike
"""One end of a resampling in any of the forms that :func:`as_points` takes."""


def as_points(given: PointsLike, name: str = "the sphere") -> SpherePoints:
    """Convert one end of a resampling from any accepted form.

    Args:
        given: a :class:`~omtwarp.MapResult`; the name of a grid (see :mod:`omtwarp.spheres`); a file: a map in
            ``.npz``, a ``.ply`` with the sphere as px, py and pz at the vertices, or a mesh that is a sphere about
            the origin, of any radius; ``(points, faces)``; anything with ``vertices`` and ``faces``; or a grid.
        name: how messages call it.

    Raises:
        OmtwarpError: the argument has none of these forms, or is not a sphere.
    """
    if isinstance(given, SpherePoints):
        return given
    if isinstance(given, SphereGrid):
        return SpherePoints(given)
    if isinstance(given, MapResult):
        return SpherePoints(mesh_grid(given.sphere, given.faces, name), given.vertices)
    if isinstance(given, str) and is_named(given):
        return SpherePoints(named_grid(given))
    if isinstance(given, str | os.PathLike):
        path = Path(given)
        if path.suffix.lower() == ".npz" and holds_array(path, *OF_MAPS):
            return as_points(MapResult.load(path), str(path))
        mesh = read_mesh(path)
        beside = _sphere_beside(path)
        if beside is not None:
            return SpherePoints(mesh_grid(beside, mesh.faces, str(path)), mesh.vertices)
        return SpherePoints(mesh_grid(mesh.vertices, mesh.faces, str(path)))
    if isinstance(given, tuple | list) and len(given) == 2:
        return SpherePoints(mesh_grid(given[0], given[1], name))
    if hasattr(given, "vertices") and hasattr(given, "faces"):
        return SpherePoints(mesh_grid(given.vertices, given.faces, name))
    raise OmtwarpError(f"{name}: expected a map, a sphere, a file or a grid's name, got {type(given).__name__}")


def file_points(given: str | os.PathLike[str], surface: Path | None) -> SpherePoints:
    """Read one end of a resampling from a grid's name or a file; return it and the file of the sphere's surface.

    Args:
        given: see :func:`as_points`.
        surface: the mesh whose sphere it is, with the same faces; None for a map, which has it.

    Raises:
        OmtwarpError: what :func:`as_points` raises, or a surface with other faces.
    """
    points = as_points(given, str(given))
    if surface is None:
        return points
    if points.vertices is not None:
        raise OmtwarpError(f"{given}: a map has its own surface: leave '{surface}' out")
    mesh = read_mesh(surface)
    if not np.array_equal(mesh.faces, points.grid.triangles):
        raise OmtwarpError(f"'{surface}' and '{given}' have different faces: they are not one surface and its sphere")
    return SpherePoints(points.grid, mesh.vertices)


def _sphere_beside(path: Path) -> Floats | None:
    """Return the sphere that a .ply holds with its surface as px, py and pz, shape [V, 3]."""
    if path.suffix.lower() != ".ply" or b" px\n" not in read_bytes(path, LARGEST_MESH_FILE, "mesh file")[:4096]:
        return None
    data = read_data(path)
    return np.stack([data.values[:, data.names.index(name)] for name in ("px", "py", "pz")], axis=1)


@dataclass(frozen=True, eq=False)
class Resampling:
    """A linear map of data at the points of one sphere to those of another.

    Attributes:
        matrix: sparse float64, shape [T, S]; rows sum to 1.
        method: how its weights were chosen.
        source, target: the two ends.
    """

    matrix: sparse.csr_matrix
    method: Interpolation
    source: SpherePoints
    target: SpherePoints

    def __repr__(self) -> str:
        return f"Resampling({self.source.grid.name} -> {self.target.grid.name}, {self.method})"

    def apply(self, values: ArrayLike) -> Floats:
        """Resample numbers at the source points.

        Args:
            values: finite numbers, shape [S] or [S, K].

        Returns:
            float64, shape [T] or [T, K].

        Raises:
            OmtwarpError: the values have another length, or are not finite.
        """
        given = values.astype(np.float64) if _of_truth(values) else values
        array = real_numbers(given, "the data", None, finite=False)
        self._require_length(array)
        if not np.isfinite(array).all():
            bad = ~np.isfinite(array).reshape(len(array), -1).all(axis=1)
            raise OmtwarpError(
                f"the data are not finite at {int(bad.sum())} of {len(array)} points, first point "
                f"{int(np.argmax(bad))}; put a number there, or resample a mask beside them"
            )
        return np.asarray(self.matrix @ array)

    def labels(self, keys: ArrayLike) -> NDArray[np.int64]:
        """Resample labels: each target point takes the label with the largest sum of weights.

        With conservative weights that is the label of largest overlap with its cell. Of equals, the smallest key wins.

        Args:
            keys: whole numbers, shape [S].

        Returns:
            int64, shape [T].

        Raises:
            OmtwarpError: another length, or numbers that are not whole.
        """
        array = whole_numbers(keys.astype(np.int64) if _of_truth(keys) else keys, "the labels", (None,))
        self._require_length(array)
        names, index = np.unique(array, return_inverse=True)
        members = sparse.csr_matrix(
            (np.ones(len(array)), (np.arange(len(array)), index)), shape=(len(array), len(names))
        )
        votes = sparse.csr_matrix(self.matrix @ members)
        votes.sort_indices()
        rows = np.repeat(np.arange(votes.shape[0]), np.diff(votes.indptr))
        order = np.lexsort((votes.indices, -votes.data, rows))
        first = order[np.searchsorted(rows[order], np.arange(votes.shape[0]))]
        return np.asarray(names[votes.indices[first]])

    def surface(self) -> Floats:
        """Resample the source's surface to the target's points, float64, shape [T, 3].

        With the target's faces it is the same surface on another mesh, which is common to all subjects.

        Raises:
            OmtwarpError: the source is a sphere alone.
        """
        if self.source.vertices is None:
            raise OmtwarpError("the source is a sphere without its surface: there is nothing to resample but data")
        return self.apply(self.source.vertices)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the matrix as ``.npz``, to be read with :func:`scipy.sparse.load_npz`.

        Raises:
            OmtwarpError: the file cannot be written.
        """
        with staged(as_path(path)) as file, open(file, "wb") as stream:
            sparse.save_npz(stream, self.matrix)

    def _require_length(self, array: NDArray[np.generic]) -> None:
        count = self.matrix.shape[1]
        if array.ndim == 0 or len(array) != count:
            length = "one number" if array.ndim == 0 else str(len(array))
            raise OmtwarpError(f"the data have {length} where {self.source.grid.name} has {count} points")


def resample(
    source: PointsLike,
    target: PointsLike,
    *,
    method: str = Interpolation.BARYCENTRIC,
    source_areas: ArrayLike | None = None,
    target_areas: ArrayLike | None = None,
    device: str | None = "auto",
) -> Resampling:
    """Prepare the resampling of data from one map or sphere to another.

    The spheres are not rotated: align them first (:func:`omtwarp.align`).

    Args:
        source: a map, a sphere, a file or the name of a grid (:func:`as_points`).
        target: the same.
        method: ``barycentric`` (linear in the nearest triangle, as Connectome Workbench has it), ``nearest``,
            ``adaptive`` (barycentric weights corrected for areas: Workbench's ADAP_BARY_AREA) or ``conservative``
            (exact areas of overlap of the cells: integrals, bounds and signs are kept).
        source_areas: for ``adaptive``, area of the surface around every source point, shape [S]; the areas of the
            source's surface by default, or of its sphere where it has none.
        target_areas: the same at the target, shape [T]; by default those of the source's surface, resampled with
            barycentric weights, where the source has one, and of the target's sphere otherwise.
        device: ``auto``, ``cpu`` or ``cuda:N``.

    Returns:
        The resampling from the source to the target.

    Raises:
        OmtwarpError: an unknown method or grid, a file that cannot be read, or something that is not a sphere.

    Example:
        >>> import numpy as np
        >>> from omtwarp import resample
        >>> to_pixels = resample("ico4", "equiangular:32x64", method="conservative", device="cpu")
        >>> to_pixels.apply(np.ones(2562)).reshape(32, 64).round(12).max()
        np.float64(1.0)
    """
    chosen = choose(Interpolation, method)
    here, there = as_points(source, "the source"), as_points(target, "the target")
    if chosen is Interpolation.NEAREST:
        matrix = weights.nearest(here.grid, there.grid)
    elif chosen is Interpolation.CONSERVATIVE:
        matrix = weights.conservative(here.grid, there.grid, device)
    elif chosen is Interpolation.BARYCENTRIC:
        matrix = weights.barycentric(here.grid, there.grid, device)
    else:
        given = here.surface_areas() if source_areas is None else _areas(source_areas, here, "source")
        if target_areas is not None:
            wanted = _areas(target_areas, there, "target")
        elif here.vertices is not None and there.grid.faces is not None:
            moved = weights.barycentric(here.grid, there.grid, device) @ here.vertices
            wanted = SpherePoints(there.grid, np.asarray(moved)).surface_areas()
        else:
            wanted = there.grid.areas if here.vertices is None else there.surface_areas()
        matrix = weights.adaptive(here.grid, there.grid, given, wanted, device)
    return Resampling(matrix, chosen, here, there)


def _of_truth(values: object) -> TypeGuard[NDArray[np.bool_]]:
    """Return whether data are an array of booleans, such as a mask of a region."""
    return isinstance(values, np.ndarray) and values.dtype.kind == "b"


def _areas(given: ArrayLike, points: SpherePoints, name: str) -> Floats:
    areas = real_numbers(given, f"the areas of the {name}", (len(points.grid.points),))
    if areas.min(initial=0.0) < 0.0:
        raise OmtwarpError(f"the areas of the {name} must be at least 0, not {areas.min():g}")
    return areas


__all__ = ["Resampling", "SpherePoints", "as_points", "file_points", "resample"]
