"""Curl, dual bound and exact optimum against maps whose optimum is known in closed form."""

import numpy as np
import pytest
from exact_plans import exact_transport
from hypothesis import given, settings, strategies as st

from omtwarp.errors import OmtwarpError
from omtwarp.maps.result import MapResult
from omtwarp.mesh import shapes
from omtwarp.mesh.surface import Surface, triangle_areas
from omtwarp.metrics import dual as problem
from omtwarp.metrics.dual import MapDual
from omtwarp.metrics.optimality import map_optimality, optimality, relative_curl
from omtwarp.metrics.tree_kernels import LONGEST_EDGE, narrow_parts, order_by_halves


def latitude_map(frequency: int, shift: float = 0.6, twist: float = 0.0):
    """A map that moves points along meridians by a monotone function of latitude, then twists them about the axis.

    Without the twist it is optimal: between densities that depend on latitude alone the optimal map is the monotone
    rearrangement in latitude. The twist preserves area and latitude, so that the optimum stays what it was.
    """
    surface = shapes.icosphere(frequency)
    y = surface.vertices / np.linalg.norm(surface.vertices, axis=1)[:, None]
    height, longitude = y[:, 2], np.arctan2(y[:, 1], y[:, 0])
    masses = surface.sum_to_vertices(triangle_areas(y, surface.faces))
    x = place_at(height + shift * (1.0 - height**2) / 2.0, longitude)
    return x, place_at(height, longitude + twist * (1.0 - height**2)), masses, surface.faces


def random_rotation(seed: int) -> np.ndarray:
    q, r = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return q * np.sign(np.linalg.det(q))


def geodesic(x, y):
    return np.arctan2(np.linalg.norm(np.cross(x, y), axis=-1), (x * y).sum(axis=-1))


def test_a_closed_form_optimum_has_neither_curl_nor_gap():
    """The curl goes to zero as the mesh is refined; the gap is that of its own search, on edges of 0.35 and of half."""
    reports = []
    for frequency in (6, 12):
        x, y, masses, faces = latitude_map(frequency)
        reports.append(optimality((y, faces), y, start=x, masses=masses, ascent_steps=0, device="cpu"))
    coarse, fine = reports
    assert fine.relative_curl < coarse.relative_curl / 3 < 1e-3
    assert 0 <= fine.gap < coarse.gap < 2e-7
    assert fine.swapped_edges == 0
    # ∫ d² over the sphere in closed form, by quadrature in z.
    z, w = np.polynomial.legendre.leggauss(200)
    turn = np.arcsin(z + 0.3 * (1 - z * z)) - np.arcsin(z)
    assert fine.cost == pytest.approx(2 * np.pi * w @ turn**2, rel=2e-3)


def place_at(height, longitude):
    radius = np.sqrt(np.maximum(1.0 - height * height, 0.0))
    return np.stack([radius * np.cos(longitude), radius * np.sin(longitude), height], axis=1)


def test_a_twist_shows_as_curl_and_its_cost_as_the_gap():
    """A twisted map, which costs 7 % more than the optimum, has a gap of 7 %."""
    x, y, masses, faces = latitude_map(12)
    best = optimality((y, faces), y, start=x, masses=masses, ascent_steps=0, device="cpu")
    _, twisted, _, _ = latitude_map(12, twist=0.1)
    report = optimality((y, faces), twisted, start=x, masses=masses, device="cpu")
    assert report.relative_curl > 0.2
    assert report.lower_bound <= best.cost * (1 + 3e-4)  # the same problem with the twisted points for quadrature
    assert report.gap == pytest.approx(report.cost / best.cost - 1.0, rel=0.02)
    assert report.gap > 0.06


def test_the_direction_of_a_move_along_meridians_is_a_gradient():
    """It is the gradient of latitude, however far points move; that of a twisted map is not."""

    def curl(rings, twist=0.0):
        x, y, _, faces = latitude_map(rings, twist=twist)
        return relative_curl((y, faces), y, start=x, cost="geodesic", device="cpu")

    assert curl(16) < curl(8) / 2 < 0.02
    assert curl(12, twist=0.1) > 0.2


@pytest.mark.parametrize("twist", [0.02, 0.2])
def test_curl_grows_with_the_twist(twist):
    """relative_curl alone agrees with the report, and is proportional to a small twist."""
    x, y, masses, faces = latitude_map(10, twist=twist)
    value = relative_curl((y, faces), y, start=x, device="cpu")
    report = optimality((y, faces), y, start=x, masses=masses, ascent_steps=0, device="cpu")
    assert value == pytest.approx(report.relative_curl, rel=1e-9)
    # d² splits into the move along meridians and the twist, at right angles to first order.
    height = y[:, 2]
    along = np.arcsin(height + 0.3 * (1 - height**2)) - np.arcsin(height)
    across = twist * (1 - height**2) ** 1.5
    expected = np.sqrt(masses @ across**2 / (masses @ (along**2 + across**2)))
    assert value == pytest.approx(expected, rel=0.1)


def potential_at(dual, potential, b, triangles):
    """Return ψ at barycentric coordinates, shape [..., 3], of triangles, shape [...]."""
    quadratic, mean, bend = (term.numpy()[triangles] for term in dual.edge_terms)
    nodal = potential[dual.surface.faces[triangles]]
    after = np.roll(b, -1, axis=-1)
    inner = mean - np.roll(nodal, -1, axis=-1) + nodal + (b - after) * bend
    return (b * nodal + b * after * (quadratic + (b - after) * inner)).sum(axis=-1)


def lattice_minimum(dual, x, y, potential, divisions):
    """Return the least c(x_i, z) - ψ(z) over a lattice of points z in every triangle, by exhaustive search."""
    steps = [(i, j) for i in range(divisions + 1) for j in range(divisions + 1 - i)]
    b = np.array([[divisions - i - j, i, j] for i, j in steps]) / divisions
    faces = dual.surface.faces
    z = np.einsum("lk,fkd->fld", b, y[faces])
    z /= np.linalg.norm(z, axis=2)[:, :, None]
    psi = potential_at(dual, potential, b[None], np.arange(len(faces))[:, None])
    everything = 0.5 * geodesic(x[:, None, None, :], z[None]) ** 2 - psi[None]
    return everything.reshape(len(x), -1).min(axis=1)


@pytest.mark.parametrize("roughness", [0.0, 0.003, 0.3])
def test_the_minimum_is_found_over_the_whole_sphere(roughness, monkeypatch):
    """Branch and bound finds what a search through 2 or 91 points in every triangle finds, rough potentials too."""
    x, y, masses, faces = latitude_map(4, twist=0.3)
    rng = np.random.default_rng(1)
    surface = Surface(y, faces)
    monkeypatch.setattr(problem, "TOLERANCE", 0.0)
    dual = MapDual(surface, x, y, masses, "cpu")
    potential = dual.initial_potential()[0] + roughness * rng.normal(size=len(y))
    found = dual.bound(potential)
    transform = dual.cost - potential - found.vertex_gap
    # At corners and middles of edges the bound is a theorem.
    assert (transform <= lattice_minimum(dual, x, y, potential, 2) + 1e-12).all()
    # In between it holds to third order in the edge length, and the lattice is the coarser search of the two.
    missed = transform - lattice_minimum(dual, x, y, potential, 12)
    assert missed.max() < (1e-4 if roughness < 0.1 else 2e-3)  # of edges 0.35 long
    assert missed.mean() <= 0.0
    # And it is attained: at the point reported, or at the vertex' own image.
    face = np.maximum(found.face, 0)
    here, w = faces[face], found.weights
    point = np.einsum("vk,vkd->vd", w, y[here])
    value = potential_at(dual, potential, w, face)
    with np.errstate(invalid="ignore"):
        point /= np.linalg.norm(point, axis=1)[:, None]
        attained = 0.5 * geodesic(x, point) ** 2 - value
    np.testing.assert_allclose(transform, np.where(found.face >= 0, attained, dual.cost - potential), atol=1e-12)
    # With a tolerance no more than that is conceded.
    monkeypatch.setattr(problem, "TOLERANCE", 0.02)
    loose = MapDual(surface, x, y, masses, "cpu")
    quick = loose.bound(potential)
    conceded = quick.vertex_gap - found.vertex_gap
    assert conceded.min() >= -1e-12 and conceded.max() <= loose.tolerance + 1e-12


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 10_000), rough=st.floats(0.0, 0.3), spread=st.floats(0.0, 0.3))
def test_the_minimum_is_found_over_all_of_a_torus(seed, rough, spread):
    """An exhaustive search through copies of 45 points in every triangle finds nothing lower, and the least there."""
    rng = np.random.default_rng(seed)
    side, count = 2.0, 6
    lattice = np.array([[side, 0.0, 0.0], [0.3 * side, side, 0.0]])
    i, j = (k.ravel() for k in np.meshgrid(np.arange(count), np.arange(count), indexing="ij"))
    y = np.column_stack([i, j]) / count @ lattice
    number = lambda i, j: (i % count) * count + j % count  # noqa: E731
    ends = [[(i, j), (i + 1, j), (i + 1, j + 1)], [(i, j), (i + 1, j + 1), (i, j + 1)]]
    faces = np.concatenate([np.column_stack([number(*corner) for corner in face]) for face in ends]).astype(np.int32)
    wraps = [np.stack([np.column_stack(corner) // count for corner in face], axis=1) for face in ends]
    shift = np.concatenate(wraps) @ lattice
    x = y + spread * rng.normal(size=y.shape) * [1.0, 1.0, 0.0]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(problem, "TOLERANCE", 0.0)
        dual = MapDual(Surface(y, faces), x, y, np.ones(len(y)), "cpu", shift, lattice)
        potential = rough * rng.normal(size=len(y))
        transform = dual.cost - potential - dual.bound(potential).vertex_gap
    steps = [(8 - a - b, a, b) for a in range(9) for b in range(9 - a)]
    b = np.array(steps) / 8
    psi = potential[faces] @ b.T + dual.edge_terms[0].numpy() @ (b * np.roll(b, -1, axis=1)).T
    corners = y[faces] + shift
    copies = [(m, n) for m in range(-3, 4) for n in range(-3, 4)] @ lattice
    z = (b @ corners)[None] + copies[:, None, None]
    least = np.array([(0.5 * ((own - z) ** 2).sum(axis=-1) - psi).min() for own in x])
    found = np.minimum(least, dual.cost - potential)
    assert (transform <= found + 1e-12).all()
    assert (found - transform).max() < 0.02


def fan(count, tilt=0.0):
    """The sphere of a bipyramid over a polygon, its tips moved towards each other by an angle."""
    turn = 2.0 * np.pi * np.arange(count) / count
    tips = [[np.sin(tilt), 0.0, np.cos(tilt)], [np.sin(tilt), 0.0, -np.cos(tilt)]]
    points = np.concatenate([np.column_stack([np.cos(turn), np.sin(turn), 0.0 * turn]), tips])
    one, other = np.arange(count), (np.arange(count) + 1) % count
    ends = np.full(count, count)
    upper, lower = np.column_stack([one, other, ends]), np.column_stack([other, one, ends + 1])
    return points, np.concatenate([upper, lower]).astype(np.int32)


@settings(max_examples=25, deadline=None)
@given(count=st.integers(3, 40), tilt=st.floats(0.0, 1.2), seed=st.integers(0, 10_000), rough=st.floats(0.0, 2.0))
def test_triangles_of_any_width_are_bounded(count, tilt, seed, rough):
    """Parts tile their triangles, and no sample of any part has a value below what the search through them proves."""
    y, faces = fan(count, tilt)
    triangles, corners = narrow_parts(y, faces)
    np.testing.assert_allclose(np.bincount(triangles, np.linalg.det(corners)), 1.0, atol=1e-12)
    assert np.linalg.det(corners).min() > 0.0 and corners.min() > -1e-15
    places = corners @ y[faces[triangles]]
    places /= np.linalg.norm(places, axis=2)[:, :, None]
    assert geodesic(places, np.roll(places, -1, axis=1)).max() <= LONGEST_EDGE + 1e-12
    rng = np.random.default_rng(seed)
    x = y + 0.5 * rng.normal(size=y.shape)
    x /= np.linalg.norm(x, axis=1)[:, None]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(problem, "TOLERANCE", 0.0)
        dual = MapDual(Surface(y, faces), x, y, np.ones(len(y)), "cpu")
        potential = rough * rng.normal(size=len(y))
        transform = dual.cost - potential - dual.bound(potential).vertex_gap
    samples = np.einsum("sk,pkj->psj", np.concatenate([np.eye(3), 0.5 * (1.0 - np.eye(3))]), corners)
    here = faces[triangles]
    z = samples @ y[here]
    z /= np.linalg.norm(z, axis=2)[:, :, None]
    psi = potential_at(dual, potential, samples, triangles[:, None])
    least = (0.5 * geodesic(x[:, None, None, :], z[None]) ** 2 - psi[None]).reshape(len(x), -1).min(axis=1)
    assert (transform <= np.minimum(least, dual.cost - potential) + 1e-12).all()


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10_000), count=st.integers(1, 70) | st.sampled_from((8, 32, 64)))
def test_halves_of_the_order_in_space_are_apart(seed, count):
    """The children of every full node are apart: along the longest side where all nodes are full."""
    points = np.random.default_rng(seed).normal(size=(count, 3))
    order = order_by_halves(points)
    assert sorted(order) == list(range(count))
    size, full = 2, count & (count - 1) == 0
    while size <= count:
        for first in range(0, count - size + 1, size):
            one, other = points[order[first : first + size // 2]], points[order[first + size // 2 : first + size]]
            between = other.min(axis=0) - one.max(axis=0)
            assert between.max() >= 0.0
            if full:
                assert between[np.ptp(points[order[first : first + size]], axis=0).argmax()] >= 0.0
        size *= 2


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 10_000), noise=st.floats(0.0, 0.5), spread=st.floats(0.0, 2.0))
def test_the_bound_never_exceeds_the_exact_optimum(seed, noise, spread):
    """Any points, any masses, any map: lower bound <= exact optimum between the same points <= cost."""
    rng = np.random.default_rng(seed)
    surface = shapes.icosphere(3)
    y = surface.vertices / np.linalg.norm(surface.vertices, axis=1)[:, None]
    x = y @ random_rotation(seed).T if seed % 2 else y
    x = x + noise * rng.normal(size=y.shape)
    x /= np.linalg.norm(x, axis=1)[:, None]
    masses = np.exp(spread * rng.normal(size=len(y)))
    given = None if seed % 3 else noise * rng.normal(size=len(y))
    report = optimality(surface, y, start=x, masses=masses, potential=given, ascent_steps=2, device="cpu")
    exact, _ = exact_transport(x, masses, y, masses)
    assert report.lower_bound <= exact * (1 + 1e-9) + 1e-12
    assert exact <= report.cost * (1 + 1e-9) + 1e-12
    assert (report.vertex_gap >= -1e-13).all()


@pytest.mark.parametrize("angle", [0.5, 1.5, 3.0, np.pi])
def test_points_that_are_far_apart_get_no_bound_that_is_wrong(angle):
    """A sphere turned as a whole, where a potential fitted to the displacement says little or nothing."""
    surface = shapes.blob(seed=3, sphere=shapes.icosphere_near(320))
    turned = surface.vertices @ [[np.cos(angle), np.sin(angle), 0], [-np.sin(angle), np.cos(angle), 0], [0, 0, 1]]
    turned, start = (points / np.linalg.norm(points, axis=1, keepdims=True) for points in (turned, surface.vertices))
    found = optimality(surface, turned, start=start, device="cpu")
    masses = surface.vertex_areas
    exact, _ = exact_transport(start, masses, turned, masses)
    assert 0.0 <= found.lower_bound <= exact
    assert found.gap == pytest.approx(found.cost / found.lower_bound - 1.0 if found.lower_bound else np.inf)
    assert found.relative_curl > 0.2


def test_the_identity_is_optimal():
    """The identity has no cost, no gap and no curl."""
    surface = shapes.icosphere(4)
    y = surface.vertices / np.linalg.norm(surface.vertices, axis=1)[:, None]
    report = optimality(surface, y, start=y, device="cpu")
    assert (report.cost, report.gap, report.relative_curl) == (0.0, 0.0, 0.0)


def test_rotations_of_the_sphere_do_not_matter():
    """A rotation of the sphere changes no figure, and a second call gives the same bits."""
    x, y, masses, faces = latitude_map(6, twist=0.05)
    mesh = (y, faces)
    first = optimality(mesh, y, start=x, masses=masses, device="cpu").to_dict()
    assert first == optimality(mesh, y, start=x, masses=masses, device="cpu").to_dict()
    turn = random_rotation(7)
    second = optimality(mesh, y @ turn.T, start=x @ turn.T, masses=masses, device="cpu").to_dict()
    for name in ("relative_curl", "cost", "lower_bound"):
        assert second[name] == pytest.approx(first[name], rel=1e-3)


def golden_spiral(count):
    """Return points with equal shares of the sphere, independent of any mesh."""
    k = np.arange(count) + 0.5
    height, turn = 1.0 - 2.0 * k / count, np.pi * (1.0 + np.sqrt(5.0)) * k
    radius = np.sqrt(1.0 - height**2)
    return np.stack([radius * np.cos(turn), radius * np.sin(turn), height], axis=1)


def sampled_optimum(x, y, faces, face_masses, samples):
    """A map's cost beside the exact optimum from its triangles' middles to equal masses on a golden spiral.

    The middle of a triangle stands for its mass spread out to second order. The optimum is :func:`exact_transport`'s
    second number, since spreading each triangle's mass over many targets is no part of a map's cost.
    """
    sources, images = (p[faces].mean(axis=1) for p in (x, y))
    sources /= np.linalg.norm(sources, axis=1)[:, None]
    images /= np.linalg.norm(images, axis=1)[:, None]
    _, optimum = exact_transport(sources, face_masses, golden_spiral(samples), np.ones(samples))
    return 4.0 * np.pi * float(face_masses @ geodesic(sources, images) ** 2) / face_masses.sum(), optimum


@pytest.mark.parametrize("shift", [0.6, 0.9])
def test_the_exact_optimum_against_a_sphere_sampled_independently(shift):
    """POT's optimum on an independent sampling of the sphere agrees with the closed form within 2 %."""
    x, y, _, faces = latitude_map(6, shift)
    cost, optimum = sampled_optimum(x, y, faces, triangle_areas(y, faces), 2 * len(faces))
    assert optimum == pytest.approx(cost, rel=0.02)


def test_a_twist_costs_more_than_the_sampled_optimum():
    """A twisted map costs 7 % more than the optimum of an independent sampling."""
    x, y, _, faces = latitude_map(6, twist=0.1)
    cost, optimum = sampled_optimum(x, y, faces, triangle_areas(y, faces), 2 * len(faces))
    assert cost / optimum - 1.0 == pytest.approx(0.07, abs=0.02)


def test_exact_transport_undoes_a_permutation():
    """The plan between points and the same points in another order is the permutation, at no cost."""
    points = latitude_map(3)[1]
    order = np.random.default_rng(0).permutation(len(points))
    total, mean = exact_transport(points, np.ones(len(points)), points[order], np.ones(len(points)))
    assert total == pytest.approx(0.0, abs=1e-12) and mean == pytest.approx(0.0, abs=1e-12)


def test_errors_say_what_is_wrong():
    """Unusable maps, masses and potentials are refused, each in one line."""
    x, y, masses, faces = latitude_map(2)
    mesh = (y, faces)
    with pytest.raises(OmtwarpError, match=r"the start: shape \[41, 3\], not \[42, 3\]"):
        optimality(mesh, y, start=x[:-1])
    with pytest.raises(OmtwarpError, match="masses must be positive"):
        optimality(mesh, y, start=x, masses=0 * masses)
    with pytest.raises(OmtwarpError, match="numbers that are not finite"):
        optimality(mesh, y, start=x, potential=np.full(len(y), np.nan))
    with pytest.raises(OmtwarpError, match="no stage 'moser'"):
        map_optimality(MapResult(x, faces, y, x, masses), "moser")


def test_of_a_map_with_and_without_masses_are_one():
    """Three ways to call the report agree, and the bounds with and without the masses agree where areas are kept."""
    x, y, masses, faces = latitude_map(8)
    surface = Surface(y, faces)
    of_surface = optimality(surface, y, start=x, device="cpu")
    with_masses = optimality((y, faces), y, start=x, masses=2.0 * surface.vertex_areas, device="cpu")
    of_map = map_optimality(MapResult(y, faces, y, x, masses), device="cpu")
    for name, value in of_surface.to_dict().items():
        assert getattr(with_masses, name) == pytest.approx(value, rel=1e-9, abs=1e-12)
        assert getattr(of_map, name) == pytest.approx(value, rel=1e-9, abs=1e-12)


def test_cells_of_the_mesh_against_ever_finer_samplings_of_the_sphere():
    """POT's plan from the mesh's cells converges to the map's cost, and costs more than the bound says."""
    x, y, _, faces = latitude_map(5)
    masses = Surface(y, faces).vertex_areas
    report = optimality((y, faces), y, start=x, masses=masses, device="cpu")
    excess = []
    for samples in (1000, 4000):
        total, mean = exact_transport(x, masses, golden_spiral(samples), np.ones(samples))
        # Spreading the mass of a cell over it adds the variance of a hexagon of that area.
        hexagons = 4.0 * np.pi / len(x) * 5.0 / (18.0 * np.sqrt(3.0)) * 4.0 * np.pi
        assert total - mean == pytest.approx(hexagons, rel=0.1)
        assert total > report.lower_bound
        excess.append(mean / report.cost - 1.0)
    assert 0.0 < excess[1] < excess[0] / 2 and excess[1] < 5e-3
