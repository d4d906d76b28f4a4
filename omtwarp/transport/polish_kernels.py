"""Kernels of the last step of transport, on the image mesh itself."""

from omtwarp._warp import HALF, wp
from omtwarp.transport.kernels import logarithm

wp.set_module_options({"enable_backward": False})

THIRD = wp.constant(wp.float64(1.0 / 3.0))


@wp.kernel
def displacements(
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
    # Data out:
    curl: wp.array[wp.float64],
    energy: wp.array[wp.float64],
    area: wp.array[wp.float64],
):
    """∫ u · J∇φ over the triangles around a vertex, a third of ∫ |u|², and a third of their area.

    u is the mean of the displacements at a triangle's corners. With n the normal of length 2A and e the edge opposite
    the vertex, A J∇φ = n × (n × e) / (4A) = -A e / (2A) ... = -e / 2: the area drops out, and slivers do no harm.
    """
    v = wp.tid()
    total_curl = wp.float64(0.0)
    total_energy = wp.float64(0.0)
    total_area = wp.float64(0.0)
    for k in range(offsets[v], offsets[v + 1]):
        corner = corners[k]
        face = faces[corner // 3]
        i, j = face[(corner + 1) % 3], face[(corner + 2) % 3]
        mean = THIRD * (pull[v] + pull[i] + pull[j])
        double_area = wp.length(wp.cross(points[i] - points[v], points[j] - points[v]))
        total_curl -= HALF * wp.dot(mean, points[j] - points[i])
        total_energy += THIRD * HALF * double_area * wp.dot(mean, mean)
        total_area += THIRD * HALF * double_area
    curl[v] = total_curl
    energy[v] = total_energy
    area[v] = total_area


@wp.kernel
def move_by_potentials(
    points: wp.array[wp.vec3d],
    curl_field: wp.array[wp.vec3d],
    area_field: wp.array[wp.vec3d],
    curl_step: wp.float64,
    # Data out:
    moved: wp.array[wp.vec3d],
):
    """Along J∇H and along -∇Θ at once; the fields hold -∇H and -∇Θ at the vertices."""
    v = wp.tid()
    y = points[v]
    step = area_field[v] - curl_step * wp.cross(y, curl_field[v])
    moved[v] = wp.normalize(y + step)
