"""Compare maps to the unit disk: this package's, and others written here after their papers.

    python examples/compare_disks.py bust.ply --heights 1/2     # what is above a plane, see cut_by_planes.py
    python examples/compare_disks.py                            # a made shape

tutte: every vertex at the mean of its neighbours, the boundary spaced by arc length (W. T. Tutte, 1963).
harmonic: the same with cotangent weights (U. Pinkall and K. Polthier, 1993).
stretch: stretch energy minimisation by fixed-point iteration (M.-H. Yueh, W.-W. Lin, C.-T. Wu and S.-T. Yau, "A novel
stretch energy minimization algorithm for equiareal parameterizations", Journal of Scientific Computing 78, 2019), from
the harmonic map: at most 100 steps, the one with the least energy kept.
authalic: authalic energy minimisation by preconditioned nonlinear conjugate gradients (S.-Y. Liu and M.-H. Yueh,
"Convergent authalic energy minimization for disk area-preserving parameterizations", Journal of Scientific Computing
100, 2024), with the boundary's angles as unknowns, from five steps of the fixed-point iteration: at most 200 steps.
omtwarp: map_surface(domain="disk"); refined: the same with refine="area".

Area and angle distortion are means of r + 1/r over the surface's area, of the flat triangles: r is the ratio of areas,
both totals scaled to one, and the ratio of the two singular values.
"""

from __future__ import annotations

import argparse
import sys
import time
import warnings
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path

import numpy as np
from cut_by_planes import above
from scipy import sparse
from scipy.sparse.linalg import splu

import omtwarp
from omtwarp.open_surfaces.held import flipped_in_plane
from omtwarp.topology.kind import boundary_loops

STEPS, ENOUGH = 100, 1e-6
FIRST_STEPS, DESCENT_STEPS = 5, 200
SUFFICIENT, HALVINGS, LEAST_GAIN = 1e-4, 30, 1e-12  # of a step along a direction of descent

Energy = Callable[[np.ndarray], tuple[float, np.ndarray]]


def laid_flat(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Edge vectors of every triangle in its own plane as columns, shape [F, 2, 2]."""
    one, other = (points[faces[:, k]] - points[faces[:, 0]] for k in (1, 2))
    length = np.linalg.norm(one, axis=1)
    foot = (one * other).sum(axis=1) / length
    height = np.sqrt(np.maximum((other**2).sum(axis=1) - foot**2, 0.0))
    zero = np.zeros_like(length)
    return np.stack([np.stack([length, foot], 1), np.stack([zero, height], 1)], axis=1)


def judged(vertices: np.ndarray, faces: np.ndarray, disk: np.ndarray) -> tuple[int, float, float]:
    """Flips, and area and angle distortion of a map to the plane."""
    before, after = laid_flat(vertices, faces), np.swapaxes(disk[faces[:, 1:]] - disk[faces[:, :1]], 1, 2)
    areas, images = np.abs(np.linalg.det(before)), np.abs(np.linalg.det(after))
    ratio = images / images.sum() / (areas / areas.sum())
    large, small = np.linalg.svd(after @ np.linalg.inv(before), compute_uv=False).T
    share = areas / areas.sum()
    with np.errstate(divide="ignore", over="ignore"):
        area, angle = ((share * (r + 1.0 / r)).sum() for r in (ratio, large / small))
    return int(flipped_in_plane(disk, faces).sum()), float(area), float(angle)


def laplacian(points: np.ndarray, faces: np.ndarray, scale: np.ndarray | None = None) -> sparse.csr_array:
    """The cotangent Laplacian of a map, each triangle's part times a number, shape [V, V]."""
    count = len(points)
    weights, rows, columns = [], [], []
    for k in range(3):
        i, j = faces[:, (k + 1) % 3], faces[:, (k + 2) % 3]
        one, other = points[i] - points[faces[:, k]], points[j] - points[faces[:, k]]
        doubled = np.sqrt(np.maximum((one**2).sum(1) * (other**2).sum(1) - (one * other).sum(1) ** 2, 1e-300))
        weight = 0.5 * (one * other).sum(axis=1) / doubled * (1.0 if scale is None else scale)
        weights, rows, columns = [*weights, weight, weight], [*rows, i, j], [*columns, j, i]
    entries = (np.concatenate(weights), (np.concatenate(rows), np.concatenate(columns)))
    matrix = sparse.coo_array(entries, shape=(count, count)).tocsr()
    return (sparse.diags_array(np.asarray(matrix.sum(axis=1)).ravel()) - matrix).tocsr()


def on_circle(vertices: np.ndarray, loop: np.ndarray) -> np.ndarray:
    """Places of the boundary's vertices on the unit circle, spaced by arc length, as complex numbers."""
    steps = np.linalg.norm(vertices[np.roll(loop, -1)] - vertices[loop], axis=1)
    return np.exp(2j * np.pi * np.concatenate([[0.0], np.cumsum(steps)[:-1]]) / steps.sum())


def solved(matrix: sparse.csr_array, held: np.ndarray, places: np.ndarray) -> np.ndarray:
    """The map with some vertices held in which all others satisfy the Laplacian's equation, as complex numbers."""
    free = np.setdiff1d(np.arange(matrix.shape[0]), held)
    right = -(matrix[free][:, held] @ places)
    factor = splu(matrix[free][:, free].tocsc())
    out = np.zeros(matrix.shape[0], dtype=complex)
    out[held], out[free] = places, factor.solve(right.real) + 1j * factor.solve(right.imag)
    return out


def tutte(vertices: np.ndarray, faces: np.ndarray, loop: np.ndarray) -> np.ndarray:
    i, j = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    count = len(vertices)
    beside = sparse.coo_array((np.ones(2 * len(i)), (np.r_[i, j], np.r_[j, i])), shape=(count, count)).tocsr()
    beside.data[:] = 1.0
    matrix = (sparse.diags_array(np.asarray(beside.sum(axis=1)).ravel()) - beside).tocsr()
    return plane(solved(matrix, loop, on_circle(vertices, loop)))


def harmonic(vertices: np.ndarray, faces: np.ndarray, loop: np.ndarray) -> np.ndarray:
    return plane(solved(laplacian(vertices, faces), loop, on_circle(vertices, loop)))


def shares(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Areas of the triangles, pi in all."""
    areas = 0.5 * np.abs(np.linalg.det(laid_flat(vertices, faces)))
    return areas * (np.pi / areas.sum())


def areas_in_plane(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Signed areas of the triangles of a map to the plane."""
    return 0.5 * np.linalg.det(np.swapaxes(points[faces[:, 1:]] - points[faces[:, :1]], 1, 2))


def stretch(vertices: np.ndarray, faces: np.ndarray, loop: np.ndarray, steps: int = STEPS) -> np.ndarray:
    """Fixed points of the stretch Laplacian; the boundary follows through an inversion at the circle."""
    areas = shares(vertices, faces)
    disk = harmonic(vertices, faces, loop)
    inside = np.setdiff1d(np.arange(len(vertices)), loop)
    best, least = disk, np.inf
    for _ in range(steps):
        images = np.abs(areas_in_plane(disk, faces))
        energy = float((images**2 / areas).sum())
        if energy < least:
            gained, best, least = least - energy, disk, energy
            if gained < ENOUGH:
                break
        matrix = laplacian(disk, faces, images / areas)
        inverted = (disk / np.maximum((disk**2).sum(axis=1), 1e-12)[:, None]) @ [1.0, 1.0j]
        right = -(matrix[loop][:, inside] @ inverted[inside])
        factor = splu(matrix[loop][:, loop].tocsc())
        rim = factor.solve(right.real) + 1j * factor.solve(right.imag)
        rim -= rim.mean()
        disk = plane(solved(matrix, loop, rim / np.abs(rim)))
    return best


def authalic_energy(points: np.ndarray, faces: np.ndarray, areas: np.ndarray) -> tuple[float, np.ndarray]:
    """The stretch energy, scaled by the areas in all, less the area of the image, and its derivatives, shape [V, 2]."""
    images = areas_in_plane(points, faces)
    stretched, covered, whole = float((images**2 / areas).sum()), float(images.sum()), float(areas.sum())
    slope = whole / covered * (2.0 * images / areas - stretched / covered) - 1.0
    gradient = np.zeros_like(points)
    for k in range(3):
        opposite = points[faces[:, (k + 2) % 3]] - points[faces[:, (k + 1) % 3]]
        for axis, part in enumerate((-opposite[:, 1], opposite[:, 0])):
            gradient[:, axis] += np.bincount(faces[:, k], 0.5 * slope * part, len(points))
    return whole / covered * stretched - covered, gradient


def authalic(vertices: np.ndarray, faces: np.ndarray, loop: np.ndarray) -> np.ndarray:
    """Conjugate gradients on the authalic energy, of the places inside and the angles of the boundary's vertices."""
    areas, inside = shares(vertices, faces), np.setdiff1d(np.arange(len(vertices)), loop)
    start, split = stretch(vertices, faces, loop, FIRST_STEPS), 2 * len(inside)
    matrix = laplacian(start, faces, np.abs(areas_in_plane(start, faces)) / areas)
    factors = [splu(matrix[part][:, part].tocsc()) for part in (inside, loop)]

    def placed(unknowns: np.ndarray) -> np.ndarray:
        out = np.empty((len(vertices), 2))
        out[inside] = unknowns[:split].reshape(-1, 2)
        out[loop] = np.stack([np.cos(unknowns[split:]), np.sin(unknowns[split:])], axis=1)
        return out

    def energy(unknowns: np.ndarray) -> tuple[float, np.ndarray]:
        points = placed(unknowns)
        value, gradient = authalic_energy(points, faces, areas)
        along = gradient[loop, 1] * points[loop, 0] - gradient[loop, 0] * points[loop, 1]
        return value, np.concatenate([gradient[inside].ravel(), along])

    def preconditioned(gradient: np.ndarray) -> np.ndarray:
        within = factors[0].solve(gradient[:split].reshape(-1, 2))
        return np.concatenate([within.ravel(), factors[1].solve(gradient[split:])])

    angles = np.arctan2(start[loop, 1], start[loop, 0])
    return placed(descended(energy, preconditioned, np.concatenate([start[inside].ravel(), angles])))


def descended(energy: Energy, preconditioned: Callable[[np.ndarray], np.ndarray], now: np.ndarray) -> np.ndarray:
    """Where conjugate gradients (E. Polak and G. Ribière, 1969) end that start from given unknowns."""
    value, gradient = energy(now)
    scaled = preconditioned(gradient)
    direction, step = -scaled, 1.0
    for _ in range(DESCENT_STEPS):
        descent = float(gradient @ direction)
        if descent >= 0.0:
            direction, descent = -scaled, -float(gradient @ scaled)
        for _ in range(HALVINGS):
            reached, there = energy(now + step * direction)
            if reached <= value + SUFFICIENT * step * descent:
                break
            # The least of the parabola through what is known, but neither too short a step nor nearly the same.
            step *= float(np.clip(-0.5 * descent * step / (reached - value - descent * step), 0.1, 0.5))
        else:
            break
        now, gained, value = now + step * direction, value - reached, reached
        scaled_there = preconditioned(there)
        share = max(0.0, float(scaled_there @ (there - gradient)) / float(scaled @ gradient))
        direction, gradient, scaled, step = -scaled_there + share * direction, there, scaled_there, 2.0 * step
        if gained < LEAST_GAIN:
            break
    return now


def plane(places: np.ndarray) -> np.ndarray:
    return np.stack([places.real, places.imag], axis=1)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("meshes", nargs="*", type=Path)
    parser.add_argument("--heights", nargs="+", type=Fraction, default=[Fraction(1, 2)])
    options = parser.parse_args()
    ball = omtwarp.shapes.limbs(sphere=1280)
    files = [(path.stem, omtwarp.read_mesh(path)) for path in options.meshes]
    meshes = [(name, file.vertices, file.faces) for name, file in files] or [("limbs", ball.vertices, ball.faces)]
    print("| mesh, height | triangles | map | flips | area | angle | CPU seconds |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for name, whole, all_faces in meshes:
        for height in options.heights:
            vertices, faces = above(np.asarray(whole), np.asarray(all_faces), float(height))
            loops = boundary_loops(faces, len(vertices))
            if len(loops) > 1:
                print(f"| {name}, {height} | {len(faces)} | {len(loops)} holes |")
                continue
            for way in (tutte, harmonic, stretch, authalic, "omtwarp", "refined"):
                begun = time.process_time()
                surface = vertices, faces
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")
                    if callable(way):
                        disk, label = way(vertices, faces, loops[0]), way.__name__
                    else:
                        label, refine = way, "area" if way == "refined" else None
                        found = omtwarp.map_surface(surface, domain="disk", refine=refine, optimality=False)
                        disk, surface = found.disk, (found.vertices, found.faces)
                seconds = time.process_time() - begun
                flips, area, angle = judged(*surface, disk)
                numbers = f"{flips} | {area:.5g} | {angle:.4g} | {seconds:.1f}"
                print(f"| {name}, {height} | {len(faces)} | {label} | {numbers} |", flush=True)
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except omtwarp.OmtwarpError as error:
        raise SystemExit(f"error: {error}") from None
