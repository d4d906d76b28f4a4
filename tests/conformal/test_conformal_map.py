"""The conformal map against the sphere, ellipsoids in closed form, and what every conformal map has to be."""

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from sphere_truths import apart, random_rotation, rms, turned

from omtwarp.conformal import conformal_map, density
from omtwarp.geometry import cotangent_laplacian
from omtwarp.mesh.shapes import blob, ellipsoid, icosphere, needle, random_sphere
from omtwarp.mesh.surface import SPHERE_AREA, Surface, triangle_areas
from omtwarp.metrics import measure_triangles


def conformal_latitude(directions: np.ndarray, equator: float, pole: float) -> np.ndarray:
    """Where an ellipsoid of revolution's conformal map to the sphere, equator to equator, sends its points.

    The point is (equator · x, equator · y, pole · z) for a unit vector (x, y, z). Snyder, "Map Projections: A Working
    Manual" (1987), equations 3-1 and 7-7; for a prolate one e is imaginary, and e artanh(e s) is -|e| arctan(|e| s).
    """
    x, y, z = directions.T
    sine = np.sin(np.arctan2(equator * z, pole * np.hypot(x, y)))  # of the geodetic latitude
    square = 1.0 - (pole / equator) ** 2
    e = np.sqrt(abs(square))
    bend = e * np.arctanh(e * sine) if square > 0 else -e * np.arctan(e * sine)
    isometric = np.arctanh(sine) - bend
    longitude = np.arctan2(y, x)
    radius = 1.0 / np.cosh(isometric)
    return np.stack([radius * np.cos(longitude), radius * np.sin(longitude), np.tanh(isometric)], axis=1)


@pytest.mark.parametrize(("equator", "pole"), [(1.0, 1.0), (1.0, 0.6), (1.0, 1.6)], ids=["sphere", "oblate", "prolate"])
def test_ellipsoids_of_revolution_map_by_their_conformal_latitude(device, equator, pole):
    """The dipole of section 4.1 sits on one triangle, so the map is exact to first order in the triangles' size.

    On a triangle of side s the effective dipoles for x and y lie √3 s / 4 apart: that moves points by about a quarter
    of s. Twice that is allowed, and halving s has to halve the error.
    """
    errors = []
    for frequency in (8, 16):
        sphere = turned(icosphere(frequency))
        stretch = np.array([equator, equator, pole])
        surface = Surface(sphere.vertices * stretch, sphere.faces)
        mapped = conformal_map(surface, device=device)
        truth = conformal_latitude(sphere.vertices, equator, pole)
        removed = truth[sphere.faces[mapped.removed_face]]
        side = np.linalg.norm(removed - np.roll(removed, 1, axis=0), axis=1).max()
        error = apart(mapped.sphere, truth)
        assert error.max() < 0.5 * side
        assert rms(error) < 0.25 * side
        errors.append(rms(error))
    assert errors[1] < 0.55 * errors[0]


def test_angles_are_kept_better_on_finer_meshes(device):
    """Quasi-conformal error (angle - 2) is quadratic in the map's error: it falls by four when edges are halved."""
    excess = []
    for faces in (1280, 5120):
        surface = blob(seed=5, amplitude=0.25, degree=4, sphere=faces)
        sphere = conformal_map(surface, device=device).sphere
        excess.append(measure_triangles(surface.vertices, surface.faces, sphere).angle["surface"] - 2.0)
    assert excess[1] < 0.1
    assert excess[1] < excess[0] / 3.0


def test_coordinates_are_harmonic_away_from_the_removed_triangle():
    """D x = a and D y = b: the stereographic image, undone from the sphere, solves both up to a Möbius map.

    Centring is undone by fitting one: the plane coordinates of the paper are a Möbius image of ours, so the test takes
    the solution of the two systems from a dense pseudo-inverse and asks whether cross ratios agree.
    """
    surface = blob(seed=2, amplitude=0.2, degree=3, sphere=320)
    mapped = conformal_map(surface)
    points = surface.scaled_vertices
    a, b, c = (points[k] for k in surface.faces[mapped.removed_face])
    inverse = np.linalg.pinv(cotangent_laplacian(points, surface.faces).toarray())
    # Gradients of the hat functions on the removed triangle, in an orthonormal frame of its plane.
    along = (b - a) / np.linalg.norm(b - a)
    normal = np.cross(b - a, c - a)
    across = np.cross(normal / np.linalg.norm(normal), along)
    flat = np.array([[p @ along, p @ across] for p in (b - a, c - a)])
    slopes = np.linalg.solve(flat, np.array([[-1.0, 1.0, 0.0], [-1.0, 0.0, 1.0]]))
    right = np.zeros((surface.vertex_count, 2))
    right[surface.faces[mapped.removed_face]] = slopes.T
    plane = (inverse @ right) @ np.array([1.0, 1.0j])
    # Ours, from the sphere: stereographic projection from the north pole.
    x, y, z = mapped.sphere.T
    ours = (x + 1.0j * y) / (1.0 - z)

    def cross_ratios(w):
        picks = np.random.default_rng(0).permutation(len(w))[: 4 * (len(w) // 4)].reshape(-1, 4).T
        p, q, r, s = w[picks]
        return (p - q) * (r - s) / ((p - r) * (q - s))

    np.testing.assert_allclose(cross_ratios(ours), cross_ratios(plane), rtol=1e-8)


def test_centred_and_unit(device):
    surface = blob(seed=1, amplitude=0.4, sphere=1280)
    mapped = conformal_map(surface, device=device)
    assert np.linalg.norm(surface.vertex_areas @ mapped.sphere) / SPHERE_AREA < 1e-12
    np.testing.assert_allclose(np.linalg.norm(mapped.sphere, axis=1), 1.0, atol=4e-16)


@settings(max_examples=10)
@given(seed=st.integers(0, 10_000))
def test_total_area_and_total_curvature(seed):
    """Gauss and Bonnet: angle defects of the surface sum to 4π; so does the excess of the image's spherical triangles.

    And μ is a density: the image's area times μ is the surface's area, 4π in all.
    """
    surface = blob(seed=seed, amplitude=0.3, degree=5, sphere=320)
    sphere = conformal_map(surface).sphere
    corners = surface.scaled_vertices[surface.faces]
    ahead, back = (np.roll(corners, shift, axis=1) - corners for shift in (-1, 1))
    angles = np.arctan2(np.linalg.norm(np.cross(ahead, back), axis=2), (ahead * back).sum(axis=2))
    defects = 2.0 * np.pi - np.bincount(surface.faces.ravel(), angles.ravel())
    assert defects.sum() == pytest.approx(SPHERE_AREA, rel=1e-12)

    if measure_triangles(surface.vertices, surface.faces, sphere).flips == 0:
        # Girard: the excess of a spherical triangle is its area; angles between great circles at its corners.
        image = sphere[surface.faces]
        normal = np.cross(image, np.roll(image, -1, axis=1))  # of the edge from corner k to k + 1
        before = -np.roll(normal, 1, axis=1)
        angles = np.arctan2(np.linalg.norm(np.cross(normal, before), axis=2), (normal * before).sum(axis=2))
        assert (angles.sum(axis=1) - np.pi).sum() == pytest.approx(SPHERE_AREA, rel=1e-9)
        np.testing.assert_allclose(np.bincount(surface.faces.ravel(), angles.ravel()), 2.0 * np.pi, rtol=1e-9)

    per_face, per_vertex = density(surface, sphere)
    image_areas = triangle_areas(sphere, surface.faces)
    image_areas *= SPHERE_AREA / image_areas.sum()
    assert per_face @ image_areas == pytest.approx(SPHERE_AREA, rel=1e-12)
    assert per_vertex @ surface.sum_to_vertices(image_areas) / 3.0 == pytest.approx(SPHERE_AREA, rel=1e-12)


def test_density_of_a_sphere_is_one():
    surface = icosphere(4)
    for values in density(Surface(7.5 * surface.vertices + 3.0, surface.faces), surface.vertices):
        np.testing.assert_allclose(values, 1.0, rtol=1e-13)


def test_density_where_the_image_has_no_area_is_infinite():
    surface = icosphere(2)
    image = surface.vertices.copy()
    image[surface.faces[0]] = image[surface.faces[0, 0]]
    per_face, _ = density(surface, image)
    assert np.isinf(per_face[0])
    assert not np.isnan(per_face).any()


def test_position_unit_and_mirror_do_not_matter():
    """Up to a rotation; round-off is amplified by the range of the Green's function, about 1e3 here."""
    surface = blob(seed=1, amplitude=0.35, degree=5, sphere=1280)
    base = conformal_map(surface).sphere
    moved = surface.vertices @ random_rotation(1).T
    moved += [3.0, 4.0, 5.0]
    mirror = np.array([1.0, 1.0, -1.0])
    assert apart(conformal_map(Surface(moved, surface.faces)).sphere, base).max() < 1e-10
    for scale in (1e-30, 1e30):
        assert apart(conformal_map(Surface(scale * surface.vertices, surface.faces)).sphere, base).max() < 1e-10
    reflected = conformal_map(Surface(surface.vertices * mirror, surface.faces[:, ::-1])).sphere
    assert apart(reflected * mirror, base).max() < 1e-10
    power = conformal_map(Surface(2.0**-100 * surface.vertices, surface.faces)).sphere
    np.testing.assert_array_equal(power, base)  # powers of two round nothing


def test_irregular_triangles_do_not_flip_and_slivers_stay_finite():
    """Delaunay triangulations have no negative cotangent weight; a needle's slivers have, and fold the map over."""
    surface = random_sphere(1280, seed=3)
    assert measure_triangles(surface.vertices, surface.faces, conformal_map(surface).sphere).flips == 0
    for surface in (needle(20.0, 1280), ellipsoid((1.0, 0.2, 0.05), 1280)):
        sphere = conformal_map(surface).sphere
        assert np.isfinite(sphere).all()
        degree = measure_triangles(surface.vertices, surface.faces, sphere).degree
        assert degree == pytest.approx(round(degree), abs=1e-6)  # folded or not, the image is closed
