"""Numbering along Hilbert's curve, and maps that do not depend on how the input is numbered."""

import numpy as np
import pytest

import omtwarp
from omtwarp.geometry.space_order import in_space_order, order_along_curve
from omtwarp.mesh import shapes
from omtwarp.mesh.quarter import quarter


def grid(count):
    steps = (np.arange(count) + 0.5) / count
    return np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)


def renumbered(surface, seed):
    """The same surface with vertices, faces and first corners shuffled, and the place of every vertex and face."""
    rng = np.random.default_rng(seed)
    vertices, faces = rng.permutation(surface.vertex_count), rng.permutation(surface.face_count)
    place = np.argsort(vertices)
    turned = (np.arange(3) + rng.integers(0, 3, surface.face_count)[:, None]) % 3
    corners = np.take_along_axis(place[surface.faces[faces]], turned, axis=1)
    return omtwarp.Surface(surface.vertices[vertices], corners), vertices, faces


def test_the_curve_goes_from_cell_to_neighbouring_cell():
    """What defines Hilbert's curve: it visits every cell of a grid, each next to the one before."""
    cells = grid(8)
    order = order_along_curve(np.concatenate([cells, [[0.0] * 3, [1.0] * 3]]))
    order = order[order < len(cells)]
    steps = np.abs(np.diff(8.0 * cells[order], axis=0)).sum(axis=1)
    assert sorted(order) == list(range(len(cells))) and np.allclose(steps, 1.0)


def test_points_in_one_cell_are_ordered_by_coordinates():
    points = np.zeros((6, 3))
    points[:5, 2] = np.array([4.0, 1.0, 3.0, 0.0, 2.0]) * 1e-12
    points[5] = 1.0
    assert order_along_curve(points).tolist() == [3, 1, 4, 2, 0, 5]


def test_equal_and_extreme_points_are_ordered():
    assert order_along_curve(np.ones((4, 3))).tolist() == [0, 1, 2, 3]
    assert sorted(order_along_curve(1e-300 * grid(2))) == list(range(8))


def test_order_holds_the_same_surface():
    surface = shapes.blob(seed=5, sphere=500)
    weighted = surface.with_areas(np.linspace(1.0, 2.0, surface.face_count))
    ordered = in_space_order(weighted)
    again = np.take_along_axis(surface.faces[ordered.face_origin], (np.arange(3) + ordered.turns[:, None]) % 3, axis=1)
    assert np.array_equal(ordered.surface.vertices, surface.vertices[ordered.vertex_origin])
    assert np.array_equal(ordered.vertex_origin[ordered.surface.faces], again)
    np.testing.assert_allclose(ordered.surface.face_areas, weighted.face_areas[ordered.face_origin], rtol=1e-15)
    assert np.array_equal(ordered.surface.origins.vertex_origin, ordered.vertex_origin)
    assert np.shares_memory(in_space_order(surface).vertex_origin, ordered.vertex_origin)  # kept, whatever the measure


def test_neighbours_have_near_numbers():
    surface, _, _ = renumbered(shapes.blob(seed=5, sphere=5_000), seed=1)
    before, after = (np.abs(np.diff(one.edges, axis=1)).mean() for one in (surface, in_space_order(surface).surface))
    assert after < 0.1 * before


def test_parts_of_a_quartered_surface_are_found():
    surface = shapes.blob(seed=6, sphere=320)
    ordered = in_space_order(surface)
    given, other = quarter(surface), quarter(ordered.surface)
    vertices, faces = ordered.of_parts(given)
    np.testing.assert_allclose(other.surface.vertices, given.surface.vertices[vertices], rtol=1e-15)
    corners = np.sort(vertices[other.surface.faces], axis=1)
    assert np.array_equal(corners, np.sort(given.surface.faces[faces], axis=1))


@pytest.mark.parametrize("options", [{}, {"exact": True}, {"refine": "balanced"}, {"method": "moser"}], ids=str)
def test_maps_do_not_depend_on_numbers(options, device):
    """The same bits, whatever the order of vertices, faces and corners in the input."""
    surface = shapes.blob(seed=7, sphere=500)
    other, vertices, faces = renumbered(surface, seed=2)
    first = omtwarp.map_to_sphere(surface, device=device, **options)
    second = omtwarp.map_to_sphere(other, device=device, **options)
    kept = slice(surface.vertex_count)
    assert np.array_equal(second.sphere[kept], first.sphere[kept][vertices])
    assert np.array_equal(second.conformal[kept], first.conformal[kept][vertices])
    if not options.get("exact"):
        assert np.array_equal(second.face_density, first.face_density[faces])
    assert first.certificate.bijective and second.certificate.bijective


def test_exact_maps_hold_the_quartered_input():
    surface = shapes.blob(seed=7, sphere=320)
    found, parts = omtwarp.map_to_sphere(surface, exact=True, device="cpu"), quarter(surface)
    assert np.array_equal(found.vertices, parts.surface.vertices) and np.array_equal(found.faces, parts.surface.faces)
    assert np.array_equal(found.face_origin, parts.parents)
    areas = parts.sum_of_parts(omtwarp.Surface(found.sphere, found.faces).own_areas)
    assert np.abs(areas / areas.sum() * 4 * np.pi / surface.face_areas - 1.0).max() < 0.05  # flat areas, not spherical
    certificate = omtwarp.certify((found.vertices, found.faces), found.sphere, device="cpu")
    assert found.certificate.smallest_face == certificate.smallest_face
    assert found.certificate.smallest_area == pytest.approx(certificate.smallest_area, rel=1e-12)


@pytest.mark.filterwarnings("ignore::omtwarp.OmtwarpWarning")
def test_places_in_messages_are_those_of_the_input():
    """Warnings name vertices and faces by their numbers in the input, wherever the order puts them."""
    surface = shapes.demo_shape(1000)
    other, vertices, faces = renumbered(surface, seed=3)
    first, second = (omtwarp.map_to_sphere(one, device="cpu").report["warnings"] for one in (surface, other))
    places = {"face": faces, "vertex": vertices}
    named = 0
    for one, two in zip(first, second, strict=True):
        assert one["kind"] == two["kind"]
        for what, numbers in places.items():
            if f"{what} {one['where']} " in one["text"]:
                assert numbers[two["where"]] == one["where"] and f"{what} {two['where']} " in two["text"]
                named += 1
    assert named
