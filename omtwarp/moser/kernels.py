"""Moser's flow on a triangulated sphere: every particle integrates its own path, walking from triangle to triangle."""

from omtwarp.device.start import HALF, KERNEL_OPTIONS, ONE, THREE, ZERO, wp
from omtwarp.geometry.spherical import TINY
from omtwarp.location.kernels import walk

wp.set_module_options(KERNEL_OPTIONS)

SHORTEST_STEP = wp.constant(wp.float64(1e-3))  # where slivers would need shorter ones: a path has 14 units of time
MAX_STEPS = wp.constant(20000)  # of a path: more than FINAL_TIME / SHORTEST_STEP, so that every path ends
# Coefficients of Ralston's method of third order (1962).
QUARTER = wp.constant(wp.float64(0.25))
THREE_QUARTERS = wp.constant(wp.float64(0.75))
TWO_NINTHS = wp.constant(wp.float64(2.0 / 9.0))
THIRD = wp.constant(wp.float64(1.0 / 3.0))
FOUR_NINTHS = wp.constant(wp.float64(4.0 / 9.0))
LARGEST_DENSITY = wp.constant(wp.float64(1e300))  # instead of infinity


@wp.func(inline=True)
def velocity_at(
    p: wp.vec3d,
    growth: wp.float64,
    start: int,
    points: wp.array[wp.vec3d],
    faces: wp.array[wp.vec3i],
    neighbours: wp.array[wp.vec3i],
    field: wp.array[wp.vec3d],
    mu: wp.array[wp.float64],
    excess: wp.array[wp.float64],
    sizes: wp.array[wp.float64],
):
    """Return dx/ds = -∇Θ / (μ + (e^s - 1) ρ), section 4.2 with s = -log(1 - t); growth is e^s - 1, excess is ρ - 1.

    Also return the size of triangles there, linear between the vertices, and the face.
    """
    f, w = walk(p, start, points, faces, neighbours)
    face = faces[f]
    v = w[0] * field[face[0]] + w[1] * field[face[1]] + w[2] * field[face[2]]
    density = w[0] * mu[face[0]] + w[1] * mu[face[1]] + w[2] * mu[face[2]]
    more = w[0] * excess[face[0]] + w[1] * excess[face[1]] + w[2] * excess[face[2]]
    v = (ONE / (density + growth + growth * more)) * v
    size = w[0] * sizes[face[0]] + w[1] * sizes[face[1]] + w[2] * sizes[face[2]]
    return v - wp.dot(v, p) * p, size, f


@wp.kernel
def face_areas(
    points: wp.array[wp.vec3d],
    faces: wp.array[wp.vec3i],
    # Data out:
    areas: wp.array[wp.float64],
):
    f = wp.tid()
    face = faces[f]
    p0 = points[face[0]]
    areas[f] = HALF * wp.length(wp.cross(points[face[1]] - p0, points[face[2]] - p0))


@wp.kernel
def target_masses(
    areas: wp.array[wp.float64],
    faces: wp.array[wp.vec3i],
    target: wp.array[wp.float64],
    # Data out:
    masses: wp.array[wp.float64],
):
    """Integrate a density, linear between the vertices, over every triangle."""
    f = wp.tid()
    face = faces[f]
    masses[f] = areas[f] * (target[face[0]] + target[face[1]] + target[face[2]]) / THREE


@wp.kernel
def sources_and_density(
    areas: wp.array[wp.float64],
    total: wp.array[wp.float64],
    wanted: wp.array[wp.float64],
    wanted_total: wp.array[wp.float64],
    sphere_area: wp.float64,
    masses: wp.array[wp.float64],
    offsets: wp.array[wp.int32],
    corners: wp.array[wp.int32],
    # Data out:
    sources: wp.array[wp.float64],
    mu: wp.array[wp.float64],
    excess: wp.array[wp.float64],
):
    """Compute the mass less the mass wanted at vertices, and both over the area on the sphere, the second less 1.

    Areas and masses wanted are those of triangles, scaled to 4π. Where they are the same array ``excess`` is exactly 0.
    """
    v = wp.tid()
    scale = sphere_area / total[0]
    wanted_scale = sphere_area / wanted_total[0]
    around = wp.float64(0.0)
    wanted_around = wp.float64(0.0)
    for k in range(offsets[v], offsets[v + 1]):
        around += areas[corners[k] // 3] * scale
        wanted_around += wanted[corners[k] // 3] * wanted_scale
    around = around / THREE
    wanted_around = wanted_around / THREE
    sources[v] = masses[v] - wanted_around
    mu[v] = wp.min(masses[v] / around, LARGEST_DENSITY)
    excess[v] = wp.min(wanted_around / around - ONE, LARGEST_DENSITY)


@wp.kernel
def vertex_field(
    points: wp.array[wp.vec3d],
    faces: wp.array[wp.vec3i],
    potential: wp.array[wp.float64],
    offsets: wp.array[wp.int32],
    corners: wp.array[wp.int32],
    first: int,
    # Data out:
    field: wp.array[wp.vec3d],
    sizes: wp.array[wp.float64],
):
    """Compute -∇Θ at vertices: the angle-weighted mean of the gradients of the triangles around, tangent to the sphere.

    With angle weights a large triangle does not dominate a small one: the area error after the flow is a third of that
    with area weights on scanned shapes.
    """
    thread, _compiled_once = wp.tid()
    v = first + thread
    total = wp.vec3d()
    weight = wp.float64(0.0)
    size = wp.float64(0.0)
    for k in range(offsets[v], offsets[v + 1]):
        corner = corners[k]
        face = faces[corner // 3]
        p0, p1, p2 = points[face[0]], points[face[1]], points[face[2]]
        normal = wp.cross(p1 - p0, p2 - p0)  # its length is twice the area
        double_area = wp.length(normal)
        if double_area > ZERO:
            slope = potential[face[0]] * (p2 - p1) + potential[face[1]] * (p0 - p2) + potential[face[2]] * (p1 - p0)
            side = points[face[(corner + 1) % 3]] - points[v]
            other = points[face[(corner + 2) % 3]] - points[v]
            angle = wp.atan2(double_area, wp.dot(side, other))
            total += angle / double_area * wp.cross(normal / double_area, slope)
            weight += angle
            size += angle * wp.sqrt(double_area)
    sizes[v] = size / wp.max(weight, TINY)
    mean = total / wp.max(weight, TINY)
    field[v] = -(mean - wp.dot(mean, points[v]) * points[v])


@wp.kernel
def integrate_particles(
    particles: wp.array[wp.vec3d],
    first_corners: wp.array[wp.int32],
    points: wp.array[wp.vec3d],
    faces: wp.array[wp.vec3i],
    neighbours: wp.array[wp.vec3i],
    field: wp.array[wp.vec3d],
    mu: wp.array[wp.float64],
    excess: wp.array[wp.float64],
    sizes: wp.array[wp.float64],
    corners: wp.array[wp.int32],
    largest_step: wp.float64,
    courant: wp.float64,
    final: wp.float64,
    # Data out:
    moved: wp.array[wp.vec3d],
    steps: wp.array[wp.int32],
):
    """Integrate each particle's path by third-order Runge-Kutta steps (Ralston 1962), each within a part of a triangle.

    The velocity is linear on every triangle, so steps shorter than a triangle resolve it, and particles in calm regions
    take long steps: no particle waits for another.
    """
    v, _compiled_once = wp.tid()
    p = particles[v]
    f = corners[first_corners[v]] // 3
    s = wp.float64(0.0)
    grown = wp.float64(1.0)  # e^s
    count = int(0)
    while s < final and count < MAX_STEPS:
        k1, size, f = velocity_at(p, grown - ONE, f, points, faces, neighbours, field, mu, excess, sizes)
        # The remaining motion falls as e^-s, and the error of a step as its fourth power.
        # Longest step, of the 14 units of time of a path
        longest = wp.min(largest_step * wp.sqrt(wp.sqrt(grown)), wp.float64(2.0))
        step = wp.min(longest, courant * size / wp.max(wp.length(k1), TINY))
        step = wp.min(wp.max(step, SHORTEST_STEP), final - s)
        quarter = wp.exp(QUARTER * step)
        later = grown * quarter * quarter
        # One call for both other stages, not two: it is inlined, and half of the kernel.
        k = k1
        total = TWO_NINTHS * k1
        near = int(f)
        for stage in range(1, 3):
            ahead = HALF * step
            weight = THIRD
            if stage == 2:
                ahead = THREE_QUARTERS * step
                weight = FOUR_NINTHS
                later = later * quarter
            ahead_point = wp.normalize(p + ahead * k)
            k, _, near = velocity_at(
                ahead_point, later - ONE, near, points, faces, neighbours, field, mu, excess, sizes
            )
            total += weight * k
        grown = later * quarter
        p = wp.normalize(p + step * total)
        s += step
        count += 1
    moved[v] = p
    steps[v] = count
