"""Sparse matrices that resample data from the points of one sphere to those of another."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.spatial import cKDTree

from omtwarp.location import Locator
from omtwarp.resampling.overlap import overlap_areas
from omtwarp.spheres import SphereGrid

Floats = NDArray[np.float64]


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
    count = len(target.points)
    matrix = sparse.csr_matrix((np.ones(count), chosen, np.arange(count + 1)), shape=(count, len(source.points)))
    return matrix if source.own is None else _without_rows(matrix, _empty(barycentric(source, target, device)))


def adaptive(
    source: SphereGrid,
    target: SphereGrid,
    source_areas: Floats,
    target_areas: Floats,
    device: str | None = "auto",
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
    looked_at = forward.copy()
    looked_at.data[:] = 1.0
    looking = backward.copy()
    looking.data[:] = 1.0
    missed = (looking - looking.multiply(looked_at)).tocsr()
    use_backward = np.asarray(missed.sum(axis=1)).ravel() > 0
    chosen = sparse.diags_array((~use_backward).astype(float)) @ forward
    chosen = sparse.csr_matrix(chosen + sparse.diags_array(use_backward.astype(float)) @ backward)
    chosen.eliminate_zeros()
    by_area = sparse.diags_array(target_areas) @ chosen
    given = np.asarray(by_area.sum(axis=0)).ravel()
    scale = np.divide(source_areas, given, out=np.zeros_like(given), where=given > 0)
    corrected = sparse.csr_matrix(by_area @ sparse.diags_array(scale))
    if source.own is not None:
        corrected = _without_rows(corrected, _empty(forward))
    return _rows_to_one(corrected)


def conservative(source: SphereGrid, target: SphereGrid, device: str | None = "auto") -> sparse.csr_matrix:
    """Return the matrix of means over each target cell of the function that is constant on source cells, [T, S].

    Overlaps are exact (:func:`omtwarp.resampling.overlap.overlap_areas`), so that integrals with respect to the cells'
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
