"""A kernel that relaxes small patches, each by a thread of its own, with all its Newton steps."""

from omtwarp.device.start import HALF, KERNEL_OPTIONS, LARGE, ONE, TWO, ZERO, wp
from omtwarp.geometry.spherical import oriented_volume
from omtwarp.mesh import surface
from omtwarp.refine.kernels import distortion_gradient, distortion_hessian, distortion_terms
from omtwarp.solvers.triangle_newton.motion_kernels import keeps_volume
from omtwarp.solvers.triangle_newton.patch_kernels import (
    SUFFICIENT_DECREASE,
    PatchMeshes,
    PatchScratch,
    find_direction,
    longest_move,
)
from omtwarp.solvers.triangle_newton.triangle import first_tangent, in_tangent

wp.set_module_options(KERNEL_OPTIONS)

SPHERE_AREA = wp.constant(wp.float64(surface.SPHERE_AREA))


@wp.struct
class Relaxing:
    """The energy, with the factors of :meth:`omtwarp.refine.energy.DistortionEnergy.pressures`, and its steps."""

    linear: wp.float64
    inverse: wp.float64
    barrier: wp.float64
    curvature_share: wp.float64
    growth: wp.float64
    steps: wp.int32
    halvings: wp.int32


@wp.func
def differentiate(p: int, patches: PatchMeshes, given: Relaxing, points: wp.array[wp.vec3d], scratch: PatchScratch):
    """Compute gradients and Hessians of the triangles of a patch in the tangent bases of their corners."""
    for t in range(patches.face_starts[p], patches.face_starts[p + 1]):
        face = patches.faces[t]
        a = points[face[0]]
        b = points[face[1]]
        c = points[face[2]]
        frame = patches.frames[t]
        share = patches.areas[t] / SPHERE_AREA
        rows = distortion_gradient(frame, share, a, b, c, given.linear, given.inverse, given.barrier)
        for k in range(3):
            y = points[face[k]]
            tangent = first_tangent(y)
            scratch.gradient[t, 2 * k] = wp.dot(tangent, rows[k])
            scratch.gradient[t, 2 * k + 1] = wp.dot(wp.cross(y, tangent), rows[k])
        distortion_hessian(
            t,
            frame,
            share,
            a,
            b,
            c,
            given.linear,
            given.inverse,
            given.barrier,
            given.curvature_share,
            scratch.blocks,
        )


@wp.func
def energy_of(
    p: int, patches: PatchMeshes, given: Relaxing, before: wp.array[wp.vec3d], points: wp.array[wp.vec3d]
) -> wp.float64:
    """Return the energy of a patch; LARGE where a triangle lost nearly all the volume that it had before."""
    energy = ZERO
    for t in range(patches.face_starts[p], patches.face_starts[p + 1]):
        face = patches.faces[t]
        angle, d, volume, steep = distortion_terms(patches.frames[t], points[face[0]], points[face[1]], points[face[2]])
        had = oriented_volume(before[face[0]], before[face[1]], before[face[2]])
        if not keeps_volume(volume, had):
            return LARGE
        energy += patches.areas[t] * (angle + given.linear * d + given.inverse / d + given.barrier * steep)
    return energy / SPHERE_AREA


@wp.kernel
def relax_small_patches(
    group: wp.array[wp.int32],
    patches: PatchMeshes,
    given: Relaxing,
    # Data in and out:
    points: wp.array[wp.vec3d],
    tried: wp.array[wp.vec3d],
    scratch: PatchScratch,
):
    """Take a few Newton steps of a patch that lower its energy and flip nothing."""
    thread, _compiled_once = wp.tid()
    p = group[thread]
    begin = patches.starts[p]
    end = patches.starts[p + 1]
    left = int(given.steps)
    while left > 0:
        left -= 1
        differentiate(p, patches, given, points, scratch)
        slope = find_direction(p, patches, given.growth, scratch)
        energy = energy_of(p, patches, given, points, points)
        length = ZERO
        if slope < ZERO:
            # No vertex moves farther than half a radian.
            length = ONE / wp.max(ONE, TWO * longest_move(p, patches, scratch))
        trials = int(given.halvings)
        taken = bool(False)
        while trials > 0 and length > ZERO:
            trials -= 1
            for i in range(begin, end):
                tried[i] = in_tangent(
                    points[i], length * scratch.direction[2 * i], length * scratch.direction[2 * i + 1]
                )
            after = energy_of(p, patches, given, points, tried)
            if after <= energy + SUFFICIENT_DECREASE * length * slope:
                taken = bool(True)
                for i in range(begin, end):
                    points[i] = tried[i]
                length = ZERO
            else:
                length = HALF * length
        if not taken:
            left = int(0)
