"""Remove the flipped triangles of a sphere map by moving the fewest vertices.

Around every flipped triangle a patch of a few rings is freed and its distortion minimised with an energy that is finite
on flipped triangles and tends to a barrier as ε falls (Garanzha et al., "Foldover-free maps in 50 lines of code",
2021). Patches that do not touch are independent problems: they share one sparse matrix but each has its own step
length. Patches that stay tangled grow, up to the whole sphere. Those that are solved are smoothed by a round with the
barrier.

A triangle can become positive in two ways: by shrinking through zero, or by growing over half the sphere to the other
side. The second changes how often the sphere is covered, and ends in vertices whose ring goes around them twice with no
triangle flipped. Steps of that kind are not taken: the solid angles of a patch have the same sum before and after.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from omtwarp.device.arrays import empty, sent, vectors
from omtwarp.device.policy import HEAVY_LAUNCH, resolve_device
from omtwarp.device.start import wp
from omtwarp.device.threads import Each, blas_threads, computed, each, launch_parts
from omtwarp.errors import OmtwarpError
from omtwarp.flips.exact import examine, flipped_faces, is_bijective
from omtwarp.mesh.arrays import Bools, Floats, InOneLine, dots, marked, whole_numbers
from omtwarp.mesh.patches import Patches, grow
from omtwarp.mesh.surface import SPHERE_AREA, MeshLike, Surface, as_sphere, as_surface
from omtwarp.options import Progress, tell
from omtwarp.solvers.newton import SUFFICIENT_DECREASE, PatchMatrix
from omtwarp.solvers.triangle import AREA_WEIGHT, triangle_frames
from omtwarp.untangling.kernels import move_in_tangent, solid_angles, untangle_newton, untangle_value

# Rings of vertices that attempts free around every flipped triangle, the last the whole sphere: fewer move fewer
# vertices, and tangle limbs more (a person's area distortion is 2.034 with 2 and 3 first, 2.029 with 4 and 5).
RINGS = (4, 8, 16, 10**9)
# What ε is multiplied by from one round to the next, from LARGEST_EPSILON on, at which triangles are free to pass
# through one another, and Newton steps in a round, at most: the smaller, the more conformal maps are repaired (of 60,
# 50 with 0.5, 48 with 0.7 and 45 with 0.85), for fewer small steps.
LOWERED, ROUND_STEPS = 0.7, 4
LARGEST_EPSILON = 1.0
FATTENED = 0.1  # see :func:`omtwarp.solvers.triangle.triangle_frames`: needles of the mesh stop no attempt
SMALLEST_EPSILON = 1e-4  # of the area ratio D: with an ε this small the energy is a barrier, and remaining flips stay
# A Newton step of few vertices takes as long as one over this many more: its fixed cost.
STEP_WORK = 1000
# Ordinary repairs take up to 16 steps over all vertices, tangled limbs up to 1,900 for areas better by 0.25 at most. So
# much takes about twice as long as a whole map of an ordinary shape.
WORK_PER_VERTEX = 40.0
# Relative growth of the diagonal of the semidefinite Hessian: with less, steps along directions of little curvature let
# noise of 1e-12 grow (in a scan with 230 flips to 5e-4 with 1e-9, to 1e-8 with this).
DAMPING = 1e-3
# Of area against angle in conformal maps: with 1, this and 0.03 the angle distortion of 32 made surfaces is 3.33, 2.84
# and 2.71 after repair, which takes 2.5, 3.2 and 3.5 s.
CONFORMAL_AREA_WEIGHT = 0.1
MAX_HALVINGS = 20  # of a patch's step before the patch stays where it is
# With half and twice the first, and 0.5 and 0.9 for the second, the area distortion of a creature of 2,000 vertices
# differs by at most 0.0002.
SETTLED_GAIN = 0.01  # of a patch's energy: where a step is expected to gain less than half of it, ε is lowered


class RepairBudget:
    """The work that untangling may take, in vertices times Newton steps, which is the same on every machine.

    Args:
        surface: the surface; larger ones get a larger budget.
        share: of the budget of a whole repair.
    """

    def __init__(self, surface: Surface, share: float = 1.0):
        self.granted = share * WORK_PER_VERTEX * (surface.vertex_count + STEP_WORK)
        self.spent = 0

    @property
    def exhausted(self) -> bool:
        """Whether the budget is used up."""
        return self.spent > self.granted

    def spend(self, vertices: int) -> None:
        """Count a Newton step over so many vertices."""
        self.spent += vertices + STEP_WORK


@dataclass(frozen=True, repr=False)
class UntangleResult(InOneLine):
    """A map that is one to one, or the best one found.

    Attributes:
        sphere: unit vectors, float64, shape [V, 3].
        flips_before: triangles with det[s0, s1, s2] <= 0 in the map given.
        flips_after: the same in ``sphere``.
        bijective: whether ``sphere`` is one to one: no triangle is flipped, and every ring turns once.
        rounds: rounds of minimisation over all attempts.
        vertices_moved: how many vertices moved.
        history: one record per attempt: rings, vertices freed, patches, rounds, flips left.
    """

    sphere: Floats
    flips_before: int
    flips_after: int
    bijective: bool
    rounds: int
    vertices_moved: int
    history: list[dict[str, int]] = field(default_factory=list)

    @property
    def converged(self) -> bool:
        """Whether the map is one to one."""
        return self.bijective


@blas_threads(1)
def untangle(
    surface: MeshLike,
    sphere: ArrayLike,
    *,
    rings: Sequence[int] = RINGS,
    keep_scale: bool = False,
    budget: RepairBudget | None = None,
    device: str | None = "auto",
    progress: Progress | None = None,
) -> UntangleResult:
    """Move as few vertices as possible until the map is one to one.

    Args:
        surface: the original surface in any form that :func:`omtwarp.map_to_sphere` takes, V vertices and F faces.
        sphere: images of its vertices, unit vectors, shape [V, 3]; triangles may be flipped or of area zero.
        rings: of vertices that are freed around flipped triangles, a number for each attempt, which begins with the
            result of the one before, until one gives a bijection.
        keep_scale: take triangles of the surface at the scale at which the map shows their surroundings, and their
            angles for more than their areas, which suits conformal maps, where limbs shrink a thousand times and more;
            by default images tend to their own areas.
        budget: the work that it may take; by default that of the surface.
        device: where the kernels run; the sparse systems are solved on the host.
        progress: called as ``progress("untangle", attempt, attempts, details)`` before every attempt; ``tangled`` of
            the details is the number of triangles to repair.

    Returns:
        The map and what was done. ``bijective`` is True unless every attempt failed.

    Raises:
        OmtwarpError: the mesh or the map cannot be used.

    Example:
        >>> import numpy as np, omtwarp
        >>> surface = omtwarp.shapes.icosphere(8)
        >>> tangled = surface.vertices.copy()
        >>> tangled[5] = surface.vertices[surface.faces[0]].mean(axis=0)  # carried over other triangles
        >>> tangled[5] /= (tangled[5] @ tangled[5]) ** 0.5
        >>> untangled = omtwarp.untangle(surface, tangled, device="cpu")
        >>> untangled.flips_before > 0, untangled.flips_after, untangled.bijective
        (True, 0, True)
    """
    surface = as_surface(surface)
    where = resolve_device(device)
    start = np.array(as_sphere(sphere, surface))
    budget = RepairBudget(surface) if budget is None else budget
    points, faces = start.copy(), surface.faces
    examined = examine(points, faces)
    before, tangled = examined.flips, examined.tangled
    history: list[dict[str, int]] = []
    widths = whole_numbers(rings, "rings", (None,), below=2**31).tolist()
    for number, reach in enumerate(widths):
        if not tangled.any() or budget.exhausted:
            break
        tell(progress, "untangle", number, len(widths), {"tangled": int(tangled.sum())})
        freed = grow(faces, marked(surface.vertex_count, faces[tangled]), reach)
        untangling = _Untangling(surface, points, freed, where, keep_scale)
        points, done = untangling.solve(budget)
        examined = examine(points, faces)
        tangled = examined.tangled
        sizes = {"vertices": untangling.patches.free, "patches": untangling.patches.count}
        history.append({"rings": min(reach, surface.vertex_count), **sizes, "rounds": done, "flips": examined.flips})
    moved = int(np.any(points != start, axis=1).sum())
    rounds = sum(attempt["rounds"] for attempt in history)
    return UntangleResult(points, before, examined.flips, not tangled.any(), rounds, moved, history)


def untangled(
    surface: Surface, sphere: Floats, *, budget: RepairBudget | None = None, device: str | None = "auto"
) -> Floats:
    """Return a map without flipped triangles: the very array given where it has none; arguments as before.

    Raises:
        OmtwarpError: repair failed.
    """
    if is_bijective(sphere, surface.faces, device=device):
        return sphere
    repaired = untangle(surface, sphere, budget=budget, device=device)
    if not repaired.bijective:
        raise OmtwarpError(f"{repaired.flips_after} flipped triangles could not be repaired")
    return repaired.sphere


def untangle_patches(surface: Surface, sphere: Floats, freed: Bools, budget: RepairBudget) -> Floats:
    """Try once to untangle the patches of given vertices, on the host.

    Args:
        surface: the original surface, V vertices and F faces.
        sphere: unit vectors, shape [V, 3].
        freed: the vertices that may move, shape [V]; at least one.
        budget: the work that it may take.

    Returns:
        The map, shape [V, 3].
    """
    return _Untangling(surface, sphere, freed, resolve_device("cpu")).solve(budget)[0]


class _Untangling:
    """Minimises over the patches of freed vertices.

    Args:
        surface, sphere, freed: as of :func:`untangle_patches`.
        device: a Warp device.
        keep_scale: as of :func:`untangle`.
    """

    def __init__(self, surface: Surface, sphere: Floats, freed: Bools, device: wp.Device, keep_scale: bool = False):
        self.device = device
        self.sphere = sphere
        self.area_weight = wp.float64(CONFORMAL_AREA_WEIGHT if keep_scale else AREA_WEIGHT)
        self.patches = patches = Patches.of_vertices(surface.faces, freed)
        self.faces = Each(sent(patches.faces, wp.vec3i, device))
        frames = triangle_frames(surface, FATTENED, patches.triangles)
        covered = self._covered(vectors(sphere[patches.vertices], device))
        # The surroundings of a patch determine the area that it has to cover, up to whole spheres; the whole map covers
        # one.
        alone = patches.free == len(patches.vertices)
        # Of the sphere: a patch whose triangles cover nothing in sum is not mistaken for one that covers everything.
        self.share = np.ones(1) if alone else covered - np.floor(covered + 1e-9)
        self.surplus = np.rint(covered - self.share)
        if keep_scale:
            wanted = patches.sum_of_faces(surface.face_areas[patches.triangles]) / SPHERE_AREA
            shown = np.where(self.share > 0.0, self.share, wanted)
            frames *= np.sqrt(wanted / shown)[patches.face_patch, None]
        self.matrix = PatchMatrix(patches, surface, DAMPING)
        # Of what a triangle has at each corner; all vertices that stay share the last place.
        place = 2 * np.repeat(np.minimum(patches.faces, patches.free), 2, axis=1) + np.array([0, 1] * 3)
        self.gradient_place = place.ravel()
        areas = sent(surface.face_areas[patches.triangles], wp.float64, device)
        self.triangles = [self.faces, *each(sent(frames, wp.vec3d, device), areas)]

    def solve(self, budget: RepairBudget) -> tuple[Floats, int]:
        """Lower ε until no patch has a flip, or to its smallest; smooth solved patches; return the map and rounds."""
        patches = self.patches
        points = wp.array(self.sphere[patches.vertices], dtype=wp.vec3d, device=self.device)
        epsilon = np.full(patches.count, LARGEST_EPSILON)
        active = np.ones(patches.count, dtype=bool)
        rounds = 0
        while True:
            rounds += 1
            points = self._round(points, epsilon, active, budget)
            flips = self._flips(points.numpy())
            self.surplus = np.rint(self._covered(points) - self.share)
            active &= ((flips > 0) | (self.surplus != 0)) & (epsilon > SMALLEST_EPSILON)
            if not active.any() or budget.exhausted:
                break
            epsilon[active] = np.maximum(epsilon[active] * LOWERED, SMALLEST_EPSILON)
        # Triangles that are only just positive are slivers, which stop later minimisations: a barrier takes them away.
        solved = (flips == 0) & (self.surplus == 0)
        smooth = self._round(points, np.full(patches.count, SMALLEST_EPSILON), solved, budget).numpy().copy()
        spoilt = np.flatnonzero(((self._flips(smooth) > 0) & solved)[patches.vertex_patch])
        smooth[spoilt] = points.numpy()[spoilt]
        return self._taken(smooth, flips), rounds

    def _round(self, points: wp.array, epsilon: Floats, active: NDArray[np.bool_], budget: RepairBudget) -> wp.array:
        """Take the Newton steps of a round in the active patches, until a step is expected to gain little in each."""
        moving = active.copy()
        for _ in range(ROUND_STEPS):
            if not moving.any() or budget.exhausted:
                break
            points, settled = self._newton_step(points, epsilon, moving)
            budget.spend(self.patches.free)
            moving &= ~settled
        return points

    def _taken(self, points: Floats, flips: NDArray[np.intp]) -> Floats:
        """Return the map with the points of those patches that are solved, or have fewer flips than they had.

        A patch too small for its triangles can end with more flips than it began with. Patches that cover their part of
        the sphere more than once stay as they were too: the next attempt, which frees more around them, finds tangled
        patches by their flipped triangles, not by vertices whose rings turn twice.
        """
        patches, result = self.patches, self.sphere.copy()
        fewer = flips < self._flips(self.sphere[patches.vertices])
        taken = ((flips == 0) | fewer) & (self.surplus == 0)
        moved = np.flatnonzero(taken[patches.vertex_patch])
        result[patches.vertices[moved]] = points[moved]
        return result

    def _newton_step(self, points, epsilon, active) -> tuple[wp.array, NDArray[np.bool_]]:
        """Take a step of the active patches; return the points, and of which patches the expected gain is small."""
        patches = self.patches
        inputs = [*self.triangles, Each(sent(epsilon[patches.face_patch], wp.float64, self.device)), self.area_weight]
        energy, count = self._energy(points, inputs), len(patches.faces)
        slopes, hessians = (wp.empty((count, size), dtype=wp.float64, device=self.device) for size in (6, 21))
        launch_parts(untangle_newton, count, [points, *inputs], each(slopes, hessians), self.device, HEAVY_LAUNCH)
        sums: Floats = np.bincount(self.gradient_place, slopes.numpy().ravel()).astype(np.float64, copy=False)
        gradient = sums[: 2 * patches.free].reshape(-1, 2)
        try:
            self.matrix.factorise(hessians.numpy())
            direction = -self.matrix.solve(gradient)
        except OmtwarpError:
            direction = np.full_like(gradient, np.nan)
        if not np.isfinite(direction).all():
            with np.errstate(all="ignore"):
                direction = np.nan_to_num(-gradient / self.matrix.diagonal, posinf=0.0, neginf=0.0)
        slope = patches.sum_of_vertices(dots(direction, gradient))
        settled: NDArray[np.bool_] = -slope <= SETTLED_GAIN * energy
        # No vertex moves farther than a radian: beyond that its tangent plane does not approximate the sphere.
        length = np.where(active & (slope < 0.0), 1.0, 0.0) / np.maximum(patches.longest(direction), 1.0)
        for _ in range(MAX_HALVINGS):
            moved = self._moved(points, direction, length)
            enough = energy + SUFFICIENT_DECREASE * length * slope
            worse = ~(self._energy(moved, inputs) <= enough) & (length > 0.0)
            if not worse.any():
                return moved, settled
            length[worse] *= 0.5
        length[worse] = 0.0
        return self._moved(points, direction, length), settled

    def _moved(self, points, direction: Floats, length: Floats):
        """Move the freed points by coordinates [free, 2] in their tangent planes, times a length for every patch."""
        moved, step = wp.clone(points), direction * length[self.patches.vertex_patch][:, None]
        computed(move_in_tangent, each(points, sent(step, wp.float64, self.device)), moved[: self.patches.free])
        return moved

    def _energy(self, points: wp.array, inputs: list[object]) -> Floats:
        """Return the energy of every patch; infinite where it covers the sphere once more than it did.

        Args:
            points: of the patches, vec3d, shape [P].
            inputs: of the kernel, behind the points.
        """
        patches, count = self.patches, len(self.patches.faces)
        values, solid = (empty(count, wp.float64, self.device) for _ in range(2))
        launch_parts(untangle_value, count, [points, *inputs], each(values, solid), self.device)
        energy = patches.sum_of_faces(values.numpy())
        covered = patches.sum_of_faces(solid.numpy()) / SPHERE_AREA
        energy[np.abs(np.rint(covered - self.share)) > np.abs(self.surplus)] = np.inf
        return energy

    def _covered(self, points: wp.array) -> Floats:
        """Return the signed area that every patch covers, with multiplicity, over that of the sphere, shape [count]."""
        solid = computed(solid_angles, [points, self.faces], empty(len(self.patches.faces), wp.float64, self.device))
        return self.patches.sum_of_faces(solid.numpy()) / SPHERE_AREA

    def _flips(self, points: Floats) -> NDArray[np.intp]:
        """Return the number of flipped triangles of every patch, decided exactly, shape [count]."""
        patches = self.patches
        return np.bincount(patches.face_patch[flipped_faces(points, patches.faces)], minlength=patches.count)
