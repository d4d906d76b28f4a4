"""Kernels of the last step of transport, on the image mesh itself."""

from omtwarp.device.start import HALF, KERNEL_OPTIONS, ONE, THREE, ZERO, wp
from omtwarp.geometry.spherical import TINY, logarithm
from omtwarp.metrics.kernels import solid_angle
from omtwarp.transport.kernels import area_error, centre

wp.set_module_options(KERNEL_OPTIONS)


@wp.kernel
def cost_and_area_errors(
    start: wp.array[wp.vec3d],
    points: wp.array[wp.vec3d],
    faces: wp.array[wp.vec3i],
    areas: wp.array[wp.float64],
    usual: wp.float64,
    worst: wp.float64,
    # Data out:
    measured: wp.array2d[wp.float64],
):
    """Compute the squared cost of every triangle, and its area error, at most ``usual`` and at most ``worst``."""
    f = wp.tid()
    face = faces[f]
    _pull, distance = logarithm(centre(points, face), centre(start, face))
    measured[f, 0] = areas[f] * distance * distance
    measured[f, 1] = area_error(points, face, areas[f], usual)
    measured[f, 2] = area_error(points, face, areas[f], worst)


@wp.kernel
def displacements_to_start(
    start: wp.array[wp.vec3d],
    points: wp.array[wp.vec3d],
    # Data out:
    pull: wp.array[wp.vec3d],
):
    v = wp.tid()
    towards, _distance = logarithm(points[v], start[v])
    pull[v] = towards


@wp.kernel
def weak_curl_and_area(
    points: wp.array[wp.vec3d],
    pull: wp.array[wp.vec3d],
    faces: wp.array[wp.vec3i],
    offsets: wp.array[wp.int32],
    corners: wp.array[wp.int32],
    first: int,
    # Data out:
    curl: wp.array[wp.float64],
    energy: wp.array[wp.float64],
    area: wp.array[wp.float64],
):
    """Compute ∫ u · J∇φ over the triangles around a vertex, a third of ∫ |u|², and a third of their area on the sphere.

    The area is that of the spherical triangles, which tile the sphere: in a fan of long thin triangles the flat ones
    fall short of it by several per cent, and equal flat areas would push the map out of the fan at the expense of cost.
    u is the mean of the displacements at a triangle's corners. With n the normal of length 2A and e the edge opposite
    the vertex, A J∇φ = n × (n × e) / (4A) = -A e / (2A) ... = -e / 2: the area drops out, and slivers do no harm.
    """
    thread, _compiled_once = wp.tid()
    v = first + thread
    total_curl = wp.float64(0.0)
    total_energy = wp.float64(0.0)
    total_area = wp.float64(0.0)
    for k in range(offsets[v], offsets[v + 1]):
        corner = corners[k]
        face = faces[corner // 3]
        i, j = face[(corner + 1) % 3], face[(corner + 2) % 3]
        mean = ONE / THREE * (pull[v] + pull[i] + pull[j])
        double_area = wp.length(wp.cross(points[i] - points[v], points[j] - points[v]))
        total_curl -= HALF * wp.dot(mean, points[j] - points[i])
        total_energy += ONE / THREE * HALF * double_area * wp.dot(mean, mean)
        total_area += ONE / THREE * solid_angle(points[v], points[i], points[j])
    curl[v] = total_curl
    energy[v] = total_energy
    area[v] = total_area


@wp.kernel
def missing_areas(
    wanted: wp.array[wp.float64],
    area: wp.array[wp.float64],
    total: wp.array[wp.float64],
    sphere_area: wp.float64,
    # Data out:
    missing: wp.array[wp.float64],
):
    """Compute the area missing at vertices, whose present areas are scaled to the sum 4π."""
    v = wp.tid()
    missing[v] = wanted[v] - area[v] * (sphere_area / total[0])


@wp.kernel
def move_by_potentials(
    points: wp.array[wp.vec3d],
    faces: wp.array[wp.vec3i],
    stream: wp.array[wp.float64],
    potential: wp.array[wp.float64],
    offsets: wp.array[wp.int32],
    corners: wp.array[wp.int32],
    curl_step: wp.float64,
    area_step: wp.float64,
    first: int,
    # Data out:
    moved: wp.array[wp.vec3d],
):
    """Move along J∇H and -∇Θ, means over the triangles around a vertex weighted by one over their areas.

    With n the normal of length 2A and e_k the edge opposite corner k, ∇H = Σ H_k n × e_k / (2A)² and
    J∇H = -Σ H_k e_k / 2A.
    """
    v = first + wp.tid()
    total = wp.vec3d()
    weight = ZERO
    for k in range(offsets[v], offsets[v + 1]):
        face = faces[corners[k] // 3]
        i, j, l = face[0], face[1], face[2]
        normal = wp.cross(points[j] - points[i], points[l] - points[i])
        double_area = wp.length(normal)
        if double_area > ZERO:
            a, b, c = points[l] - points[j], points[i] - points[l], points[j] - points[i]
            around = -(stream[i] * a + stream[j] * b + stream[l] * c) / double_area
            uphill = potential[i] * a + potential[j] * b + potential[l] * c
            uphill = wp.cross(normal / double_area, uphill) / double_area
            total += (curl_step * around - area_step * uphill) / double_area
            weight += ONE / double_area
    y = points[v]
    step = total / wp.max(weight, TINY)
    moved[v] = wp.normalize(y + step - wp.dot(step, y) * y)
