"""Closed genus-0 shapes made from formulas, for demonstrations, tests and benchmarks.

Every function returns a :class:`~omtwarp.mesh.surface.Surface` that passes :func:`omtwarp.mesh.validate.check`:
closed, of genus 0, oriented outward, without triangles of zero area. The same arguments give the same mesh; what is
random takes an explicit seed.
"""

from collections.abc import Callable
from itertools import product

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import ArrayLike, NDArray

from omtwarp.errors import OmtwarpError
from omtwarp.mesh import arrays
from omtwarp.mesh.arrays import TINY, Floats, cross, normalised, norms, real_number, real_numbers, whole_number
from omtwarp.mesh.polygons import grid_shares, grid_triangles
from omtwarp.mesh.surface import Surface, as_triangles

Faces = NDArray[np.int64]

_TETRAHEDRON = normalised([[1, 1, 1], [-1, -1, 1], [-1, 1, -1], [1, -1, -1]])  # four corners of a cube
GOLDEN_ANGLE = np.pi * (3.0 - np.sqrt(5.0))


# Spheres, and what is made by moving their vertices -----------------------------------------------------------------


def icosphere(frequency: int = 16) -> Surface:
    """Return a geodesic sphere: an icosahedron's faces cut into ``frequency``² triangles each, on the unit sphere.


    Args:
        frequency: any whole number from 1; the mesh has 20 ``frequency``² faces and 10 ``frequency``² + 2 vertices.
    """
    frequency = whole_number(frequency, "frequency", least=1)
    corners, big_faces = _icosahedron()
    shares = grid_shares(frequency)
    points = np.einsum("pk,fkx->fpx", shares, corners[big_faces]).reshape(-1, 3)
    faces = (grid_triangles(frequency) + (np.arange(20) * len(shares))[:, None, None]).reshape(-1, 3)

    # A grid point is known by its weights at the twelve corners of the icosahedron: exact, so shared edges weld.
    weights = np.rint(shares * frequency).astype(np.int64)
    held = weights[None] > 0
    owner = np.where(held, big_faces[:, None, :], 12)
    order = np.argsort(owner, axis=2)
    owner = np.take_along_axis(owner, order, axis=2).reshape(-1, 3)
    share = np.take_along_axis(np.broadcast_to(weights[None], held.shape), order, axis=2).reshape(-1, 3)
    keys = np.concatenate([owner, np.where(owner < 12, share, 0)], axis=1)
    _, first, inverse = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    return Surface(normalised(points[first]), inverse.reshape(-1)[faces])


def icosphere_near(face_count: int) -> Surface:
    """Return the geodesic sphere whose number of faces is nearest to the one asked for."""
    return icosphere(max(1, round(np.sqrt(_size(face_count, "face_count") / 20))))


def sphere_from_directions(directions: ArrayLike) -> Surface:
    """Return the Delaunay triangulation of points on the unit sphere: the faces of their convex hull.

    Args:
        directions: unit vectors that surround the centre, all different, shape [V, 3].

    Returns:
        The sphere, with the vertices in the order given and 2 V - 4 faces.
    """
    from scipy.spatial import ConvexHull, QhullError

    points = real_numbers(directions, "directions", (None, 3))
    try:
        hull = ConvexHull(points)
    except (ValueError, QhullError):  # fewer than four, or all in a plane
        raise OmtwarpError("directions: must be points that surround the centre, four or more") from None
    faces = hull.simplices.astype(np.int64)
    p0, p1, p2 = points.take(faces.T, axis=0)
    inward = np.einsum("ij,ij->i", cross(p1 - p0, p2 - p0), hull.equations[:, :3]) < 0
    faces[inward] = faces[inward][:, ::-1]
    # Every face begins at its smallest vertex, and faces are sorted: their order does not depend on a library.
    faces = np.take_along_axis(faces, (np.arange(3)[None] + faces.argmin(axis=1)[:, None]) % 3, axis=1)
    return Surface(points, faces[np.lexsort(faces.T[::-1])])


def fibonacci_sphere(face_count: int = 5000) -> Surface:
    """Return a sphere with exactly as many faces as asked for, its vertices spread evenly along a golden spiral.

    Args:
        face_count: any even number from 4 on.
    """
    count = whole_number(face_count, "face_count", least=4) // 2 + 2
    index = np.arange(count) + 0.5
    z = 1.0 - 2.0 * index / count
    radius, turn = np.sqrt(1.0 - z * z), GOLDEN_ANGLE * index
    return sphere_from_directions(np.stack([radius * np.cos(turn), radius * np.sin(turn), z], axis=1))


def random_sphere(face_count: int = 5000, seed: int = 0, clustering: float = 0.0) -> Surface:
    """Return a sphere with random vertices: triangles of every size and shape.

    Args:
        face_count: any even number from 4 on.
        seed: of the random numbers.
        clustering: 0 spreads the vertices uniformly; larger values draw them towards the north pole.
    """
    count = whole_number(face_count, "face_count", least=4) // 2 + 2
    points = normalised(_random(seed).normal(size=(count, 3)))
    points[:4] = _TETRAHEDRON  # which certainly surround the centre
    points[4:, 2] += real_number(clustering, "clustering")
    return sphere_from_directions(normalised(points))


def uv_sphere(rings: int = 32, segments: int = 64) -> Surface:
    """Return a sphere of meridians and parallels; many segments and few rings, or the reverse, give slivers.

    Args:
        rings: parallels between the poles, from 1.
        segments: meridians, from 3.
    """
    rings, segments = whole_number(rings, "rings", least=1), whole_number(segments, "segments", least=3)
    polar = np.pi * np.arange(1, rings + 1) / (rings + 1)
    turn = 2.0 * np.pi * np.arange(segments) / segments
    grid = np.empty((rings, segments, 3))
    circle = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    grid[..., :2] = np.sin(polar)[:, None, None] * circle[None]
    grid[..., 2] = np.cos(polar)[:, None]
    return Surface(*_capped_grid(grid, np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, -1.0])))


def ellipsoid(axes: tuple[float, float, float] = (1.0, 0.7, 0.5), face_count: int = 5120) -> Surface:
    """Return an ellipsoid with the given half axes."""
    sphere = icosphere_near(face_count)
    return Surface(sphere.vertices * real_numbers(axes, "axes", (3,), positive=True), sphere.faces)


def needle(length: float = 20.0, face_count: int = 5120) -> Surface:
    """Return an ellipsoid of revolution ``length`` times as long as it is thick."""
    return ellipsoid((1.0, 1.0, _size(length, "length")), face_count)


def plate(width: float = 4.0, depth: float = 3.0, thickness: float = 0.2, face_count: int = 5120) -> Surface:
    """Return a thin slab with rounded edges: the superquadric x⁸ + y⁸ + z⁸ = 1, stretched to the sides given."""
    sphere = icosphere_near(face_count)
    radius = (sphere.vertices**8).sum(axis=1) ** (-1 / 8)
    sides = _size(width, "width"), _size(depth, "depth"), _size(thickness, "thickness")
    return Surface(sphere.vertices * radius[:, None] * (np.array(sides) / 2), sphere.faces)


def star_shape(radius: Callable[[Floats], Floats], sphere: Surface | int = 5120) -> Surface:
    """Return a surface that every ray from the centre meets once.

    Args:
        radius: distance from the centre for unit vectors, [V, 3] -> [V], positive.
        sphere: a triangulated unit sphere, or the number of faces of a geodesic one.
    """
    base = sphere if isinstance(sphere, Surface) else icosphere_near(sphere)
    return Surface(base.vertices * _values(radius, base.vertices, "radius", positive=True)[:, None], base.faces)


def blob(seed: int = 0, amplitude: float = 0.35, degree: int = 6, sphere: Surface | int = 5120) -> Surface:
    """Return a star-shaped potato: the logarithm of the radius is a random sum of spherical harmonics up to ``degree``.

    Args:
        seed: of the random numbers.
        amplitude: root mean square of the logarithm of the radius.
        degree: highest degree of the harmonics, from 1; higher ones are wrinklier.
        sphere: a triangulated unit sphere, or the number of faces of a geodesic one.
    """
    rng = _random(seed)
    # A Legendre polynomial of the cosine to a random axis is a harmonic of its degree.
    orders = np.repeat(np.arange(1, whole_number(degree, "degree", least=1) + 1), 3)
    axes = normalised(rng.normal(size=(len(orders), 3)))
    strengths = rng.normal(size=len(orders))

    def logarithm(x: Floats) -> Floats:
        total = np.zeros(len(x))
        for order, axis, strength in zip(orders, axes, strengths, strict=True):
            total += strength * legendre.legval(x @ axis, [0.0] * int(order) + [1.0])
        return total

    reference = logarithm(icosphere(8).vertices)
    scale = real_number(amplitude, "amplitude") / reference.std()
    return star_shape(lambda x: np.exp(scale * (logarithm(x) - reference.mean())), sphere)


def limbs(
    directions: ArrayLike | None = None, length: float = 1.5, sharpness: float = 18.0, sphere: Surface | int = 5120
) -> Surface:
    """Return a ball with limbs: the radius is 1 plus a bump of height ``length`` around every direction.

    Args:
        directions: where the limbs are, shape [N, 3]; four corners of a cube when left out.
        length: height of the limbs over the unit ball.
        sharpness: larger is thinner; a limb's half-width is about 1 / sqrt(sharpness).
        sphere: a triangulated unit sphere, or the number of faces of a geodesic one.
    """
    axes = _TETRAHEDRON if directions is None else normalised(real_numbers(directions, "directions", (None, 3)))
    length, sharpness = real_number(length, "length"), real_number(sharpness, "sharpness")
    return star_shape(lambda x: 1.0 + length * np.exp(sharpness * (x @ axes.T - 1.0)).sum(axis=1), sphere)


# Tubes --------------------------------------------------------------------------------------------------------------


def tube(
    length: float = 6.0, girth: float = 1.0, bend: float = 0.0, taper: float = 1.0, face_count: int = 5000
) -> Surface:
    """Return a capsule, straight or bent along an arc, thinning towards one end: a caudate-like shape.

    Args:
        length: of the centre line between the two caps.
        girth: diameter at the thick end.
        bend: angle of the arc that the centre line runs through, in radians; 0 is straight. The arc's radius,
            ``length / bend``, must be more than half the girth.
        taper: diameter at the other end as a fraction of the girth.
        face_count: roughly how many faces.

    Raises:
        OmtwarpError: a bend so tight that the tube would cut into itself.
    """
    length, radius = _size(length, "length"), _size(girth, "girth") / 2
    bend, taper = real_number(bend, "bend"), real_number(taper, "taper", least=0.0)
    face_count = round(_size(face_count, "face_count"))
    if abs(bend) * radius >= length:
        most = length / radius
        raise OmtwarpError(f"bend: a tube of length {length} and girth {girth} bends by less than {most:.3g} radians")
    total = length + np.pi * radius * (1 + taper) / 2
    segments = max(6, round(np.sqrt(face_count / 2 * np.pi * girth * (1 + taper) / 2 / total)))
    rings = max(4, round(face_count / 2 / segments))
    # Arc length along the outline: a quarter circle, the side, a quarter circle.
    quarter, other = np.pi * radius / 2, np.pi * radius * taper / 2
    along = total * np.arange(1, rings + 1) / (rings + 1)
    front, back = along < quarter, along > quarter + length
    s = np.clip(along - quarter, 0.0, length)
    size = radius + (taper - 1) * radius * s / length
    front_angle, back_angle = along / quarter * np.pi / 2, (total - along) / max(other, TINY) * np.pi / 2
    across = np.where(front, radius * np.sin(front_angle), np.where(back, radius * taper * np.sin(back_angle), size))
    axial = s - front * radius * np.cos(front_angle) + back * radius * taper * np.cos(back_angle)

    turn = 2.0 * np.pi * np.arange(segments) / segments
    x = across[:, None] * np.cos(turn)
    y = across[:, None] * np.sin(turn)
    grid = np.stack([x, y, np.broadcast_to(axial[:, None], x.shape)], axis=2)
    ends = np.array([[0.0, 0.0, -radius], [0.0, 0.0, length + radius * taper]])
    vertices, faces = _capped_grid(grid, ends[1], ends[0], flip=True)
    return Surface(_bend(vertices, bend / length, length), faces)


def hippocampus(
    seed: int = 0, bump: float = 0.0, width: float = 0.5, variation: float = 0.1, face_count: int = 2000
) -> Surface:
    """Return a bent, flattened tube with a thick head and a thin tail, different for every seed.

    The shape is like that of a hippocampus. The centre line is about 4 long and lies in the xz plane, the head at low
    z. Shapes of the same ``face_count`` have the same faces; two that differ in ``bump`` alone are equal elsewhere.

    Args:
        seed: of the random numbers: length, bend and girth, and smooth thickening along the tube.
        bump: how much thicker the tube is at the bump, as a share of its radius there; negative for a dent, above -1.
            It is a little behind the middle of the centre line, on the side (+y).
        width: standard deviation of the bump's bell curve, as a distance on the straight tube of girth 1.
        variation: standard deviation of the random factors; 0 makes all seeds equal.
        face_count: roughly how many faces.

    Raises:
        OmtwarpError: a variation that is negative or above 0.15, from where on tubes might cut into themselves; a bump
            of -1 or less; a width that is not positive.

    Example:
        >>> import numpy as np, omtwarp
        >>> plain, swollen = (omtwarp.shapes.hippocampus(3, bump) for bump in (0.0, 0.5))
        >>> moved = np.linalg.norm(swollen.vertices - plain.vertices, axis=1)
        >>> bool(0.1 < moved.max() < 0.4), bool(np.median(moved) < 0.3 * moved.max())
        (True, True)
    """
    # Diameter of the tail over that of the head, and the angle of the arc in radians.
    hippocampus_taper = 0.45
    hippocampus_bend = 1.8
    bump, width = real_number(bump, "bump", above=-1.0), _size(width, "width")
    if not 0.0 <= real_number(variation, "variation") <= 0.15:
        raise OmtwarpError(f"variation {variation}: use 0 to 0.15")
    length = 3.0
    base = tube(length, girth=1.0, taper=hippocampus_taper, face_count=face_count)
    points = base.vertices
    across, along = points[:, :2], points[:, 2]
    rng = _random(seed)
    stretch, bend, flatness = 1.0 + variation * np.clip(rng.normal(size=3), -2.5, 2.5) * [1.0, 2.0, 0.5]
    # Waves in space are smooth at the ends of the tube too, where angles around it are not.
    waves, phases = rng.normal(size=(6, 3)) * [0.8, 0.8, 1.2], rng.uniform(0.0, 2.0 * np.pi, 6)
    strengths = variation * np.clip(rng.normal(size=6), -2.5, 2.5) / np.sqrt(6 / 2)
    factor = np.exp(np.cos(points @ waves.T + phases) @ strengths)
    share, angle = 0.55, np.radians(90.0)  # from head to tail, and around the centre line from the inside of the bend
    radius = 0.5 + (hippocampus_taper - 1.0) * 0.5 * share
    centre = np.array([radius * np.cos(angle), radius * np.sin(angle), share * length])
    factor *= 1.0 + bump * np.exp(-((points - centre) ** 2).sum(axis=1) / (2.0 * width * width))
    shaped = np.column_stack([across * factor[:, None] * [1.0, 0.8 * flatness], along])
    return Surface(_bend(shaped, hippocampus_bend * bend / length, length) * [1.0, 1.0, stretch], base.faces)


def _bend(points: Floats, curvature: float, length: float) -> Floats:
    """Roll the z axis between 0 and ``length`` onto an arc in the xz plane, straight on beyond its ends."""
    if curvature == 0.0:
        return points
    x, y, z = points.T
    s = np.clip(z, 0.0, length)
    angle, rest = curvature * s, z - s
    radius = 1.0 / curvature - x
    sine, cosine = np.sin(angle), np.cos(angle)
    return np.stack([1.0 / curvature - radius * cosine + rest * sine, y, radius * sine + rest * cosine], axis=1)


# Implicit surfaces --------------------------------------------------------------------------------------------------


def implicit_surface(value: Callable[[Floats], Floats], low: ArrayLike, high: ArrayLike, cell: float) -> Surface:
    """Triangulate the surface value = 0 by marching tetrahedra, then even the triangles out along the surface.

    Args:
        value: negative inside, positive outside and on the box's faces, continuous, [N, 3] -> [N].
        low: smallest coordinates of a box around the surface.
        high: largest coordinates of that box.
        cell: side of the cubes, each cut into six tetrahedra; details smaller than it are lost.

    Returns:
        The surface; its genus is that of the surface value = 0 as the grid sees it.

    Source: A. Doi and A. Koide, An efficient method of triangulating equi-valued surfaces by using tetrahedral cells,
    IEICE Transactions E74 (1991).
    """
    low, high = real_numbers(low, "low", (3,)), real_numbers(high, "high", (3,))
    extent = real_numbers(high - low, "the sides of the box", (3,), positive=True)
    shape = np.ceil(extent / _size(cell, "cell")).astype(np.int64) + 1
    grid = np.stack(np.meshgrid(*(np.arange(n) for n in shape), indexing="ij"), axis=3).reshape(-1, 3)
    nodes = low + cell * grid
    values = _values(value, nodes, "value")
    # A node on the surface would make triangles of no area: one that is nearer than this is moved inside.
    values = np.where(np.abs(values) < 1e-6 * cell, -1e-6 * cell, values)

    edges, faces = crossed_edges((values < 0).reshape(shape))
    a, b = edges.T
    share = (values[a] / (values[a] - values[b]))[:, None]
    share = np.clip(share, 0.02, 0.98)  # keeps the first triangles from being slivers; the surface is met again below
    surface = Surface(nodes[a] + share * (nodes[b] - nodes[a]), faces)
    points = surface.vertices
    # Rounds in which every vertex moves to the middle of its neighbours and back onto the surface.
    for _ in range(8):
        points = _onto_surface(value, _average_of_neighbours(surface, points), cell, steps=1)
    return Surface(_onto_surface(value, points, cell, steps=2), surface.faces)


def rings(count: int = 1, tube: float = 0.35, cell: float = 0.15) -> Surface:
    """Return a chain of round rings that overlap in their tubes, side by side along x.

    The surface has a handle for each.

    Args:
        count: how many, from 1; the genus of the surface.
        tube: radius of the tubes; the rings' middle circles have radius 1.
        cell: side of the grid's cubes, see :func:`implicit_surface`; the number of faces grows as its inverse square.
    """
    centres = 2.0 * np.arange(whole_number(count, "count", least=1))
    tube, cell = _size(tube, "tube"), _size(cell, "cell")

    def value(p: Floats) -> Floats:
        return np.min([np.hypot(np.hypot(p[:, 0] - x, p[:, 1]) - 1.0, p[:, 2]) - tube for x in centres], axis=0)

    reach = 1.0 + tube + 2.0 * cell
    low, high = [-reach, -reach, -tube - 2.0 * cell], [centres[-1] + reach, reach, tube + 2.0 * cell]
    return implicit_surface(value, low, high, cell)


def crossed_edges(inside: NDArray[np.bool_]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Triangulate the surface between grid points inside and outside, with a vertex on every edge that it crosses.

    Args:
        inside: which points are, shape [X, Y, Z].

    Returns:
        The points at both ends of every edge, shape [V, 2], and the triangles, counter-clockwise from outside, [F, 3].
    """
    flat, stride = inside.ravel(), np.array([inside.shape[1] * inside.shape[2], inside.shape[2], 1])
    halves = slice(0, -1), slice(1, None)
    count = sum(inside[part].astype(np.int8) for part in product(halves, repeat=3))
    cubes = np.argwhere((count > 0) & (count < 8)) @ stride
    # Kuhn's six tetrahedra: a path from corner 000 to 111 for every order of the axes; equal in neighbouring cubes.
    orders = np.array([[0, 1, 2], [1, 2, 0], [2, 0, 1], [0, 2, 1], [2, 1, 0], [1, 0, 2]])  # even ones first
    steps = np.concatenate([np.zeros((6, 1), dtype=np.int64), np.cumsum(stride[orders], axis=1)], axis=1)
    steps[3:] = steps[3:, [0, 2, 1, 3]]  # odd orders give the mirrored tetrahedron
    tetrahedra = (cubes[:, None, None] + steps[None]).reshape(-1, 4)
    corners = np.sort(_march(tetrahedra, flat[tetrahedra]), axis=2)
    keys, faces = np.unique(corners[..., 0] * inside.size + corners[..., 1], return_inverse=True)
    return np.stack([keys // inside.size, keys % inside.size], axis=1), faces.reshape(-1, 3)


def _march(tetrahedra: NDArray, inside: NDArray) -> NDArray:
    """Return the faces between inside and outside corners of positively oriented tetrahedra, shape [F, 3, 2]."""
    pieces = []
    # An even permutation that brings each corner to the front, and each pair of corners to the front.
    to_front = np.array([[0, 1, 2, 3], [1, 0, 3, 2], [2, 3, 0, 1], [3, 2, 1, 0]])
    pairs = [[0, 1, 2, 3], [0, 2, 3, 1], [0, 3, 1, 2], [1, 2, 0, 3], [1, 3, 2, 0], [2, 3, 0, 1]]
    for corner in range(4):
        for lone_inside in (True, False):
            chosen = (inside[:, corner] == lone_inside) & (inside.sum(axis=1) == (1 if lone_inside else 3))
            a, b, c, d = tetrahedra[chosen][:, to_front[corner]].T
            edges = [np.stack(e, axis=1) for e in ((a, b), (a, c), (a, d))]
            pieces.append(np.stack(edges if lone_inside else edges[::-1], axis=1))
    for order in pairs:
        chosen = inside[:, order[:2]].all(axis=1) & (inside.sum(axis=1) == 2)
        a, b, c, d = tetrahedra[chosen][:, order].T
        ac, ad, bc, bd = (np.stack(e, axis=1) for e in ((a, c), (a, d), (b, c), (b, d)))
        pieces += [np.stack([ac, ad, bd], axis=1), np.stack([ac, bd, bc], axis=1)]
    return np.concatenate(pieces)


def _average_of_neighbours(surface: Surface, points: Floats) -> Floats:
    """Return the mean position of every vertex's neighbours, shape [V, 3]."""
    flat = surface.faces.ravel()
    following = points[np.roll(surface.faces, -1, axis=1).ravel()]
    degree = np.bincount(flat, minlength=surface.vertex_count)
    # In a closed oriented mesh every neighbour follows a vertex in exactly one face.
    return arrays.summed(following, flat, surface.vertex_count) / degree[:, None]


def _onto_surface(value: Callable[[Floats], Floats], points: Floats, cell: float, steps: int) -> Floats:
    """Run Newton's method along the gradient, with steps of at most half a cell."""
    step = 1e-4 * cell  # the error of one-sided differences is that part of the change of a slope over a cell
    for _ in range(steps):
        here = value(points)
        slope = np.stack([value(points + step * axis) - here for axis in np.eye(3)], axis=1) / step
        # Least slope, squared, of a signed distance, whose slope is 1: where it has none a point stays
        move = -here[:, None] * slope / np.maximum((slope**2).sum(axis=1), 1e-12)[:, None]
        points = points + move * np.minimum(1.0, 0.5 * cell / np.maximum(norms(move), TINY))[:, None]
    return points


def metaballs(spheres: ArrayLike, blend: float = 0.15) -> Callable[[Floats], Floats]:
    """Return the signed distance to a smooth union of cones between balls, negative inside.

    Args:
        spheres: rounded cones, shape [N, 8]: two ends (x, y, z, radius each).
        blend: distance over which two of them melt into each other.
    """
    cones, blend = real_numbers(spheres, "spheres", (None, 8)), _size(blend, "blend")

    def value(x: Floats) -> Floats:
        total = np.zeros(len(x))
        for cone in cones:
            start, radius, end, other = cone[:3], cone[3], cone[4:7], cone[7]
            axis = end - start
            along = np.clip(((x - start) @ axis) / max(float(axis @ axis), TINY), 0.0, 1.0)
            distance = norms(x - start - along[:, None] * axis) - (radius + along * (other - radius))
            total += np.exp(-np.clip(distance / blend, -200.0, 200.0))
        return -blend * np.log(total)

    return value


def demo_shape(face_count: int = 20000) -> Surface:
    """Return a small four-legged creature with a tail, ears and a snout, smooth all over.

    Args:
        face_count: roughly how many faces, from about 2,000; thin parts are thickened when there are few.

    Raises:
        OmtwarpError: there are so few faces that limbs would merge.
    """
    sides = [(x, s) for x in (-0.48, 0.5) for s in (-1.0, 1.0)]
    legs = [[x, 0.3 * s, 0.05, 0.2, x + 0.06, 0.42 * s, -0.72, 0.15] for x, s in sides]
    feet = [[x + 0.06, 0.42 * s, -0.74, 0.15, x + 0.2, 0.45 * s, -0.78, 0.12] for x, s in sides]
    ears = [[0.95, 0.22 * s, 0.98, 0.13, 0.8, 0.46 * s, 1.28, 0.1] for s in (-1.0, 1.0)]
    body = [[-0.5, 0.0, 0.1, 0.46, 0.45, 0.0, 0.14, 0.4]]
    head = [[0.55, 0.0, 0.3, 0.26, 0.95, 0.0, 0.78, 0.24], [0.98, 0.0, 0.8, 0.34, 1.34, 0.0, 0.66, 0.17]]
    tail = [
        [-0.8, 0.0, 0.22, 0.17, -1.2, 0.05, 0.55, 0.12],
        [-1.2, 0.05, 0.55, 0.12, -1.35, 0.15, 0.98, 0.1],
        [-1.35, 0.15, 0.98, 0.1, -1.12, 0.3, 1.28, 0.12],
    ]
    cell = 10.1 / np.sqrt(_size(face_count, "face_count"))
    cones = np.array(body + legs + feet + head + ears + tail)
    cones[:, [3, 7]] = np.maximum(cones[:, [3, 7]], 0.8 * cell)  # thinner than this the grid would cut them off
    value = metaballs(cones, blend=0.05)
    low, high = np.array([-1.75, -0.85, -1.15]), np.array([1.75, 0.85, 1.6])
    surface = implicit_surface(value, low, high, cell=cell)
    if surface.vertex_count - surface.face_count // 2 != 2:  # Euler's formula for a closed surface without handles
        raise OmtwarpError(f"at {face_count} faces the creature's limbs melt into handles: ask for 2,000 or more")
    return surface


# Making good meshes worse -------------------------------------------------------------------------------------------


def noisy(surface: Surface, amount: float = 0.2, seed: int = 0) -> Surface:
    """Move every coordinate by a normal random number times ``amount`` times the mean length of the edges there."""
    rng, surface = _random(seed), Surface(*as_triangles(surface))
    mean = arrays.mean_edge_lengths(surface.vertices, surface.edges)
    amount = real_number(amount, "amount", least=0.0)
    return Surface(surface.vertices + amount * mean[:, None] * rng.normal(size=surface.vertices.shape), surface.faces)


def flip_edges(surface: Surface, rounds: int = 10, seed: int = 0) -> Surface:
    """Flip random edges: the same vertices with obtuse and thin triangles.

    In a round, edges whose two triangles touch no others' are turned into the other diagonal of the two, where that
    leaves at least three neighbours everywhere, no double edge and no triangle that faces backwards.
    """
    rng, surface = _random(seed), Surface(*as_triangles(surface))
    points, faces = surface.vertices, surface.faces.astype(np.int64)
    for _ in range(whole_number(rounds, "rounds")):
        half = np.flatnonzero(faces.ravel() < np.roll(faces, -1, axis=1).ravel())
        other = Surface(points, faces).face_neighbours.ravel()[half].astype(np.int64)
        face, k = half // 3, half % 3
        a, b, c = faces[face, k], faces[face, (k + 1) % 3], faces[face, (k + 2) % 3]
        d = faces[other].sum(axis=1) - a - b
        degree = np.bincount(faces.ravel(), minlength=len(points))
        known = np.sort(faces.ravel() * len(points) + np.roll(faces, -1, axis=1).ravel())
        wanted = c * len(points) + d
        at = np.minimum(np.searchsorted(known, wanted), len(known) - 1)
        old = _normals(points, a, b, c) + _normals(points, a, d, b)
        one, two = _normals(points, c, d, b), _normals(points, c, a, d)
        size = 0.02 * (old**2).sum(axis=1)
        forward = (np.einsum("ij,ij->i", one, old) > size) & (np.einsum("ij,ij->i", two, old) > size)
        allowed = np.flatnonzero((known[at] != wanted) & (degree[a] > 3) & (degree[b] > 3) & forward)
        priority = rng.permutation(len(allowed))
        best = np.full(len(points), -1)
        for vertex in (a, b, c, d):
            np.maximum.at(best, vertex[allowed], priority)
        alone = np.all([best[vertex[allowed]] == priority for vertex in (a, b, c, d)], axis=0)
        chosen = allowed[alone]
        faces[face[chosen]] = np.stack([c, d, b], axis=1)[chosen]
        faces[other[chosen]] = np.stack([c, a, d], axis=1)[chosen]
    return Surface(points, faces)


def shuffled(surface: Surface, seed: int = 0) -> Surface:
    """Reorder the vertices and faces of a surface at random, and begin every face at a random corner."""
    rng, surface = _random(seed), Surface(*as_triangles(surface))
    order = rng.permutation(surface.vertex_count)
    faces = np.argsort(order)[surface.faces[rng.permutation(surface.face_count)]]
    turn = (np.arange(3)[None] + rng.integers(3, size=len(faces))[:, None]) % 3
    return Surface(surface.vertices[order], np.take_along_axis(faces, turn, axis=1))


# Parts --------------------------------------------------------------------------------------------------------------


def _size(value: float, name: str) -> float:
    """Check a positive number."""
    return real_number(value, name, above=0.0)


def _random(seed: int) -> np.random.Generator:
    """Return random numbers.

    Raises:
        OmtwarpError: the seed is none.
    """
    try:
        return np.random.default_rng(seed)
    except (TypeError, ValueError):
        raise OmtwarpError(f"seed: must be a whole number from 0, not {seed!r}") from None


def _values(function: Callable[[Floats], Floats], points: Floats, name: str, positive: bool = False) -> Floats:
    """Return what a function has at points, shape [N].

    Raises:
        OmtwarpError: it is no function, or has no such numbers there.
    """
    if not callable(function):
        raise OmtwarpError(f"{name}: must be a function of points, not a {type(function).__name__}")
    return real_numbers(function(points), name, (len(points),), positive=positive)


def _icosahedron() -> tuple[Floats, Faces]:
    """Return the twelve corners, unit vectors, and twenty outward faces of the regular icosahedron."""
    g = (1 + np.sqrt(5)) / 2
    corners = [[-1, g, 0], [1, g, 0], [-1, -g, 0], [1, -g, 0], [0, -1, g], [0, 1, g]]
    corners += [[0, -1, -g], [0, 1, -g], [g, 0, -1], [g, 0, 1], [-g, 0, -1], [-g, 0, 1]]
    faces = [[0, 11, 5], [0, 5, 1], [0, 1, 7], [0, 7, 10], [0, 10, 11], [1, 5, 9], [5, 11, 4], [11, 10, 2], [10, 7, 6]]
    faces += [[7, 1, 8], [3, 9, 4], [3, 4, 2], [3, 2, 6], [3, 6, 8], [3, 8, 9], [4, 9, 5], [2, 4, 11], [6, 2, 10]]
    faces += [[8, 6, 7], [9, 8, 1]]
    return normalised(np.array(corners, dtype=np.float64)), np.array(faces)


def _capped_grid(grid: Floats, north: Floats, south: Floats, flip: bool = False) -> tuple[Floats, Faces]:
    """Close a grid of rings from north to south, [R, S, 3], with a point at either end; ``flip`` if it runs north."""
    rings, segments = grid.shape[:2]
    index = np.arange(rings * segments).reshape(rings, segments)
    nxt = np.roll(index, -1, axis=1)
    first, last = rings * segments, rings * segments + 1
    parts = [
        np.stack([np.full(segments, first), index[0], nxt[0]], axis=1),
        np.stack([index[:-1], index[1:], nxt[1:]], axis=2).reshape(-1, 3),
        np.stack([index[:-1], nxt[1:], nxt[:-1]], axis=2).reshape(-1, 3),
        np.stack([np.full(segments, last), nxt[-1], index[-1]], axis=1),
    ]
    faces = np.concatenate(parts)
    ends = [south, north] if flip else [north, south]
    return np.concatenate([grid.reshape(-1, 3), ends]), faces[:, ::-1] if flip else faces


def _normals(points: Floats, a: NDArray, b: NDArray, c: NDArray) -> Floats:
    """Return the normals of triangles, whose lengths are twice the triangles' areas."""
    return cross(points[b] - points[a], points[c] - points[a])


def __dir__() -> list[str]:
    own = (name for name, value in globals().items() if getattr(value, "__module__", "") == __name__)
    return [name for name in own if not name.startswith("_")]
