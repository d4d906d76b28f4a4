"""Kernel of the cotangent weights of edges, launched on the CPU, where their matrices are factorised."""

from omtwarp.device.start import HALF, KERNEL_OPTIONS, wp
from omtwarp.geometry.kernels import corner_cotangent

wp.set_module_options(KERNEL_OPTIONS)


@wp.func
def cotangent_at(corner: int, points: wp.array[wp.vec3d], faces: wp.array[wp.vec3i]) -> wp.float64:
    face = faces[corner // 3]
    k = corner % 3
    return corner_cotangent(points[face[k]], points[face[(k + 1) % 3]], points[face[(k + 2) % 3]])


@wp.kernel
def edge_weights_of_corners(
    points: wp.array[wp.vec3d],
    faces: wp.array[wp.vec3i],
    corners: wp.array[wp.vec2i],
    # Data out:
    weights: wp.array[wp.float64],
):
    e = wp.tid()
    weights[e] = HALF * (cotangent_at(corners[e][0], points, faces) + cotangent_at(corners[e][1], points, faces))
