"""Steps that cannot flip: a motion shortened only where it would turn a triangle over."""

import numpy as np

from omtwarp.device.arrays import vectors
from omtwarp.device.policy import resolve_device
from omtwarp.device.start import KERNEL_OPTIONS, ZERO, wp
from omtwarp.flips.exact import is_bijective
from omtwarp.mesh.arrays import Floats, norms
from omtwarp.mesh.surface import Surface

wp.set_module_options(KERNEL_OPTIONS)

# After so many rounds all vertices stay where they were.
MAX_ROUNDS = 500
# A vertex whose step was halved this often stays where it was.
MAX_HALVINGS = wp.constant(6)
# A step that leaves a triangle a hundredth of its area counts as a flip: on scanned shapes one such triangle raises the
# area distortion of the map by more than the step lowers it.
MIN_PART = 0.2


@wp.kernel
def begin_round(
    # Data in and out:
    rounds: wp.array[wp.int32],
    # Data out:
    again: wp.array[wp.int32],
):
    """Count a round, in which no triangle was found yet that is to be corrected."""
    rounds[0] = rounds[0] + 1
    again[0] = 0


@wp.kernel
def find_bad(
    before: wp.array[wp.vec3d],
    after: wp.array[wp.vec3d],
    faces: wp.array[wp.vec3i],
    floors: wp.array[wp.float64],
    # Data out:
    bad: wp.array[wp.bool],
    again: wp.array[wp.int32],
):
    """Mark triangles that a step flips, or shrinks below their floors; one that is below it already may grow."""
    f = wp.tid()
    face = faces[f]
    size = wp.dot(after[face[0]], wp.cross(after[face[1]], after[face[2]]))
    had = wp.dot(before[face[0]], wp.cross(before[face[1]], before[face[2]]))
    bad[f] = not (size > ZERO and (size >= floors[f] or size >= had))
    if bad[f]:
        again[0] = 1


@wp.kernel
def shorten_steps(
    before: wp.array[wp.vec3d],
    wanted: wp.array[wp.vec3d],
    offsets: wp.array[wp.int32],
    corners: wp.array[wp.int32],
    bad: wp.array[wp.bool],
    rounds: wp.array[wp.int32],
    most: int,
    # Data in and out:
    halvings: wp.array[wp.int32],
    held: wp.array[wp.int32],
    # Data out:
    after: wp.array[wp.vec3d],
):
    """Halve the steps to ``wanted`` of bad triangles' corners; after the last round all vertices go back."""
    v = wp.tid()
    any_bad = bool(rounds[0] > most)
    for n in range(offsets[v], offsets[v + 1]):
        if bad[corners[n] // 3]:
            any_bad = bool(True)
    if any_bad:
        times = halvings[v] + 1
        halvings[v] = times
        if times == 1:
            wp.atomic_add(held, 0, 1)
        if times >= MAX_HALVINGS or rounds[0] > most:
            after[v] = before[v]
        else:
            part = wp.pow(wp.float64(0.5), wp.float64(times))
            after[v] = wp.normalize(before[v] + part * (wanted[v] - before[v]))


class StepGuard:
    """Keeps every triangle of a moving sphere map positively oriented, and its area above a lower bound.

    The step of a vertex of a triangle that would flip is halved repeatedly, and the vertex finally held; the steps of
    its neighbours are shortened only where a triangle of theirs would flip as a result. Since the map before the step
    has no flip, holding vertices always leads to a map without flips.

    Args:
        surface: the surface; its triangles' areas, total 4π, are what they should have on the sphere.
        device: where the kernels run.

    Attributes:
        held: how many vertices the last step was shortened for, Warp int32 [1] on the device.
    """

    def __init__(self, surface: Surface, device: wp.Device):
        self.device = device
        self._sizes = surface.face_count, surface.vertex_count
        mesh = surface.on(device)
        self._faces, self._around = mesh.faces, mesh.vertex_corners
        # det[s0, s1, s2] of a small triangle is twice its area.
        self._floors = wp.array(2.0 * MIN_PART * surface.face_areas, dtype=wp.float64, device=device)
        self.held, self._rounds, self._again = (wp.zeros(1, dtype=wp.int32, device=device) for _ in range(3))
        self._bad = wp.empty(surface.face_count, dtype=wp.bool, device=device)
        self._halvings = wp.empty(surface.vertex_count, dtype=wp.int32, device=device)
        self._wanted = wp.empty(surface.vertex_count, dtype=wp.vec3d, device=device)
        self._ready: dict[tuple[int, int, int], tuple[wp.Launch, ...]] = {}

    def hold(self, old: wp.array, new: wp.array, rounds: int = MAX_ROUNDS) -> None:
        """Shorten the step from ``old`` (without flips) to ``new``, in place, until nothing flips or shrinks too far.

        If ``rounds`` rounds do not suffice, all vertices stay at ``old``. All happens on the device and can be
        part of a graph; :attr:`held` says how many vertices it touched.
        """
        for array in (self.held, self._rounds, self._halvings):
            array.zero_()
        wp.copy(self._wanted, new)
        begin, find, shorten = self._launches(old, new, rounds)
        begin.launch()
        find.launch()

        def again() -> None:
            shorten.launch()
            begin.launch()
            find.launch()

        wp.capture_while(self._again, again)

    def _launches(self, old: wp.array, new: wp.array, rounds: int) -> tuple[wp.Launch, ...]:
        """Prepare the launches of a step from one array to another, once for its dozens of short rounds.

        Launches are kept by addresses and lengths, so that they also serve new arrays at the addresses of old ones.
        """
        key = (old.ptr, new.ptr, rounds)
        if key not in self._ready:
            faces, vertices = self._sizes

            def prepare(kernel: wp.Kernel, size: int, inputs: list[object], outputs: list[object]) -> wp.Launch:
                return wp.launch(kernel, dim=size, inputs=inputs, outputs=outputs, device=self.device, record_cmd=True)

            begin = prepare(begin_round, 1, [], [self._rounds, self._again])
            find = prepare(find_bad, faces, [old, new, self._faces, self._floors], [self._bad, self._again])
            inputs = [old, self._wanted, *self._around, self._bad, self._rounds, rounds]
            shorten = prepare(shorten_steps, vertices, inputs, [self._halvings, self.held, new])
            self._ready[key] = begin, find, shorten
        return self._ready[key]


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
        lengths = norms(moved)[..., None]
        held = wp.clone(vectors(np.where(lengths > 0.0, moved / np.where(lengths > 0.0, lengths, 1.0), before), where))
        guard.hold(start, held)
        if is_bijective(held, surface.faces, device=where):
            return held.numpy()
    return before
