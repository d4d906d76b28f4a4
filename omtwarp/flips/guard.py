"""Steps that cannot flip: a motion shortened only where it would turn a triangle over.

The first round examines all triangles, later rounds only those around vertices that have just been changed. Lists of
these are filled by counting upwards, in an order that differs from run to run; no result depends on it.
"""

from __future__ import annotations

from enum import IntEnum

import numpy as np

from omtwarp.device.arrays import vectors
from omtwarp.device.policy import list_threads, resolve_device
from omtwarp.device.start import KERNEL_OPTIONS, ZERO, wp
from omtwarp.flips.exact import is_bijective
from omtwarp.mesh.arrays import Floats
from omtwarp.mesh.surface import Surface

wp.set_module_options(KERNEL_OPTIONS)

# A vertex whose step was halved this often stays where it was.
MAX_ROUNDS = 500
# A step that leaves a triangle a hundredth of its area counts as a flip: on scanned shapes one such triangle raises the
# area distortion of the map by more than the step lowers it.
MIN_PART = 0.2


class Count(IntEnum):
    """Places of the counters.

    Triangles to be corrected in this round and the next, vertices changed, rounds begun, vertices held back in all.
    """

    BAD = 0
    NEXT = 1
    CHANGED = 2
    ROUND = 3
    HELD = 4


@wp.func
def is_bad(before: wp.array[wp.vec3d], after: wp.array[wp.vec3d], face: wp.vec3i, floor: wp.float64):
    """Return whether a step flips a triangle, or shrinks it below its floor; one that is below it already may grow."""
    size = wp.dot(after[face[0]], wp.cross(after[face[1]], after[face[2]]))
    bad = bool(True)
    if size > ZERO:
        if size >= floor:
            bad = bool(False)
        elif size >= wp.dot(before[face[0]], wp.cross(before[face[1]], before[face[2]])):
            bad = bool(False)
    return bad


@wp.kernel
def find_bad(
    before: wp.array[wp.vec3d],
    after: wp.array[wp.vec3d],
    faces: wp.array[wp.vec3i],
    floors: wp.array[wp.float64],
    # Data in and out:
    counters: wp.array[wp.int32],
    # Data out:
    bad: wp.array2d[wp.int32],
):
    f = wp.tid()
    if is_bad(before, after, faces[f], floors[f]):
        bad[0, wp.atomic_add(counters, Count.NEXT, 1)] = f


@wp.kernel
def end_round(
    most: int,
    # Data in and out:
    counters: wp.array[wp.int32],
    # Data out:
    again: wp.array[wp.int32],
):
    """Go on while there are bad triangles; in the round after the last one all vertices go back."""
    again[0] = 0
    if counters[Count.NEXT] > 0 and counters[Count.ROUND] <= most:
        again[0] = 1
        counters[Count.ROUND] = counters[Count.ROUND] + 1
    counters[Count.BAD] = counters[Count.NEXT]
    counters[Count.NEXT] = 0
    counters[Count.CHANGED] = 0


@wp.kernel
def shorten_steps(
    before: wp.array[wp.vec3d],
    faces: wp.array[wp.vec3i],
    bad: wp.array2d[wp.int32],
    limit: int,
    most: int,
    threads: int,
    # Data in and out:
    counters: wp.array[wp.int32],
    vertex_rounds: wp.array[wp.int32],
    halvings: wp.array[wp.int32],
    wanted: wp.array[wp.vec3d],
    after: wp.array[wp.vec3d],
    # Data out:
    changed: wp.array[wp.int32],
):
    """Halve the steps of bad triangles' corners, once each; ``wanted`` keeps where those were going at first."""
    thread, _compiled_once = wp.tid()
    this = counters[Count.ROUND]
    if this > most:
        for v in range(thread, before.shape[0], threads):
            if halvings[v] == 0:
                wp.atomic_add(counters, Count.HELD, 1)
            after[v] = before[v]
    else:
        for k in range(thread, counters[Count.BAD], threads):
            face = faces[bad[(this - 1) % 2, k]]
            for corner in range(3):
                v = face[corner]
                if wp.atomic_max(vertex_rounds, v, this) < this:
                    times = halvings[v] + 1
                    halvings[v] = times
                    if times == 1:
                        wanted[v] = after[v]
                        wp.atomic_add(counters, Count.HELD, 1)
                    if times >= limit:
                        after[v] = before[v]
                    else:
                        part = wp.pow(wp.float64(0.5), wp.float64(times))
                        after[v] = wp.normalize(before[v] + part * (wanted[v] - before[v]))
                    changed[wp.atomic_add(counters, Count.CHANGED, 1)] = v


@wp.kernel
def find_bad_around(
    before: wp.array[wp.vec3d],
    after: wp.array[wp.vec3d],
    faces: wp.array[wp.vec3i],
    floors: wp.array[wp.float64],
    offsets: wp.array[wp.int32],
    corners: wp.array[wp.int32],
    changed: wp.array[wp.int32],
    threads: int,
    # Data in and out:
    counters: wp.array[wp.int32],
    face_rounds: wp.array[wp.int32],
    # Data out:
    bad: wp.array2d[wp.int32],
):
    this = counters[Count.ROUND]
    for k in range(wp.tid(), counters[Count.CHANGED], threads):
        v = changed[k]
        for n in range(offsets[v], offsets[v + 1]):
            f = corners[n] // 3
            if wp.atomic_max(face_rounds, f, this) < this:
                if is_bad(before, after, faces[f], floors[f]):
                    bad[this % 2, wp.atomic_add(counters, Count.NEXT, 1)] = f


class StepGuard:
    """Keeps every triangle of a moving sphere map positively oriented, and its area above a lower bound.

    The step of a vertex of a triangle that would flip is halved repeatedly, and the vertex finally held; the steps of
    its neighbours are shortened only where a triangle of theirs would flip as a result. Since the map before the step
    has no flip, holding vertices always leads to a map without flips, and a few bad triangles do not slow the others.

    Args:
        surface: the surface; its triangles' areas, total 4π, are what they should have on the sphere.
        device: where the kernels run.
        smallest: a step may shrink no triangle below this part of its area on the surface; a triangle that is smaller
            already may only grow. With 0 only flips count.

    Attributes:
        held: how many vertices the last step was shortened for, Warp int32 [1] on the device.
    """

    def __init__(self, surface: Surface, device: wp.Device, smallest: float = MIN_PART):
        self.device = device
        self.vertex_count = surface.vertex_count
        self.face_count = surface.face_count
        mesh = surface.on(device)
        self._faces = mesh.faces
        self._offsets, self._corners = mesh.vertex_corners
        # det[s0, s1, s2] of a small triangle is twice its area.
        self._floors = wp.array(2.0 * smallest * surface.face_areas, dtype=wp.float64, device=device)
        self._counters = wp.zeros(5, dtype=wp.int32, device=device)
        self.held = self._counters[Count.HELD : Count.HELD + 1]
        self._again = wp.empty(1, dtype=wp.int32, device=device)
        self._bad = wp.empty((2, self.face_count), dtype=wp.int32, device=device)
        self._face_rounds = wp.empty(self.face_count, dtype=wp.int32, device=device)
        self._vertex_rounds, self._halvings, self._changed = (
            wp.empty(self.vertex_count, dtype=wp.int32, device=device) for _ in range(3)
        )
        self._wanted = wp.empty(self.vertex_count, dtype=wp.vec3d, device=device)
        self._ready: dict[tuple[int, int, int], tuple[wp.Launch, ...]] = {}

    def hold(self, old: wp.array, new: wp.array, rounds: int = MAX_ROUNDS) -> None:
        """Shorten the step from ``old`` (without flips) to ``new``, in place, until nothing flips or shrinks too far.

        If ``rounds`` rounds do not suffice, all vertices stay at ``old``. All happens on the device and can be
        part of a graph; :attr:`held` says how many vertices it touched.
        """
        for array in (self._counters, self._face_rounds, self._vertex_rounds, self._halvings):
            array.zero_()
        find, shorten, around, end = self._launches(old, new, rounds)

        def again() -> None:
            shorten.launch()
            around.launch()
            end.launch()

        find.launch()
        end.launch()
        wp.capture_while(self._again, again)

    def _launches(self, old: wp.array, new: wp.array, rounds: int) -> tuple[wp.Launch, ...]:
        """Prepare the launches of a step from one array to another, once for its dozens of short rounds.

        Launches are kept by addresses and lengths, so that they also serve new arrays at the addresses of old ones.
        """
        # A vertex whose step was halved this often stays where it was.
        max_halvings = 6
        key = (old.ptr, new.ptr, rounds)
        if key not in self._ready:
            threads = list_threads(wp.get_device(self.device))
            mesh = [self._faces, self._floors]

            def prepare(kernel: wp.Kernel, size: int, inputs: list[object], outputs: list[object]) -> wp.Launch:
                return wp.launch(kernel, dim=size, inputs=inputs, outputs=outputs, device=self.device, record_cmd=True)

            end = prepare(end_round, 1, [rounds], [self._counters, self._again])
            find = prepare(find_bad, self.face_count, [old, new, *mesh], [self._counters, self._bad])
            inputs = [old, self._faces, self._bad, max_halvings, rounds, threads]
            both = [self._counters, self._vertex_rounds, self._halvings, self._wanted, new]
            shorten = prepare(shorten_steps, threads, inputs, [*both, self._changed])
            inputs = [old, new, *mesh, self._offsets, self._corners, self._changed, threads]
            around = prepare(find_bad_around, threads, inputs, [self._counters, self._face_rounds, self._bad])
            self._ready[key] = find, shorten, around, end
        return self._ready[key]

    def limit(self, old: wp.array, new: wp.array) -> int:
        """Apply :meth:`hold`, and return the number of vertices whose step was shortened."""
        self.hold(old, new)
        return int(self.held.numpy()[0])


def hold_back(surface: Surface, before: Floats, after: Floats, *, device: str | wp.Device | None = "auto") -> Floats:
    """Move a bijection towards another map as far as it stays a bijection.

    The guard's map has no flips, but large steps can carry a triangle over the far side of the sphere, so that rings
    turn twice; all steps are then halved.

    Args:
        surface: the surface, V vertices.
        before: a bijection to the sphere, unit vectors, shape [V, 3].
        after: any map, shape [V, 3].
        device: where the guard works.

    Returns:
        A bijection between the two, unit vectors, float64, shape [V, 3]; ``before`` itself where nothing of the motion
        can be kept.
    """
    where = resolve_device(device)
    guard, start = StepGuard(surface, where), vectors(before, where)
    step = np.nan_to_num(after - before, posinf=0.0, neginf=0.0)
    # A motion is given up if not even this share of it leaves a bijection.
    for halvings in range(6 + 1):
        moved = before + step * 0.5**halvings
        lengths = np.linalg.norm(moved, axis=1, keepdims=True)
        held = wp.clone(vectors(np.where(lengths > 0.0, moved / np.where(lengths > 0.0, lengths, 1.0), before), where))
        guard.limit(start, held)
        if is_bijective(held, surface.faces, device=where):
            return held.numpy()
    return before
