"""Kernels that move a map along tangent vectors, and find the triangles that a step flips or nearly flattens."""

from omtwarp.device.start import HALF, KERNEL_OPTIONS, ONE, ZERO, wp
from omtwarp.geometry.spherical import corners_of, oriented_volume
from omtwarp.solvers.triangle import first_tangent, tangent_coordinates

wp.set_module_options(KERNEL_OPTIONS)

# Share of its volume that a triangle has to keep in one step, or its corners are held back: 100 made surfaces take 6.0
# steps with 0.1 and 0.2 and 6.3 with 0.3, for the same areas and angles; with less a sliver may stop the whole map.
MIN_VOLUME_SHARE = wp.constant(wp.float64(0.2))
# Volumes below this have no certain sign in floating point: none may shrink to it.
ROUND_OFF = wp.constant(wp.float64(1e-14))
# Vertices whose share of a step would be smaller stay where they are: the volumes of needles change by rounding with
# the smallest of moves. A box with such needles is at an area distortion of 2.0169 with this, 2.0185 with a tenth.
LEAST_SHARE = wp.constant(wp.float64(0.01))
# Most that a vertex may take of a step, relative to each neighbour: where shares jump, triangles are torn. 120 made
# surfaces end with the same areas and angles without this limit and with 2, 1.75, 1.5 and 1.25; drawn parts, whose
# steps are held back in many places, end in rags without it; less makes steps shorter.
NEXT_SHARE = wp.constant(wp.float64(1.75))


@wp.func
def keeps_volume(after: wp.float64, before: wp.float64) -> bool:
    """Return whether a triangle is not flipped and keeps some of its volume; a NaN does not."""
    return after > MIN_VOLUME_SHARE * before and (after > ROUND_OFF or after >= before)


@wp.kernel
def retract_to_sphere(
    sphere: wp.array[wp.vec3d],
    direction: wp.array[wp.vec3d],
    share: wp.array[wp.float64],
    length: wp.float64,
    # Data out:
    moved: wp.array[wp.vec3d],
):
    """Move every vertex by its share of a step, and project it to the sphere; with no share its bits stay."""
    i = wp.tid()
    moved[i] = sphere[i]
    if share[i] != ZERO:
        moved[i] = wp.normalize(sphere[i] + length * share[i] * direction[i])


@wp.kernel
def triangle_trouble(
    moved: wp.array[wp.vec3d],
    faces: wp.array[wp.vec3i],
    volume: wp.array[wp.float64],
    # Data out:
    trouble: wp.array[wp.float64],
):
    """Mark with 1 where a step flips a triangle or takes nearly all its volume, shape [F]."""
    t = wp.tid()
    a, b, c = corners_of(moved, faces[t])
    trouble[t] = wp.where(keeps_volume(oriented_volume(a, b, c), volume[t]), ZERO, ONE)


@wp.kernel
def hold_back(
    faces: wp.array[wp.vec3i],
    trouble: wp.array[wp.float64],
    share: wp.array[wp.float64],
    # Data in and out:
    held: wp.array[wp.float64],
):
    """Halve the shares of every triangle's corners in trouble, and let the others follow; small shares become zero.

    ``held`` is a copy of the shares.
    """
    t = wp.tid()
    face = faces[t]
    least = wp.min(wp.min(share[face[0]], share[face[1]]), share[face[2]])
    if trouble[t] > ZERO or least < ONE:
        for k in range(3):
            own = wp.where(trouble[t] > ZERO, HALF, ONE) * share[face[k]]
            own = wp.min(own, NEXT_SHARE * wp.max(least, LEAST_SHARE))
            wp.atomic_min(held, face[k], wp.where(own < LEAST_SHARE, ZERO, own))


@wp.kernel
def to_tangent(
    sphere: wp.array[wp.vec3d],
    vectors: wp.array[wp.vec3d],
    # Data out:
    coordinates: wp.array[wp.vec2d],
):
    """Compute the coordinates of vectors in the tangent bases that the Hessian is written in, shape [V]."""
    i = wp.tid()
    coordinates[i] = tangent_coordinates(sphere[i], vectors[i])


@wp.kernel
def from_tangent(
    sphere: wp.array[wp.vec3d],
    coordinates: wp.array2d[wp.float64],
    # Data out:
    vectors: wp.array[wp.vec3d],
):
    """Compute the vectors with these coordinates in the tangent bases, shape [V]."""
    i = wp.tid()
    y = sphere[i]
    t = first_tangent(y)
    vectors[i] = coordinates[i, 0] * t + coordinates[i, 1] * wp.cross(y, t)
