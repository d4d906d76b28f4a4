"""Mirror-symmetric maps of the double of a surface, half of which is a map of the surface to the hemisphere."""

import numpy as np

from omtwarp.errors import OmtwarpError
from omtwarp.flips.exact import is_bijective
from omtwarp.geometry.axes import turned_about_pole
from omtwarp.mesh.arrays import Floats, cross, normalised
from omtwarp.mesh.surface import Surface
from omtwarp.open_surfaces.symmetric import ACROSS, folded_map
from omtwarp.options import Progress
from omtwarp.topology.closing import Double
from omtwarp.untangling.untangle import RepairBudget, untangle


def mirror_frame(double: Double, sphere: Floats, masses: Floats) -> Floats:
    """Find the rotation that brings a nearly symmetric map's plane of symmetry to the equator, the surface north of it.

    Among all planes it is the one whose reflection brings mirror images nearest to each other: the eigenvector of the
    least eigenvalue of sum m (y y'ᵀ + y' yᵀ) for pairs y, y'.

    Args:
        double: the surface and its copy.
        sphere: a map of it, unit vectors, shape [W, 3].
        masses: of the vertices, shape [W].

    Returns:
        A rotation matrix R, shape [3, 3]; ``sphere @ R`` is the turned map.
    """
    paired = (sphere * masses[:, None]).T @ sphere[double.mirror]
    _, vectors = np.linalg.eigh(paired + paired.T)
    surface = ~(double.copied | double.on_boundary)
    north = vectors[:, 0]
    if (masses[surface] * (sphere[surface] @ north)).sum() < 0.0:
        north = -north
    east = vectors[:, 2]
    return np.stack([east, cross(north, east), north], axis=1)


def symmetrised(double: Double, turned: Floats) -> Floats:
    """Make a map exactly symmetric about the equator: average mirror images, and set z = 0 on the boundary.

    Args:
        double: the surface and its copy.
        turned: a map whose plane of symmetry is nearly the equator's, shape [W, 3].
    """
    # The sum of two numbers has the same bits in either order, so that mirror images agree exactly.
    mirrored = turned[double.mirror] * ACROSS
    means = turned + mirrored
    means[double.on_boundary, 2] = 0.0
    return normalised(means)


def is_symmetric(double: Double, sphere: Floats) -> bool:
    """Return whether a map is its own mirror image to the last bit."""
    return bool(np.array_equal(sphere[double.mirror] * ACROSS, sphere))


def symmetric_map(
    double: Double, surface: Surface, sphere: Floats, *, repair: bool = True, device: str | None = "auto"
) -> Floats | None:
    """Make a nearly mirror-symmetric map exactly symmetric and one to one.

    Args:
        double: the surface and its copy.
        surface: the same as a surface.
        sphere: a map of it that lies as :func:`mirror_frame` turns it, shape [W, 3].
        repair: whether flipped triangles may be untangled.
        device: where the repair runs.

    Returns:
        The map; the same array where it is symmetric already; None where none was found.
    """
    if is_symmetric(double, sphere):
        return sphere
    budget, images = RepairBudget(surface), (symmetrised(double, sphere), folded_map(double, sphere))
    rounds = 4 if repair else 0  # of repair; one was enough on every surface tried
    while True:
        for image in images:
            if is_bijective(image, surface.faces, device=device):
                return image
        if rounds == 0:
            return None
        rounds -= 1
        untangled = untangle(surface, symmetrised(double, sphere), budget=budget, device=device).sphere
        if not is_bijective(untangled, surface.faces, device=device):
            return None
        sphere = untangled @ mirror_frame(double, untangled, surface.vertex_areas)
        images = folded_map(double, sphere), symmetrised(double, sphere)


def symmetric_start(
    double: Double, surface: Surface, source: Floats, *, device: str | None = "auto", progress: Progress | None = None
) -> Floats | None:
    """Make a symmetric map without flips from coarse to fine, turned about the axis of the mirror towards another map.

    Args:
        double: the surface and its copy.
        surface: the same as a surface.
        source: a symmetric map of it, flipped triangles and all, shape [W, 3].
        device: where vertices move.
        progress: called as ``progress("start", placed, vertices, {})``.

    Returns:
        The map, shape [W, 3]; None where float64 has no room for one.
    """
    from omtwarp.start.hierarchical import hemispherical_embedding  # its kernels are read for few surfaces

    own = double.half
    faces, areas = surface.faces[: surface.face_count // 2], surface.face_areas[: surface.face_count // 2]
    try:
        half = hemispherical_embedding(surface.scaled_vertices[own], faces, areas, device=device, progress=progress)
    except OmtwarpError:
        return None
    image = np.zeros_like(source)  # of the copy until it gets mirror images
    image[own] = normalised(turned_about_pole(half, source[own], surface.vertex_areas[own]))
    image = folded_map(double, image)
    return image if is_bijective(image, surface.faces, device=device) else None
