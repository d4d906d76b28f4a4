"""A kernel that untangles small patches, each by a thread of its own, with all its Newton steps."""

from omtwarp.device.start import HALF, KERNEL_OPTIONS, LARGE, ONE, ZERO, wp
from omtwarp.geometry.spherical import oriented_volume
from omtwarp.mesh import surface
from omtwarp.solvers.triangle_newton.patch_kernels import (
    SUFFICIENT_DECREASE,
    PatchMeshes,
    PatchScratch,
    find_descent,
    find_direction,
    longest_move,
)
from omtwarp.solvers.triangle_newton.triangle import in_tangent
from omtwarp.untangling.kernels import solid_angle, untangle_derivatives, untangle_energy

wp.set_module_options(KERNEL_OPTIONS)

SPHERE_AREA = wp.constant(wp.float64(surface.SPHERE_AREA))


@wp.struct
class Untangling:
    """Parameters of an attempt, as :class:`omtwarp.untangling.untangle.Schedule` has them, and of its steps."""

    factor: wp.float64
    largest: wp.float64
    smallest: wp.float64
    weight: wp.float64
    damping: wp.float64
    settled_gain: wp.float64
    steps: wp.int32
    halvings: wp.int32
    most: wp.int32  # Newton steps of a patch


@wp.func
def sheets_of(p: int, patches: PatchMeshes, share: wp.float64, points: wp.array[wp.vec3d]) -> wp.float64:
    """Return how many whole spheres a patch covers besides its share."""
    covered = ZERO
    for t in range(patches.face_starts[p], patches.face_starts[p + 1]):
        face = patches.faces[t]
        covered += solid_angle(points[face[0]], points[face[1]], points[face[2]])
    return wp.rint(covered / SPHERE_AREA - share)


@wp.func
def is_tangled(p: int, patches: PatchMeshes, points: wp.array[wp.vec3d]) -> bool:
    """Return whether a triangle is flipped in floating point, which may be wrong for one that is nearly flat."""
    for t in range(patches.face_starts[p], patches.face_starts[p + 1]):
        face = patches.faces[t]
        if not oriented_volume(points[face[0]], points[face[1]], points[face[2]]) > ZERO:
            return True
    return False


@wp.func
def energy_of(
    p: int,
    patches: PatchMeshes,
    share: wp.float64,
    points: wp.array[wp.vec3d],
    eps: wp.float64,
    weight: wp.float64,
    sheets: wp.float64,
) -> wp.float64:
    """Return the energy of a patch; LARGE where it covers the sphere more often than ``sheets`` says."""
    if wp.abs(sheets_of(p, patches, share, points)) > wp.abs(sheets):
        return LARGE
    energy = ZERO
    for t in range(patches.face_starts[p], patches.face_starts[p + 1]):
        face = patches.faces[t]
        a = points[face[0]]
        b = points[face[1]]
        c = points[face[2]]
        energy += untangle_energy(patches.frames[t], patches.areas[t], a, b, c, eps, weight)
    return energy


@wp.kernel
def untangle_small_patches(
    group: wp.array[wp.int32],
    patches: PatchMeshes,
    shares: wp.array[wp.float64],
    given: Untangling,
    # Data in and out:
    points: wp.array[wp.vec3d],
    tried: wp.array[wp.vec3d],
    scratch: PatchScratch,
    # Data out:
    taken: wp.array[wp.int32],
    rounds: wp.array[wp.int32],
):
    """Lower ε until no triangle of the patch is flipped, with some Newton steps for every value.

    ``shares`` are the parts of the sphere that patches have to cover, shape [count]; ``taken`` and ``rounds`` count
    Newton steps and values of ε.
    """
    thread, _compiled_once = wp.tid()
    p = group[thread]
    begin = patches.starts[p]
    end = patches.starts[p + 1]
    share = shares[p]
    eps = given.largest
    sheets = sheets_of(p, patches, share, points)
    steps = int(0)
    done = int(0)
    going = bool(True)
    while going:
        done += 1
        left = int(given.steps)
        while left > 0:
            left -= 1
            steps += 1
            for t in range(patches.face_starts[p], patches.face_starts[p + 1]):
                face = patches.faces[t]
                a = points[face[0]]
                b = points[face[1]]
                c = points[face[2]]
                frame = patches.frames[t]
                area = patches.areas[t]
                untangle_derivatives(t, frame, area, a, b, c, eps, given.weight, scratch.gradient, scratch.blocks)
            slope = find_direction(p, patches, given.damping, scratch)
            if not wp.isfinite(slope):
                slope = find_descent(p, patches, scratch)
            energy = energy_of(p, patches, share, points, eps, given.weight, sheets)
            if -slope <= given.settled_gain * energy or steps >= given.most:
                left = int(0)
            length = ZERO
            if slope < ZERO:
                # No vertex moves farther than a radian: beyond that its tangent plane does not approximate the sphere.
                length = ONE / wp.max(ONE, longest_move(p, patches, scratch))
            trials = int(given.halvings)
            while trials > 0 and length > ZERO:
                trials -= 1
                for i in range(begin, end):
                    x0 = length * scratch.direction[2 * i]
                    x1 = length * scratch.direction[2 * i + 1]
                    tried[i] = in_tangent(points[i], x0, x1)
                after = energy_of(p, patches, share, tried, eps, given.weight, sheets)
                if after <= energy + SUFFICIENT_DECREASE * length * slope:
                    for i in range(begin, end):
                        points[i] = tried[i]
                    length = ZERO
                else:
                    length = HALF * length
        sheets = sheets_of(p, patches, share, points)
        going = is_tangled(p, patches, points) or sheets != ZERO
        if not eps > given.smallest or steps >= given.most:
            going = bool(False)
        eps = wp.max(eps * given.factor, given.smallest)
    taken[p] = steps
    rounds[p] = done
