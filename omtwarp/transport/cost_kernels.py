"""The area error of a map, and the centres of triangles."""

from omtwarp.device.start import HALF, KERNEL_OPTIONS, ONE, TWO, wp

wp.set_module_options(KERNEL_OPTIONS)


@wp.func
def centre(points: wp.array[wp.vec3d], face: wp.vec3i):
    return wp.normalize(points[face[0]] + points[face[1]] + points[face[2]])


@wp.func
def area_error(points: wp.array[wp.vec3d], face: wp.vec3i, area: wp.float64, largest: wp.float64):
    """Return area times D + 1/D - 2 of a triangle, D the area of its flat image over its own, at most ``largest``."""
    p0 = points[face[0]]
    image = HALF * wp.length(wp.cross(points[face[1]] - p0, points[face[2]] - p0))
    # Least ratio, of areas: its reciprocal, and that times an area, stay finite
    ratio = wp.max(image / area, wp.float64(1e-150))
    return area * wp.min(ratio + ONE / ratio - TWO, largest)


@wp.kernel
def capped_area_error(
    points: wp.array[wp.vec3d],
    faces: wp.array[wp.vec3i],
    areas: wp.array[wp.float64],
    largest: wp.float64,
    # Data out:
    error: wp.array2d[wp.float64],
):
    f = wp.tid()
    error[f, 0] = area_error(points, faces[f], areas[f], largest)
