"""The coarse-to-fine embedding: a bijection on every shape, near the energy's minimum, the same twice."""

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from omtwarp.device.policy import resolve_device
from omtwarp.device.start import wp
from omtwarp.errors import OmtwarpError
from omtwarp.flips.exact import count_flips
from omtwarp.mesh.shapes import (
    blob,
    demo_shape,
    flip_edges,
    icosphere,
    limbs,
    needle,
    noisy,
    plate,
    random_sphere,
    shuffled,
    tube,
    uv_sphere,
)
from omtwarp.mesh.surface import Surface, triangle_areas
from omtwarp.start import hierarchical
from omtwarp.start.decimation import MAX_VALENCE, Vertex
from omtwarp.start.hierarchical import hierarchical_embedding
from omtwarp.start.hierarchical_kernels import insert_vertices, relax_vertices

CPU = resolve_device("cpu")


def stacked_tetrahedra(count, seed):
    """An Apollonian network: vertices put into random faces again and again, the most irregular of triangulations."""
    rng = np.random.default_rng(seed)
    points = [np.array(p, dtype=float) for p in ((1, 1, 1), (-1, -1, 1), (-1, 1, -1), (1, -1, -1))]
    faces = [(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)]
    if np.linalg.det([points[k] for k in faces[0]]) < 0:
        faces = [f[::-1] for f in faces]
    for _ in range(count):
        a, b, c = faces.pop(rng.integers(len(faces)))
        points.append((points[a] + points[b] + points[c]) / 3)
        v = len(points) - 1
        faces += [(a, b, v), (b, c, v), (c, a, v)]
    return Surface(np.array(points), np.array(faces))


def coincident():
    """A sphere a third of whose vertices are one point: triangles without area or shape."""
    sphere = icosphere(8)
    vertices = sphere.vertices.copy()
    vertices[: len(vertices) // 3] = vertices[0]
    surface = Surface(vertices, sphere.faces)
    surface.checked = True  # as if it could be mapped: the embedding needs no shape
    return surface


SHAPES = {
    "tetrahedron": lambda: stacked_tetrahedra(0, 0),
    "double tetrahedron": lambda: stacked_tetrahedra(1, 0),
    "octahedron": lambda: uv_sphere(rings=1, segments=4),
    "sphere": lambda: icosphere(10),
    "random sphere": lambda: random_sphere(2000, seed=1),
    "poles of degree 300": lambda: uv_sphere(rings=3, segments=300),
    "tube of 30 girths": lambda: tube(length=30.0, face_count=3000),
    "bent tapered tube": lambda: tube(length=12.0, bend=2.0, taper=0.2, face_count=2000),
    "needle": lambda: needle(200.0, face_count=1500),
    "plate": lambda: plate(thickness=0.01, face_count=1500),
    "limbs": lambda: limbs(length=4.0, sphere=3000),
    "creature": lambda: demo_shape(3000),
    "noise": lambda: noisy(icosphere(8), 0.8, seed=2),
    "slivers": lambda: flip_edges(blob(1, sphere=1280), rounds=60, seed=3),
    "shuffled": lambda: shuffled(blob(2, sphere=1280), seed=4),
    "stacked tetrahedra": lambda: stacked_tetrahedra(1500, 5),
    "coincident vertices": coincident,
}


def signed_degree(sphere, faces):
    """Sum of signed solid angles over 4 pi (van Oosterom and Strackee)."""
    a, b, c = (sphere[faces[:, k]] for k in range(3))
    triple = np.einsum("ij,ij->i", a, np.cross(b, c))
    dots = 1 + sum(np.einsum("ij,ij->i", u, v) for u, v in ((a, b), (b, c), (c, a)))
    return (2 * np.arctan2(triple, dots)).sum() / (4 * np.pi)


def mean_distortions(surface, sphere):
    """Area D + 1/D and angle s1/s2 + s2/s1, means weighted by area on the surface, from edges' Gram matrices."""
    grams, areas = [], []
    for points in (surface.vertices, sphere):
        p = points * np.sqrt(4 * np.pi / triangle_areas(points, surface.faces).sum())
        u, v = (p[surface.faces[:, k]] - p[surface.faces[:, 0]] for k in (1, 2))
        grams.append([np.einsum("ij,ij->i", a, b) for a, b in ((u, u), (u, v), (v, v))])
        areas.append(triangle_areas(p, surface.faces))
    (e, f, g), (e2, f2, g2) = grams
    ratio = areas[1] / areas[0]
    trace = (g * e2 - 2 * f * f2 + e * g2) / (e * g - f * f)
    weights = areas[0] / areas[0].sum()
    return (weights * (ratio + 1 / ratio)).sum(), (weights * trace / ratio).sum()


def assert_bijective(surface, sphere):
    assert sphere.shape == (surface.vertex_count, 3) and sphere.dtype == np.float64
    np.testing.assert_allclose(np.linalg.norm(sphere, axis=1), 1.0, atol=1e-14)
    assert count_flips(sphere, surface.faces) == 0
    assert signed_degree(sphere, surface.faces) == pytest.approx(1.0, abs=1e-10)


@pytest.mark.parametrize("name", SHAPES)
def test_no_triangle_flips_and_the_sphere_is_covered_once(name):
    """All triangles positive and degree 1: a bijection, whatever the shape and the triangulation."""
    surface = SHAPES[name]()
    sphere = hierarchical_embedding(surface, device="cpu").sphere
    assert_bijective(surface, sphere)


@settings(max_examples=12, deadline=None)
@given(seed=st.integers(0, 2**31 - 1), kind=st.sampled_from(["blob", "noise", "slivers", "stacked", "random", "tube"]))
def test_random_shapes_embed(seed, kind):
    """Random shapes are embedded without a flip, at degree 1."""
    rng = np.random.default_rng(seed)
    surface = {
        "blob": lambda: blob(seed % 10000, amplitude=rng.uniform(0.1, 1.0), degree=8, sphere=1280),
        "noise": lambda: noisy(blob(seed % 10000, sphere=720), rng.uniform(0, 1.5), seed=seed),
        "slivers": lambda: flip_edges(random_sphere(600, seed=seed), rounds=int(rng.integers(1, 80)), seed=seed),
        "stacked": lambda: stacked_tetrahedra(int(rng.integers(1, 400)), seed),
        "random": lambda: random_sphere(600, seed=seed, clustering=rng.uniform(0, 1)),
        "tube": lambda: tube(length=rng.uniform(1, 40), taper=rng.uniform(0.1, 1), face_count=1200),
    }[kind]()
    assert_bijective(surface, hierarchical_embedding(surface, device="cpu").sphere)


def test_a_round_sphere_comes_back_as_itself():
    """The identity has the least energy, and the levels find it: both distortions are 2 to a thousandth."""
    surface = icosphere(16)
    area, angle = mean_distortions(surface, hierarchical_embedding(surface, device="cpu").sphere)
    assert area == pytest.approx(2.0, abs=1e-3) and angle == pytest.approx(2.0, abs=1e-3)


def test_limbs_keep_their_area():
    """A conformal map would shrink these limbs by many decades; here areas stay near the surface's own."""
    surface = limbs(length=4.0, sphere=5120)
    sphere = hierarchical_embedding(surface, device="cpu").sphere
    ratio = triangle_areas(sphere, surface.faces) / surface.face_areas
    assert mean_distortions(surface, sphere)[0] < 2.2
    assert ratio.min() > 0.02


def test_the_weight_trades_area_for_angle():
    """More weight on area gives a lower area distortion and a higher angle distortion."""
    surface = blob(7, amplitude=0.6, sphere=1280)
    pairs = [
        mean_distortions(surface, hierarchical_embedding(surface, area_weight=w, device="cpu").sphere)
        for w in (0.5, 5, 50)
    ]
    areas, angles = np.transpose(pairs)
    assert (np.diff(areas) < 0).all() and (np.diff(angles) > 0).all()


def test_the_same_answer_twice_bit_for_bit():
    """The embedding gives the same bits twice."""
    surface = blob(11, sphere=1280)
    first, second = (hierarchical_embedding(surface, device="cpu").sphere for _ in range(2))
    assert first.tobytes() == second.tobytes()


def test_scale_and_place_of_the_input_do_not_matter():
    """The embedding of a scaled and moved surface is the same."""
    surface = blob(5, sphere=500)
    moved = Surface(surface.vertices * 2.0**-60 + 2.0**-58, surface.faces)
    ours, theirs = (hierarchical_embedding(s, device="cpu").sphere for s in (surface, moved))
    np.testing.assert_allclose(ours, theirs, atol=1e-6)


def test_the_order_of_vertices_and_faces_does_not_matter():
    """Starts of the same shape in another order are the same; by number, collapses led to another embedding."""
    surface = blob(5, amplitude=0.6, sphere=500)
    rng = np.random.default_rng(3)
    order, rows = rng.permutation(surface.vertex_count), rng.permutation(surface.face_count)
    other = Surface(surface.vertices[order], np.argsort(order)[surface.faces][rows])
    ours = hierarchical_embedding(surface, device="cpu").sphere[order]
    theirs = hierarchical_embedding(other, device="cpu").sphere
    turned = theirs @ Rotation.align_vectors(ours, theirs)[0].as_matrix().T
    np.testing.assert_allclose(turned, ours, atol=1e-6)


def test_progress_grows_to_one():
    """Progress is the share of vertices that are placed, and grows to one."""
    heard = []
    hierarchical_embedding(
        icosphere(6), device="cpu", progress=lambda stage, done, total, details: heard.append(done / total)
    )
    assert heard == sorted(heard) and heard[-1] == 1.0


@pytest.mark.parametrize("weight", [0.0, -1.0, np.nan, np.inf])
def test_a_weight_that_is_not_positive_is_refused(weight):
    """A weight that is not positive, for which the energy has no minimum, is refused."""
    with pytest.raises(OmtwarpError, match="weight"):
        hierarchical_embedding(icosphere(2), area_weight=weight, device="cpu")


def test_no_place_for_a_vertex_is_said_plainly(monkeypatch):
    """Where a kernel is too thin for float64 the coarse map is relaxed, a few times, and then the defect is named."""
    monkeypatch.setattr(hierarchical, "_LEAST_DETERMINANT", 2.0)
    with pytest.raises(OmtwarpError, match="found no place for a vertex"):
        hierarchical_embedding(icosphere(3), device="cpu")


def insert(ring):
    """Place one vertex (the last) in a ring of unit vectors; returns its position, colour and least determinant."""
    count = len(ring)
    rings = np.zeros((1, MAX_VALENCE), dtype=np.int32)
    rings[0, :count] = np.arange(count)
    sphere = wp.array(np.vstack([ring, [[0.0, 0.0, 0.0]]]), dtype=wp.vec3d, device=CPU)
    colours = wp.array(np.arange(count + 1) % 2, dtype=wp.int32, device=CPU)
    least = wp.zeros(1, dtype=wp.float64, device=CPU)
    wp.launch(
        insert_vertices,
        dim=1,
        inputs=[
            wp.array([count], dtype=wp.int32, device=CPU),
            wp.array(rings, dtype=wp.int32, device=CPU),
            wp.array([count], dtype=wp.int32, device=CPU),
            wp.full(count + 1, int(Vertex.INSIDE), dtype=wp.int32, device=CPU),
            -1,
            sphere,
            colours,
        ],
        outputs=[least],
        device=CPU,
    )
    return sphere.numpy()[count], colours.numpy()[count], least.numpy()[0]


@pytest.mark.parametrize("count", range(3, MAX_VALENCE + 1))
@pytest.mark.parametrize("radius", [1e-6, 0.5, 1.5])
def test_a_vertex_enters_a_regular_ring_at_its_centre(count, radius):
    """A vertex that enters a regular ring is placed at its centre and gets the first free colour."""
    t = np.arange(count) * 2 * np.pi / count
    ring = np.stack([np.sin(radius) * np.cos(t), np.sin(radius) * np.sin(t), np.full(count, np.cos(radius))], axis=1)
    x, colour, least = insert(ring)
    np.testing.assert_allclose(x, [0, 0, 1], atol=1e-9)
    assert colour == 2
    assert least == pytest.approx(np.linalg.det([x, ring[0], ring[1]]), rel=1e-6)


@pytest.mark.parametrize("seed", range(20))
def test_a_vertex_enters_where_the_kernel_is_widest(seed):
    """No point of a dense sample of the sphere is farther inside all great circles of a star-shaped ring."""
    rng = np.random.default_rng(seed)
    count = int(rng.integers(4, MAX_VALENCE + 1))
    t = np.sort(rng.uniform(0, 2 * np.pi, count - 3))
    t = np.sort(np.concatenate([t, [0.0, 2.1, 4.2]]))
    r = rng.uniform(0.2, 1.3, count)
    ring = np.stack([np.sin(r) * np.cos(t), np.sin(r) * np.sin(t), np.cos(r)], axis=1)
    normals = np.cross(ring, np.roll(ring, -1, axis=0))
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    x, _, _ = insert(ring)
    sample = rng.normal(size=(200000, 3))
    sample /= np.linalg.norm(sample, axis=1)[:, None]
    best = (sample @ normals.T).min(axis=1).max()
    assert (normals @ x).min() > best - 1e-12
    assert (normals @ x).min() > 0


def test_a_relaxed_vertex_stands_at_the_minimum_of_its_energy():
    """The kernel's Newton steps end where a derivative-free search by SciPy ends, from a start far off."""
    rng = np.random.default_rng(3)
    count = 6
    t = np.arange(count) * 2 * np.pi / count + rng.uniform(0, 0.5, count)
    r = rng.uniform(0.3, 0.5, count)
    ring = np.stack([np.sin(r) * np.cos(t), np.sin(r) * np.sin(t), np.cos(r)], axis=1)
    cotangents = rng.uniform(0.2, 1.5, (count, 3))
    areas = rng.uniform(0.02, 0.2, count)
    weight = 3.0

    def energy(plane):
        x = np.array([*plane, 1.0]) / np.linalg.norm([*plane, 1.0])
        a, b = ring, np.roll(ring, -1, axis=0)
        ratio = np.einsum("ij,j->i", np.cross(a, b), x) / 2 / areas
        if (ratio <= 0).any():
            return np.inf
        squares = np.stack([((b - a) ** 2).sum(1), ((x - b) ** 2).sum(1), ((x - a) ** 2).sum(1)], axis=1)
        dirichlet = 0.5 * (cotangents * squares).sum(axis=1)
        return ((dirichlet + weight * areas * (ratio**2 + 1)) / ratio).sum()

    expected = minimize(energy, [0.0, 0.0], method="Nelder-Mead", options={"xatol": 1e-10, "fatol": 1e-14}).x
    start = insert(ring)[0]
    sphere = wp.array(np.vstack([ring, start]), dtype=wp.vec3d, device=CPU)
    slots = wp.array([0], dtype=wp.int32, device=CPU)
    for _ in range(30):
        wp.launch(
            relax_vertices,
            dim=1,
            inputs=[
                slots,
                wp.array([count], dtype=wp.int32, device=CPU),
                wp.array([0, count], dtype=wp.int32, device=CPU),
                wp.array(np.arange(count), dtype=wp.int32, device=CPU),
                wp.array(np.roll(np.arange(count), -1), dtype=wp.int32, device=CPU),
                wp.array(np.hstack([cotangents, areas[:, None]]), dtype=wp.vec4d, device=CPU),
                wp.full(count + 1, int(Vertex.INSIDE), dtype=wp.int32, device=CPU),
                -1,
                weight,
            ],
            outputs=[sphere],
            device=CPU,
        )
    x = sphere.numpy()[count]
    np.testing.assert_allclose(x[:2] / x[2], expected, atol=1e-6)
