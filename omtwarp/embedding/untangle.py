"""Remove the flipped triangles of a sphere map by moving the fewest vertices.

Around every flipped triangle a patch of a few rings is freed and its distortion minimised with an energy that is finite
on flipped triangles and tends to a barrier as ε falls (Garanzha et al., "Foldover-free maps in 50 lines of code",
2021). Patches that do not touch are independent problems: they share one sparse matrix but each has its own step
length. Patches that stay tangled grow, up to the whole sphere.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import scipy.sparse as sparse
from numpy.typing import ArrayLike, NDArray
from scipy.sparse.csgraph import connected_components

from omtwarp._warp import resolve_device, wp
from omtwarp.embedding.untangle_kernels import move_in_tangent, untangle_newton, untangle_value
from omtwarp.errors import OmtwarpError
from omtwarp.mesh.surface import Surface
from omtwarp.refine.frames import triangle_frames
from omtwarp.refine.newton import NewtonMatrix
from omtwarp.threads import blas_threads


@dataclass(frozen=True)
class Schedule:
    """How one attempt lowers ε.

    Attributes:
        rings: rings of vertices freed around every flipped triangle.
        factor: what ε is multiplied by from one round to the next.
        steps: Newton steps in a round.
        thinnest: see :func:`omtwarp.refine.frames.triangle_frames`.
        weight: λ, how much area counts against angle.
        largest: the first ε; the larger, the freer are triangles to pass through one another.
        most: flipped triangles of a patch, at most; patches with more are left to the attempts after it.
    """

    rings: int
    factor: float
    steps: int
    thinnest: float
    weight: float = 5.0
    largest: float = 1.0
    most: float = np.inf


SCHEDULES = (
    Schedule(rings=2, factor=0.3, steps=2, thinnest=0.0, most=30),
    Schedule(rings=3, factor=0.5, steps=3, thinnest=0.02, most=100),
    Schedule(rings=5, factor=0.7, steps=4, thinnest=0.1, weight=10.0),
    Schedule(rings=9, factor=0.7, steps=6, thinnest=0.2, weight=10.0),
    Schedule(rings=17, factor=0.7, steps=8, thinnest=0.3),
    Schedule(rings=10**9, factor=0.7, steps=10, thinnest=0.3),
)
SMALLEST_EPSILON = 1e-4
SUFFICIENT = 1e-4  # of the slope: Armijo's condition
HALVINGS = 20
DIAGONAL_GROWTH = 1e-9  # of every entry of the diagonal: the Hessian is only semidefinite
NARROWING = 0.7  # of the triangles: when fewer are left in tangled patches, the others are dropped


@dataclass
class UntangleResult:
    """A map without flipped triangles, or the best one found.

    Attributes:
        sphere: unit vectors, float64, shape [V, 3].
        flips_before: triangles with det[s0, s1, s2] <= 0 in the map given.
        flips_after: the same in ``sphere``.
        rounds: rounds of minimisation over all attempts.
        vertices_moved: vertices that are not where they were.
        history: one record per attempt: rings, vertices freed, patches, rounds, flips left.
    """

    sphere: NDArray[np.float64]
    flips_before: int
    flips_after: int
    rounds: int
    vertices_moved: int
    history: list[dict[str, int]] = field(default_factory=list)


def flipped_faces(sphere: NDArray[np.float64], faces: NDArray[np.int32]) -> NDArray[np.bool_]:
    """Whether every triangle has det[s0, s1, s2] <= 0 (or is not finite), shape [F]."""
    a, b, c = (sphere[faces[:, k]] for k in range(3))
    return ~(np.einsum("ij,ij->i", a, np.cross(b, c)) > 0.0)


@blas_threads(1)
def untangle(
    surface: Surface,
    sphere: ArrayLike,
    *,
    device: str | None = "auto",
    schedules: tuple[Schedule, ...] = SCHEDULES,
    progress: Callable[[str, int, int], None] | None = None,
) -> UntangleResult:
    """Move as few vertices as possible until no triangle is flipped.

    Args:
        surface: the original surface, V vertices and F faces.
        sphere: images of its vertices, unit vectors, shape [V, 3]; triangles may be flipped or of area zero.
        device: where the kernels run; the sparse systems are solved on the host.
        schedules: attempts, each from what the one before it left, until one leaves no flip.
        progress: called with (text, attempt, attempts) before every attempt.

    Returns:
        The map and what was done. ``flips_after`` is 0 unless every attempt failed.
    """
    where = resolve_device(device)
    start = np.array(sphere, dtype=np.float64)
    start /= np.linalg.norm(start, axis=1, keepdims=True)
    points, faces = start.copy(), surface.faces
    flipped = flipped_faces(points, faces)
    before = int(flipped.sum())
    rounds = 0
    history: list[dict[str, int]] = []
    for attempt, schedule in enumerate(schedules):
        if not flipped.any():
            break
        seeds = _of_small_patches(faces, flipped, schedule)
        if not seeds.any():
            continue
        if progress is not None:
            progress(f"untangling {int(flipped.sum())} triangles", attempt, len(schedules))
        patches = _Patches(surface, points, seeds, schedule, where)
        points, done = patches.solve()
        flipped = flipped_faces(points, faces)
        rounds += done
        history.append(
            {
                "rings": min(schedule.rings, surface.vertex_count),
                "vertices": patches.size,
                "patches": patches.count,
                "rounds": done,
                "flips": int(flipped.sum()),
            }
        )
    moved = int(np.any(points != start, axis=1).sum())
    return UntangleResult(points, before, int(flipped.sum()), rounds, moved, history)


def untangle_patches(
    surface: Surface,
    sphere: NDArray[np.float64],
    seeds: NDArray[np.bool_],
    schedule: Schedule,
    device: wp.Device,
) -> tuple[NDArray[np.float64], int]:
    """One attempt to untangle the patches around given triangles.

    Args:
        surface: the original surface, V vertices and F faces.
        sphere: unit vectors, shape [V, 3].
        seeds: the triangles to free, shape [F].
        schedule: how.
        device: a Warp device.

    Returns:
        The map, shape [V, 3], and the number of vertices freed.
    """
    patches = _Patches(surface, sphere, seeds, schedule, device)
    points, _ = patches.solve()
    return points, patches.size


def _of_small_patches(faces: NDArray[np.int32], flipped: NDArray[np.bool_], schedule: Schedule) -> NDArray[np.bool_]:
    """The flipped triangles of those patches that have no more of them than the schedule takes on, shape [F]."""
    if schedule.most >= flipped.sum():
        return flipped
    seed = np.zeros(int(faces.max()) + 1, dtype=bool)
    seed[faces[flipped].ravel()] = True
    free = grow(faces, seed, schedule.rings)
    component = _components(faces[free[faces].any(axis=1)], free)
    patch = component[faces[flipped][:, 0]]
    out = flipped.copy()
    out[flipped] = np.bincount(patch)[patch] <= schedule.most
    return out


def grow(faces: NDArray[np.int32], seed: NDArray[np.bool_], rings: int) -> NDArray[np.bool_]:
    """Vertices within ``rings`` edges of the seed vertices, as a mask of shape [V]."""
    mask = seed.copy()
    for _ in range(rings):
        touched = mask[faces].any(axis=1)
        wider = mask.copy()
        wider[faces[touched].ravel()] = True
        if wider.sum() == mask.sum():
            break
        mask = wider
    return mask


def _components(faces: NDArray[np.int32], free: NDArray[np.bool_]) -> NDArray[np.int32]:
    """The piece that every freed vertex belongs to, linked by edges of the faces, shape [V]; others are alone."""
    pairs = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    pairs = pairs[free[pairs].all(axis=1)]
    graph = sparse.coo_matrix((np.ones(len(pairs)), pairs.T), shape=(len(free), len(free)))
    component: NDArray[np.int32] = connected_components(graph, directed=False)[1]
    return component


class _Patches:
    """The freed vertices around flipped triangles, the triangles that touch them, and the minimisation over them."""

    def __init__(self, surface, sphere, flipped, schedule: Schedule, device):
        self.device = device
        self.schedule = schedule
        self.surface = surface
        self.sphere = sphere
        self.result = sphere.copy()
        seed = np.zeros(surface.vertex_count, dtype=bool)
        seed[surface.faces[flipped].ravel()] = True
        free = grow(surface.faces, seed, schedule.rings)
        touched = free[surface.faces].any(axis=1)
        self.vertices = np.unique(surface.faces[touched])
        local = np.full(surface.vertex_count, -1, dtype=np.int32)
        local[self.vertices] = np.arange(len(self.vertices), dtype=np.int32)
        self.faces = np.ascontiguousarray(local[surface.faces[touched]])
        self.free = free[self.vertices]
        self.size = int(self.free.sum())
        self.areas = np.ascontiguousarray(surface.face_areas[touched])
        self.frames = triangle_frames(surface, schedule.thinnest, surface.faces[touched])
        self._label()
        self._pattern()
        self._upload()

    def _label(self):
        """Number the patches: connected components of the freed vertices."""
        faces, free = self.faces, self.free
        component = _components(faces, free)
        labels = np.full(len(free), -1, dtype=np.intp)
        _, labels[free] = np.unique(component[free], return_inverse=True)
        self.vertex_patch = labels
        self.face_patch = labels[faces].max(axis=1)  # the freed corners of a triangle all lie in one patch
        self.count = self.remaining = int(labels.max()) + 1

    def _pattern(self):
        """The sparse matrix of the freed vertices, and where the entries of triangles go in their gradient."""
        self.unknowns = int(self.free.sum())
        points = self.surface.scaled_vertices[self.vertices]
        self.matrix = NewtonMatrix.of_patches(self.faces, self.free, points, DIAGONAL_GROWTH)
        unknown = np.full(len(self.free), -1, dtype=np.int64)
        unknown[self.free] = np.arange(self.unknowns)
        corner = np.repeat(unknown[self.faces], 2, axis=1)
        index = np.where(corner >= 0, 2 * corner + np.array([0, 1] * 3), -1)
        self.gradient_kept = np.flatnonzero(index.ravel() >= 0)
        self.gradient_slot = index.ravel()[self.gradient_kept]

    def _narrow(self, active: NDArray[np.bool_], points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Go on with the active patches alone; their points.

        Patches share nothing, so that those which are done need not be carried along.
        """
        self._keep(points)
        kept = active[self.face_patch]
        used, corners = np.unique(self.faces[kept], return_inverse=True)
        self.faces = np.ascontiguousarray(corners.reshape(-1, 3).astype(np.int32))
        self.vertices, self.free = self.vertices[used], self.free[used]
        self.areas = np.ascontiguousarray(self.areas[kept])
        self.frames = np.ascontiguousarray(self.frames[kept])
        number = np.cumsum(active) - 1
        self.face_patch = number[self.face_patch[kept]]
        labels = self.vertex_patch[used]
        self.vertex_patch = np.where(labels >= 0, number[labels], -1)
        self.remaining = int(active.sum())
        self._pattern()
        self._upload()
        return points[used]

    def _keep(self, points: NDArray[np.float64]) -> None:
        self.result[self.vertices[self.free]] = points[self.free]

    def _upload(self):
        count, device = len(self.faces), self.device
        self.d_faces = wp.array(self.faces, dtype=wp.vec3i, device=device)
        self.d_frames = wp.array(self.frames, dtype=wp.vec3d, device=device)
        self.d_areas = wp.array(self.areas, dtype=wp.float64, device=device)
        self.d_value = wp.empty(count, dtype=wp.float64, device=device)
        self.d_ratio = wp.empty(count, dtype=wp.float64, device=device)
        self.d_gradient = wp.empty((count, 6), dtype=wp.float64, device=device)
        self.d_hessian = wp.empty((count, 36), dtype=wp.float64, device=device)
        self.d_moved = wp.empty(len(self.vertices), dtype=wp.vec3d, device=device)

    def solve(self) -> tuple[NDArray[np.float64], int]:
        """Lower ε until no patch has a flipped triangle, or it is at its smallest; the map and the number of rounds."""
        whole = self.vertices[self.faces], self.face_patch, self.vertices, self.vertex_patch
        points = wp.array(self.sphere[self.vertices], dtype=wp.vec3d, device=self.device)
        epsilon = np.full(self.count, self.schedule.largest)
        active = np.ones(self.count, dtype=bool)
        rounds = 0
        while True:
            rounds += 1
            for _ in range(self.schedule.steps):
                points = self._newton_step(points, epsilon, active)
            flipped = flipped_faces(points.numpy(), self.faces)
            tangled = np.bincount(self.face_patch[flipped], minlength=self.remaining) > 0
            active &= tangled & (epsilon > SMALLEST_EPSILON)
            if not active.any():
                break
            epsilon[active] = np.maximum(epsilon[active] * self.schedule.factor, SMALLEST_EPSILON)
            if active[self.face_patch].mean() < NARROWING:
                points = wp.array(self._narrow(active, points.numpy()), dtype=wp.vec3d, device=self.device)
                epsilon, active = epsilon[active], active[active]
        self._keep(points.numpy())
        self._take_back(*whole)
        return self.result, rounds

    def _take_back(self, faces, face_patch, vertices, vertex_patch) -> None:
        """Leave patches as they were that ended with no fewer flips: the next attempt frees more around them.

        A patch too small for its triangles can end far more tangled than it was.
        """
        before, after = (
            np.bincount(face_patch[flipped_faces(sphere, faces)], minlength=self.count)
            for sphere in (self.sphere, self.result)
        )
        back = vertices[(vertex_patch >= 0) & ((after > 0) & (after >= before))[vertex_patch]]
        self.result[back] = self.sphere[back]

    def _newton_step(self, points, epsilon, active):
        face_epsilon = wp.array(epsilon[self.face_patch], dtype=wp.float64, device=self.device)
        energy = self._energy(points, face_epsilon)
        inputs = [points, self.d_faces, self.d_frames, self.d_areas, face_epsilon, wp.float64(self.schedule.weight)]
        wp.launch(
            untangle_newton, dim=len(self.faces), inputs=inputs, outputs=[self.d_gradient, self.d_hessian],
            device=self.device,
        )
        gradient = np.bincount(
            self.gradient_slot, self.d_gradient.numpy().ravel()[self.gradient_kept], minlength=2 * self.unknowns
        ).reshape(-1, 2)
        try:
            self.matrix.factorise(self.d_hessian.numpy())
            direction = -self.matrix.solve(gradient)
        except OmtwarpError:
            direction = np.full_like(gradient, np.nan)
        if not np.isfinite(direction).all():
            with np.errstate(all="ignore"):
                direction = np.nan_to_num(-gradient / self.matrix.diagonal, posinf=0.0, neginf=0.0)
        patch = self.vertex_patch[self.free]
        slope = np.bincount(patch, (direction * gradient).sum(axis=1), minlength=self.remaining)
        length = np.where(active & (slope < 0.0), 1.0, 0.0)
        # No vertex moves farther than a radian: beyond that its tangent plane says nothing about the sphere.
        reach = np.zeros(self.remaining)
        np.maximum.at(reach, patch, np.linalg.norm(direction, axis=1))
        length /= np.maximum(reach, 1.0)
        step = np.zeros((len(self.vertices), 2))
        for _ in range(HALVINGS):
            step[self.free] = direction * length[patch][:, None]
            moved = wp.empty_like(points)
            wp.launch(
                move_in_tangent, dim=len(self.vertices), device=self.device,
                inputs=[points, wp.array(step, dtype=wp.float64, device=self.device)], outputs=[moved],
            )
            worse = ~(self._energy(moved, face_epsilon) <= energy + SUFFICIENT * length * slope) & (length > 0.0)
            if not worse.any():
                return moved
            length[worse] *= 0.5
        length[worse] = 0.0
        step[self.free] = direction * length[patch][:, None]
        moved = wp.empty_like(points)
        wp.launch(
            move_in_tangent, dim=len(self.vertices), device=self.device,
            inputs=[points, wp.array(step, dtype=wp.float64, device=self.device)], outputs=[moved],
        )
        return moved

    def _energy(self, points, face_epsilon) -> NDArray[np.float64]:
        """Energy of every patch."""
        inputs = [points, self.d_faces, self.d_frames, self.d_areas, face_epsilon, wp.float64(self.schedule.weight)]
        wp.launch(
            untangle_value, dim=len(self.faces), inputs=inputs, outputs=[self.d_value, self.d_ratio],
            device=self.device,
        )
        energies = np.bincount(self.face_patch, self.d_value.numpy(), minlength=self.remaining)
        return energies.astype(np.float64, copy=False)
