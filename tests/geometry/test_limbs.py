"""How many vertices a ring around a limb needs, and how many it has."""

import numpy as np
import pytest
from hypothesis import given, strategies as st

from omtwarp.geometry.limbs import rings, thinnest_ring, vertices_needed
from omtwarp.mapping.pipeline import map_to_sphere
from omtwarp.mesh.shapes import flip_edges, icosphere, tube


@given(st.integers(0, 2**32 - 1), st.floats(0.01, 2.0))
def test_three_points_of_the_sphere_span_at_least_a_quarter_of_their_edges_product(seed, spread):
    """No triangle of three points of the sphere is smaller than the bound, which is reached on great circles."""
    rng = np.random.default_rng(seed)
    points = rng.normal(size=3) + spread * rng.normal(size=(3, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    for bound_reached in (False, True):
        if bound_reached:
            angle = spread * rng.random(3)
            points = np.stack([np.cos(angle), np.sin(angle), np.zeros(3)], axis=1)
        a, b, c = points
        product = np.prod([np.linalg.norm(edge) for edge in (a - b, b - c, c - a)])
        area = 0.5 * np.linalg.norm(np.cross(b - a, c - a))
        assert area >= 0.25 * product - 1e-12
        if bound_reached:
            assert area == pytest.approx(0.25 * product, abs=1e-12)


@pytest.mark.parametrize(("share", "faces"), [(0.5, 2000), (0.1, 8112), (0.02, 60000)])
def test_with_the_vertices_needed_a_ring_of_flat_triangles_has_the_mean_area(share, faces):
    """Apexes halfway along the edges of a parallel, on the great circle through their ends: their area is 4π / F."""
    needed = vertices_needed(share, faces)
    chord = 2.0 * np.sin(np.pi * np.sqrt(share * (1.0 - share)) * 2.0 / needed)  # arcs as long as the parallel's
    half = 2.0 * np.arcsin(chord / 2.0) / 2.0
    points = np.array([[np.cos(x), np.sin(x), 0.0] for x in (-half, 0.0, half)])
    area = 0.5 * np.linalg.norm(np.cross(points[1] - points[0], points[2] - points[0]))
    assert area == pytest.approx(4.0 * np.pi / faces, rel=0.05)  # of small arcs: an arc is longer than its chord


def test_rings_of_a_regular_tube_have_about_its_segments():
    surface = tube(10.0, face_count=2000)
    segments = np.bincount(surface.faces.ravel()).max()  # around an end of the tube
    found = np.array([(ring.around, ring.share) for ring in rings(surface)])
    middle = found[(found[:, 1] > 0.15) & (found[:, 1] < 0.85), 0]
    assert (middle >= segments).all() and (middle <= 1.25 * segments).all()  # lines of equal distance lie askew
    assert (np.diff(found[:, 1]) < 0).all()


def test_a_sphere_has_vertices_to_spare():
    ring = thinnest_ring(icosphere(3))
    assert ring.around > 2.0 * vertices_needed(ring.share, icosphere(3).face_count)


def test_tubes_with_vertices_to_spare_keep_area():
    """Regular and irregular tubes keep their areas where rings have 1.5 times the vertices needed."""
    surface = flip_edges(tube(4.0, face_count=1200), rounds=4, seed=1)
    ring = thinnest_ring(surface)
    judged = map_to_sphere(surface, device="cpu").distortion()
    assert ring.around > 1.5 * vertices_needed(ring.share, surface.face_count)
    # Of the triangles, where the map keeps the areas around vertices.
    assert judged.area["surface"] <= 2.02
