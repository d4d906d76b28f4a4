"""Kernels of the optimal map that keeps the areas of cells, which are triangles made of four parts.

Numbering follows :class:`omtwarp.mesh.quarter.QuarteredSurface`: column k of ``cells`` is corner k, column 3 + k is the
middle of the edge from corner k to the next, and the parts of cell c are faces 4 c to 4 c + 3.
"""

from omtwarp.device.start import KERNEL_OPTIONS, wp
from omtwarp.geometry.spherical import logarithm
from omtwarp.optimal.kernels import area_gradient, cost_slope, moving_cost
from omtwarp.solvers.triangle_newton.triangle import first_tangent

wp.set_module_options(KERNEL_OPTIONS)


@wp.kernel
def vertex_costs(
    start: wp.array[wp.vec3d],
    points: wp.array[wp.vec3d],
    softness: wp.float64,
    # Data out:
    cost: wp.array[wp.float64],
):
    """Compute the cost of moving every vertex from its start, shape [V]."""
    v = wp.tid()
    _pull, distance = logarithm(points[v], start[v])
    cost[v] = moving_cost(distance, softness)


# A kernel of its own beside transport_gradient: that one adds the potentials of a triangle's three corners, in an order
# that begins with the vertex itself, and so rounds differently from one potential per triangle.
@wp.kernel
def cell_gradient(
    start: wp.array[wp.vec3d],
    points: wp.array[wp.vec3d],
    faces: wp.array[wp.vec3i],
    mass: wp.array[wp.float64],
    potential: wp.array[wp.float64],
    offsets: wp.array[wp.int32],
    corners: wp.array[wp.int32],
    pull_factor: wp.float64,
    softness: wp.float64,
    first: int,
    # Data out:
    gradient: wp.array[wp.vec3d],
):
    """Compute the gradient of the cost plus Σ P_c a_c (P_c fixed) by the vertices, tangent to the sphere, shape [V]."""
    v, _compiled_once = wp.tid()
    v += first
    y = points[v]
    pull, distance = logarithm(y, start[v])
    total = -(pull_factor * mass[v] * cost_slope(distance, softness)) * pull
    for k in range(offsets[v], offsets[v + 1]):
        corner = corners[k]
        face = faces[corner // 3]
        i, j = face[(corner + 1) % 3], face[(corner + 2) % 3]
        total += potential[corner // 12] * area_gradient(y, points[i], points[j])
    gradient[v] = total


@wp.kernel
def cell_couplings(
    points: wp.array[wp.vec3d],
    cells: wp.array2d[wp.int32],
    first: int,
    # Data out:
    couplings: wp.array2d[wp.vec2d],
):
    """Compute the derivatives of each cell's area by its six vertices, in their tangent bases, shape [F, 6]."""
    c, _compiled_once = wp.tid()
    c += first
    for k in range(3):
        after, before = (k + 1) % 3, (k + 2) % 3
        corner = points[cells[c, k]]
        middle = points[cells[c, 3 + k]]
        last = points[cells[c, 3 + before]]
        following = points[cells[c, 3 + after]]
        by_corner = area_gradient(corner, middle, last)
        by_middle = area_gradient(middle, last, corner)
        by_middle += area_gradient(middle, points[cells[c, after]], following)
        by_middle += area_gradient(middle, following, last)
        t = first_tangent(corner)
        couplings[c - first, k] = wp.vec2d(wp.dot(by_corner, t), wp.dot(by_corner, wp.cross(corner, t)))
        t = first_tangent(middle)
        couplings[c - first, 3 + k] = wp.vec2d(wp.dot(by_middle, t), wp.dot(by_middle, wp.cross(middle, t)))
