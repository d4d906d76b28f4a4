"""Resampling from one map or sphere to another: areas of overlap, the matrix, its two ends, and its application."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeAlias, TypeGuard

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import sparse
from scipy.spatial import cKDTree

from omtwarp.device.policy import resolve_device
from omtwarp.device.start import wp
from omtwarp.device.threads import Each, each, launch_parts
from omtwarp.errors import OmtwarpError, choose, naming
from omtwarp.files.inputs import read_bytes
from omtwarp.files.limits import LARGEST_MESH_FILE
from omtwarp.files.output import as_path, staged
from omtwarp.location import Locator, boxes_around, combined
from omtwarp.maps.result import MapResult, is_map_file
from omtwarp.mesh.arrays import Floats, Ints, in_range, real_numbers, whole_numbers
from omtwarp.mesh.data import read_data
from omtwarp.mesh.origins import Origins
from omtwarp.mesh.read import read_mesh
from omtwarp.mesh.surface import MeshLike, sums_around, triangle_areas
from omtwarp.options import Interpolation, InterpolationLike
from omtwarp.resampling.averages import average_sphere, is_average
from omtwarp.resampling.overlap_kernels import list_overlaps
from omtwarp.spheres import SphereGrid, is_named, mesh_grid, named_grid


def overlap_areas(target: SphereGrid, source: SphereGrid, *, device: str | None = "auto") -> sparse.csr_matrix:
    """Return the areas on the unit sphere that cells of target points share with cells of source points.

    Polygons are cut by great circles in float64, so that every area is exact up to round-off. Rows sum to the target's
    areas and columns to the source's.

    Args:
        target, source: grids.
        device: ``auto``, ``cpu`` or ``cuda:N``.

    Returns:
        Sparse float64 matrix, shape [T, S].

    Raises:
        OmtwarpError: a triangulated grid with triangles turned over.
    """
    where = resolve_device(device)
    (target_corners, target_owners), (source_corners, source_owners) = target.cells, source.cells
    targets, lower, upper = boxes_around(target_corners, where)
    sources, *source_boxes = boxes_around(source_corners, where)
    boxes = wp.Bvh(*source_boxes)
    # Where cells only touch, round-off makes overlaps of some 1e-16 of a cell; the overlaps dropped stay below 1e-13.
    smallest = wp.float64(1e-14 * 4.0 * np.pi / max(len(target_corners), len(source_corners)))
    counts = wp.empty(len(target_corners), dtype=wp.int32, device=where)
    offsets = np.zeros(len(target_corners) + 1, dtype=np.int64)
    for _ in range(2):  # overlaps are counted first, and listed when there is room for them
        first = wp.array(offsets[:-1].astype(np.int32), device=where)
        partners = wp.empty(int(offsets[-1]), dtype=wp.int32, device=where)
        areas = wp.empty(int(offsets[-1]), dtype=wp.float64, device=where)
        inputs = [*each(lower, upper, targets, first), boxes.id, sources, smallest]
        launch_parts(list_overlaps, len(target_corners), inputs, [Each(counts), partners, areas], where)
        np.cumsum(counts.numpy(), out=offsets[1:])
    shape = (len(target_corners), len(source_corners))
    between = sparse.csr_matrix((areas.numpy(), partners.numpy(), offsets), shape=shape)
    between.sort_indices()  # the search goes through boxes in an order of its own
    return _owners(target_owners, len(target.points)).T @ between @ _owners(source_owners, len(source.points))


def _owners(owners: Ints, count: int) -> sparse.csr_matrix:
    """Return the 0/1 matrix, shape [M, N], that assigns each of M cells to its point."""
    return combined(owners[:, None], np.ones((len(owners), 1)), count)


def barycentric(source: SphereGrid, target: SphereGrid, device: str | None = "auto") -> sparse.csr_matrix:
    """Return the matrix of linear interpolation in the flat triangle nearest to each target point, shape [T, S].

    The weights are those of Connectome Workbench's BARYCENTRIC. Constants are kept, integrals are not. Rows of points
    in what fills holes of the source are empty.
    """
    # Barycentric coordinate up to which a point is on a side of a triangle: single precision puts vertices of the rim
    # of a filled hole so far into its filling.
    rim = 1e-6
    faces = source.triangles
    nearest = Locator(source.points, faces, device=device).find_closest(target.points)
    matrix = nearest.matrix(faces, len(source.points))
    if source.own is None:
        return matrix
    of_surface = np.where(faces[nearest.faces] < source.own[0], nearest.coordinates, 0.0).sum(axis=1)
    on_rim = (nearest.coordinates.min(axis=1) < rim) & (of_surface > 1.0 - rim)
    return _without_rows(matrix, (nearest.faces >= source.own[1]) & ~on_rim)


def nearest(source: SphereGrid, target: SphereGrid, device: str | None = "auto") -> sparse.csr_matrix:
    """Return the matrix that takes the value of the source point nearest to each target point, shape [T, S].

    Rows of points in what fills holes of the source are empty.
    """
    _, chosen = cKDTree(source.points[: source.own_points]).query(target.points)
    matrix = combined(chosen[:, None], np.ones((len(chosen), 1)), len(source.points))
    return matrix if source.own is None else _without_rows(matrix, _empty(barycentric(source, target, device)))


def adaptive(
    source: SphereGrid, target: SphereGrid, source_areas: Floats, target_areas: Floats, device: str | None = "auto"
) -> sparse.csr_matrix:
    """Return barycentric weights in which every source point takes part, corrected for areas, shape [T, S].

    Connectome Workbench's ADAP_BARY_AREA: each target point takes its own barycentric weights, or those of the source
    points that lie in the triangles around it where these are more. Weights are then scaled so that each source point
    distributes its area, and rows are normalised to sum 1.

    Args:
        source, target: grids.
        source_areas, target_areas: area of the surface around every point, shapes [S] and [T].
        device: ``auto``, ``cpu`` or ``cuda:N``.
    """
    forward = barycentric(source, target, device)
    backward = barycentric(target, source, device).T.tocsr()
    # Where the forward weights include every source point that refers to the target point, they include more.
    looked_at, looking = forward.sign(), backward.sign()
    missed = (looking - looking.multiply(looked_at)).tocsr()
    use_backward = np.asarray(missed.sum(axis=1)).ravel() > 0
    chosen = _without_rows(forward, use_backward) + _without_rows(backward, ~use_backward)
    by_area = sparse.diags_array(target_areas) @ chosen
    given = np.asarray(by_area.sum(axis=0)).ravel()
    scale = np.divide(source_areas, given, out=np.zeros_like(given), where=given > 0)
    corrected = sparse.csr_matrix(by_area @ sparse.diags_array(scale))
    return _rows_to_one(corrected if source.own is None else _without_rows(corrected, _empty(forward)))


def conservative(source: SphereGrid, target: SphereGrid, device: str | None = "auto") -> sparse.csr_matrix:
    """Return the matrix of means over each target cell of the function that is constant on source cells, [T, S].

    Overlaps are exact (:func:`omtwarp.resampling.resample.overlap_areas`), so that integrals with respect to the cells'
    areas are kept up to round-off, as are constants, bounds and signs. What fills holes has no cells: means are over
    the rest, and rows are empty where nothing is left.
    """
    return _rows_to_one(overlap_areas(target, source, device=device))


def _empty(matrix: sparse.csr_matrix) -> NDArray[np.bool_]:
    """Return which rows hold nothing, shape [T]."""
    return np.diff(matrix.indptr) == 0


def _without_rows(matrix: sparse.csr_matrix, left_out: NDArray[np.bool_]) -> sparse.csr_matrix:
    """Return the matrix with some rows emptied; none is stored there.

    Args:
        matrix: shape [T, S].
        left_out: which rows, shape [T].
    """
    kept = sparse.csr_matrix(sparse.diags_array((~left_out).astype(float)) @ matrix)
    kept.eliminate_zeros()
    return kept


def _rows_to_one(matrix: sparse.csr_matrix) -> sparse.csr_matrix:
    sums = np.asarray(matrix.sum(axis=1)).ravel()
    return sparse.csr_matrix(sparse.diags_array(1.0 / np.where(sums > 0, sums, 1.0)) @ matrix)


@dataclass(frozen=True, eq=False)
class SpherePoints:
    """One end of a resampling: points on the sphere, and the surface they were mapped from where there is one.

    Attributes:
        grid: the points, their triangles or pixels.
        vertices: the surface's vertices, float64, shape [N, 3]; None for a sphere alone.
        origins: what the surface's own points are in the input, where they are not its vertices.
    """

    grid: SphereGrid
    vertices: Floats | None = None
    origins: Origins | None = None

    def surface_areas(self) -> Floats:
        """Return the area at every point, shape [N]: a third of the triangles around a vertex, or that of a cell.

        What fills holes has none.
        """
        if self.vertices is None or self.grid.faces is None:
            return self.grid.areas
        faces = self.grid.own_triangles
        return sums_around(triangle_areas(in_range(self.vertices), faces) / 3.0, faces, len(self.vertices))

    def closed(self) -> SpherePoints:
        """Return the same points, those that fill holes counted as the surface's."""
        return replace(self, grid=replace(self.grid, own=None))

    def moved(self, sphere: Floats) -> SpherePoints:
        """Return the same surface with other points on the sphere, unit vectors, shape [N, 3]."""
        return replace(self, grid=replace(self.grid, points=sphere))

    def at_own_points(self, values: NDArray[np.generic]) -> NDArray[np.generic]:
        """Return data at the surface's own points: as given, or carried there from the vertices of the input."""
        own = self.origins is None or (values.ndim > 0 and len(values) == self.grid.own_points)
        return values if own or self.origins is None else self.origins.prolong(values)


PointsLike: TypeAlias = SpherePoints | SphereGrid | MapResult | str | os.PathLike[str] | MeshLike
"""One end of a resampling in any of the forms that :func:`as_points` takes."""


def as_points(given: PointsLike, name: str = "the sphere") -> SpherePoints:
    """Convert one end of a resampling from any accepted form.

    Args:
        given: a :class:`~omtwarp.MapResult`, with what fills its holes; the name of a grid (see
            :mod:`omtwarp.spheres`) or of an average with its hemisphere, such as ``fsLR32k-left``; a file: a map in
            ``.npz``, a ``.ply`` with the sphere as px, py and pz at the vertices, or a mesh that is a sphere about the
            origin, of any radius; ``(points, faces)``; anything with ``vertices`` and ``faces``; or a grid.
        name: how messages call it.

    Raises:
        OmtwarpError: the argument has none of these forms, or is not a sphere.
    """
    if isinstance(given, SpherePoints):
        return given
    if isinstance(given, SphereGrid):
        return SpherePoints(given)
    if isinstance(given, MapResult):
        return _points_of_map(given, name)
    if isinstance(given, str) and is_average(given):
        return SpherePoints(average_sphere(given))
    if isinstance(given, str) and is_named(given):
        return SpherePoints(named_grid(given))
    if isinstance(given, str | os.PathLike):
        path = Path(given)
        if is_map_file(path):
            return as_points(MapResult.load(path), str(path))
        mesh = read_mesh(path)
        beside = _sphere_beside(path)
        sphere, surface = (mesh.vertices, None) if beside is None else (beside, mesh.vertices)
        return SpherePoints(mesh_grid(sphere, mesh.faces, str(path)), surface)
    if isinstance(given, tuple | list) and len(given) == 2:
        return SpherePoints(mesh_grid(given[0], given[1], name))
    if hasattr(given, "vertices") and hasattr(given, "faces"):
        return SpherePoints(mesh_grid(given.vertices, given.faces, name))
    raise OmtwarpError(f"{name}: expected a map, a sphere, a file or a grid's name, got {type(given).__name__}")


def _points_of_map(result: MapResult, name: str) -> SpherePoints:
    """Return the points of a map, with what fills holes, which is marked."""
    with naming(name):
        closed = result.closed()
    if closed is result:
        return SpherePoints(mesh_grid(result.sphere, result.faces, name), result.vertices, result.origins)
    own = len(result.vertices), len(result.faces)
    return SpherePoints(mesh_grid(closed.sphere, closed.faces, name, own), closed.vertices, result.origins)


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
    if not {"px", "py", "pz"} <= set(data.names):
        return None
    return np.stack([data.values[:, data.names.index(name)] for name in ("px", "py", "pz")], axis=1)


@dataclass(frozen=True, eq=False)
class Resampling:
    """A linear map of data at the points of one sphere to those of another.

    Attributes:
        matrix: sparse float64, shape [T, S]; rows sum to 1, or are empty where the source has a filled hole.
        method: how its weights were chosen.
        source, target: the two ends.
        device: where the matrix was computed.
    """

    matrix: sparse.csr_matrix
    method: Interpolation
    source: SpherePoints
    target: SpherePoints
    device: str | None = "auto"

    def __repr__(self) -> str:
        return f"Resampling({self.source.grid.name} -> {self.target.grid.name}, {self.method})"

    @property
    def empty(self) -> NDArray[np.bool_]:
        """Which target points lie in what fills the source's holes, and get no data, shape [T]."""
        return np.diff(self.matrix.indptr) == 0

    def apply(self, values: ArrayLike) -> Floats:
        """Resample numbers at the source points. Target points in filled holes of the source get 0.

        A source point without a number, NaN, as in the medial wall, counts for nothing: a target point has the mean of
        the others by their weights, or NaN where these are less than half.

        Args:
            values: finite numbers or NaN, shape [S] or [S, K].

        Returns:
            float64, shape [T] or [T, K].

        Raises:
            OmtwarpError: the values have another length, or are infinite.
        """
        given = values.astype(np.float64) if _of_truth(values) else values
        array = self.source.at_own_points(real_numbers(given, "the data", None, finite=False))
        if array.ndim > 2:
            raise OmtwarpError(f"data of shape {list(array.shape)}: a number or one row per point, [S] or [S, K]")
        self._require_length(array)
        without = np.isnan(array)
        infinite = np.isinf(array).reshape(len(array), -1).any(axis=1)
        if infinite.any():
            raise OmtwarpError(
                f"the data are infinite at {int(infinite.sum())} of {len(array)} points, first point "
                f"{int(np.argmax(infinite))}; put a number there, or NaN where there is none"
            )
        if not without.any():
            return np.asarray(self.matrix @ array)
        known = np.asarray(self.matrix @ (~without).astype(np.float64))
        sums = np.asarray(self.matrix @ np.where(without, 0.0, array))
        empty = self.empty.reshape(-1, *[1] * (array.ndim - 1))
        # A point has a number where its weights in the source, of sum 1, have for the most part.
        return np.where(known >= 0.5, sums / np.where(known >= 0.5, known, 1.0), np.where(empty, 0.0, np.nan))

    def labels(self, keys: ArrayLike) -> NDArray[np.int64]:
        """Resample labels: each target point takes the label with the largest sum of weights.

        With conservative weights that is the label of largest overlap with its cell. Of equals, the smallest key wins.
        Target points in filled holes of the source get 0, which files of labels have for what has none.

        Args:
            keys: whole numbers, shape [S]; what is NaN, as at a medial wall, has none: it counts as 0.

        Returns:
            int64, shape [T].

        Raises:
            OmtwarpError: another length, or numbers that are not whole.
        """
        known = keys.astype(np.int64) if _of_truth(keys) else keys
        array = self.source.at_own_points(whole_numbers(known, "the labels", (None,), nan=True))
        self._require_length(array)
        names, index = np.unique(array, return_inverse=True)
        entries = np.ones(len(array)), index, np.arange(len(array) + 1)  # one in every row
        votes = sparse.csr_matrix(self.matrix @ sparse.csr_matrix(entries, (len(array), len(names))))
        return np.where(self.empty, 0, names[np.asarray(votes.argmax(axis=1)).ravel()])

    def surface(self) -> Floats:
        """Resample the source's surface to the target's points, float64, shape [T, 3].

        With the target's faces it is the same surface on another mesh, which is common to all subjects. Holes of the
        source stay filled.

        Raises:
            OmtwarpError: the source is a sphere alone.
        """
        if self.source.vertices is None:
            raise OmtwarpError("the source is a sphere without its surface: there is nothing to resample but data")
        if self.source.grid.own is None:
            return self.apply(self.source.vertices)
        return resample(self.source.closed(), self.target, method=self.method, device=self.device).surface()

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
    method: InterpolationLike = Interpolation.BARYCENTRIC,
    source_areas: ArrayLike | None = None,
    target_areas: ArrayLike | None = None,
    device: str | None = "auto",
) -> Resampling:
    """Prepare the resampling of data from one map or sphere to another.

    The spheres are not rotated: align them first (:func:`omtwarp.align`).

    Of a surface whose holes were filled (:func:`omtwarp.map_surface`), data are at its own vertices: nothing is
    resampled from the filling, and :attr:`Resampling.empty` says which target points lie there. The surface itself is
    resampled with it.

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
    if chosen is not Interpolation.ADAPTIVE:
        others = {Interpolation.NEAREST: nearest, Interpolation.CONSERVATIVE: conservative}
        matrix = others.get(chosen, barycentric)(here.grid, there.grid, device)
    else:
        # Source points in a filled hole of the target give their area to what is there, not to the hole's rim.
        given = here.surface_areas() if source_areas is None else _areas(source_areas, here, "source")
        whole = there.closed()
        if target_areas is not None:
            wanted = _areas(target_areas, there, "target")
            wanted[there.grid.own_points :] = whole.surface_areas()[there.grid.own_points :]
        elif here.vertices is not None and there.grid.faces is not None:
            moved = barycentric(here.closed().grid, whole.grid, device) @ here.vertices
            wanted = SpherePoints(whole.grid, np.asarray(moved)).surface_areas()
        else:
            wanted = whole.grid.areas if here.vertices is None else whole.surface_areas()
        matrix = adaptive(here.grid, whole.grid, given, wanted, device)
    if here.grid.own is not None or there.grid.own is not None:
        matrix = sparse.csr_matrix(matrix[: there.grid.own_points, : here.grid.own_points])
    return Resampling(matrix, chosen, here, there, device)


def _of_truth(values: object) -> TypeGuard[NDArray[np.bool_]]:
    """Return whether data are an array of booleans, such as a mask of a region."""
    return isinstance(values, np.ndarray) and values.dtype.kind == "b"


def _areas(given: ArrayLike, points: SpherePoints, name: str) -> Floats:
    count = points.grid.own_points
    areas = real_numbers(given, f"the areas of the {name}", (count,))
    if areas.min(initial=0.0) < 0.0:
        raise OmtwarpError(f"the areas of the {name} must be at least 0, not {areas.min():g}")
    return np.concatenate([areas, np.zeros(len(points.grid.points) - count)])
