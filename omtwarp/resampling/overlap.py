"""The matrix of the areas in which the cells of two grids on the sphere overlap."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from omtwarp.device.policy import resolve_device
from omtwarp.device.start import wp
from omtwarp.device.threads import Arguments, launch_parts
from omtwarp.resampling.overlap_kernels import box_polygons, count_overlaps, list_overlaps
from omtwarp.spheres import SphereGrid


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

    def send(corners: NDArray[np.float64]) -> tuple[wp.array, wp.array, wp.array]:
        polygons = wp.array(np.ascontiguousarray(corners), dtype=wp.vec3d, device=where)
        lower, upper = (wp.empty(len(corners), dtype=wp.vec3, device=where) for _ in range(2))
        wp.launch(box_polygons, dim=len(corners), inputs=[polygons], outputs=[lower, upper], device=where)
        return polygons, lower, upper

    targets, lower, upper = send(target_corners)
    sources, *source_boxes = send(source_corners)
    boxes = wp.Bvh(*source_boxes)
    # Where cells only touch, round-off makes overlaps of some 1e-16 of a cell; the overlaps dropped stay below 1e-13.
    smallest = wp.float64(1e-14 * 4.0 * np.pi / max(len(target_corners), len(source_corners)))
    counts = wp.empty(len(target_corners), dtype=wp.int32, device=where)

    def counting(part: slice) -> Arguments:
        return [lower[part], upper[part], targets[part], boxes.id, sources, smallest], [counts[part]]

    launch_parts(count_overlaps, len(target_corners), counting, where)
    offsets = np.concatenate([[0], np.cumsum(counts.numpy(), dtype=np.int64)])
    first = wp.array(offsets[:-1].astype(np.int32), device=where)
    partners = wp.empty(int(offsets[-1]), dtype=wp.int32, device=where)
    areas = wp.empty(int(offsets[-1]), dtype=wp.float64, device=where)

    def listing(part: slice) -> Arguments:
        own = [lower[part], upper[part], targets[part], first[part]]
        return [*own, boxes.id, sources, smallest], [partners, areas]

    launch_parts(list_overlaps, len(target_corners), listing, where)
    shape = (len(target_corners), len(source_corners))
    between = sparse.csr_matrix((areas.numpy(), partners.numpy(), offsets), shape=shape)
    between.sort_indices()  # the search goes through boxes in an order of its own
    return _owners(target_owners, len(target.points)).T @ between @ _owners(source_owners, len(source.points))


def _owners(owners: NDArray[np.int32], count: int) -> sparse.csr_matrix:
    """Return the 0/1 matrix, shape [M, N], that assigns each of M cells to its point."""
    cells = len(owners)
    return sparse.csr_matrix((np.ones(cells), owners, np.arange(cells + 1)), shape=(cells, count))
