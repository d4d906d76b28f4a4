# mypy: ignore-errors
"""Kernels for the openness of a surface. Single precision: it is an estimate, and ray queries have no other."""

from omtwarp.device.start import KERNEL_OPTIONS, wp

wp.set_module_options(KERNEL_OPTIONS)

# Radians, 1 / 1.3247 (the plastic number): turned by it, no two patterns are near.
TURN = wp.constant(wp.float32(0.7548777))


@wp.func
def open_share(mesh: wp.uint64, origin: wp.vec3, n: wp.vec3, turn: float, rays: int) -> float:
    """Return the share of cosine-weighted rays from a point that meet no surface, their pattern rotated."""
    helper = wp.vec3(1.0, 0.0, 0.0)
    # Of a normal's x: below 1/sqrt(2) the axis is 45 degrees or more from the normal.
    if wp.abs(n[0]) > wp.float32(0.7):
        helper = wp.vec3(0.0, 1.0, 0.0)
    t = wp.normalize(wp.cross(n, helper))
    b = wp.cross(n, t)
    free = int(0)
    for k in range(rays):
        # A spiral over the disc lifted to the hemisphere: cosine-weighted, and the same for every run.
        r = wp.sqrt((float(k) + 0.5) / float(rays))
        # Golden angle, π (3 - sqrt(5)): Vogel's spiral covers a disc evenly
        angle = float(k) * wp.float32(2.3999632) + turn
        up = wp.sqrt(wp.max(1.0 - r * r, 0.0))
        direction = t * (r * wp.cos(angle)) + b * (r * wp.sin(angle)) + n * up
        query = wp.mesh_query_ray(mesh, origin, direction, 4.0)
        if not query.result:
            free += 1
    return float(free) / float(rays)


@wp.kernel
def vertex_openness(
    mesh: wp.uint64,
    origins: wp.array[wp.vec3],
    normals: wp.array[wp.vec3],
    rays: int,
    # Data out:
    openness: wp.array[wp.float32],
):
    """Compute the share of cosine-weighted rays from every vertex that meet no surface."""
    i, _compiled_once = wp.tid()
    openness[i] = open_share(mesh, origins[i], normals[i], float(i) * TURN, rays)
