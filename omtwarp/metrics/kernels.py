"""Per-triangle distortion of a sphere map, as float64 kernels."""

from omtwarp.device.start import HALF, KERNEL_OPTIONS, ONE, TWO, wp
from omtwarp.geometry.spherical import TINY, triple_product

wp.set_module_options(KERNEL_OPTIONS)


@wp.func
def triangle_frame(p0: wp.vec3d, p1: wp.vec3d, p2: wp.vec3d):
    """Return the base, foot and height of a triangle laid flat with its first edge along the x axis."""
    base = wp.length(p1 - p0)
    along = (p1 - p0) / wp.max(base, TINY)
    foot = wp.dot(p2 - p0, along)
    height = wp.length(p2 - p0 - foot * along)
    return base, foot, height


@wp.func
def solid_angle(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d):
    """Return the signed solid angle of a spherical triangle (van Oosterom and Strackee 1983)."""
    return TWO * wp.atan2(triple_product(a, b, c), ONE + wp.dot(a, b) + wp.dot(b, c) + wp.dot(c, a))


@wp.kernel
def triangle_distortion(
    surface: wp.array[wp.vec3d],
    sphere: wp.array[wp.vec3d],
    faces: wp.array[wp.vec3i],
    # Data out:
    surface_area: wp.array[wp.float64],
    sphere_area: wp.array[wp.float64],
    determinant: wp.array[wp.float64],
    angle: wp.array[wp.float64],
    triple: wp.array[wp.float64],
    solid: wp.array[wp.float64],
):
    f = wp.tid()
    face = faces[f]
    base, foot, height = triangle_frame(surface[face[0]], surface[face[1]], surface[face[2]])
    a, b, c = wp.normalize(sphere[face[0]]), wp.normalize(sphere[face[1]]), wp.normalize(sphere[face[2]])
    image_base, image_foot, image_height = triangle_frame(a, b, c)
    # The Jacobian between the two flat triangles is upper triangular in these frames: [[p, q], [0, r]].
    p = image_base / base
    r = image_height / height
    q = (image_foot - p * foot) / height
    surface_area[f] = HALF * base * height
    sphere_area[f] = HALF * image_base * image_height
    determinant[f] = p * r
    angle[f] = (p * p + q * q + r * r) / (p * r)
    triple[f] = triple_product(a, b, c)
    solid[f] = solid_angle(a, b, c)


@wp.kernel
def count_crossings(
    sphere: wp.array[wp.vec3d],
    faces: wp.array[wp.vec3i],
    rays: wp.array[wp.vec3d],
    clearance: wp.float64,
    # Data out:
    crossings: wp.array[wp.int32],
    doubtful: wp.array[wp.int32],
):
    """Compute the signed number of spherical triangles over every ray from the centre.

    Rays too near an edge are marked. A ray is inside a triangle where its three triple products have the sign of the
    triangle's own; with the opposite sign all three, its antipode is. The counts are integers, so the order of the
    additions does not matter.
    """
    f, r = wp.tid()
    face = faces[f]
    a, b, c = sphere[face[0]], sphere[face[1]], sphere[face[2]]
    ray = rays[r]
    w0, w1, w2 = triple_product(ray, b, c), triple_product(ray, c, a), triple_product(ray, a, b)
    upright = triple_product(a, b, c) > wp.float64(0.0)
    positive = upright and w0 > -clearance and w1 > -clearance and w2 > -clearance
    negative = not upright and w0 < clearance and w1 < clearance and w2 < clearance
    if positive or negative:
        if wp.min(wp.min(wp.abs(w0), wp.abs(w1)), wp.abs(w2)) < clearance:
            wp.atomic_add(doubtful, r, 1)
        elif positive:
            wp.atomic_add(crossings, r, 1)
        else:
            wp.atomic_add(crossings, r, -1)
