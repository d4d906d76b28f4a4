"""Repair does what it reports, gives the origin of vertices and faces, and leaves meshes without defects alone."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from omtwarp.mesh import shapes
from omtwarp.mesh.repair import LARGEST_HOLE, Repaired, repair
from omtwarp.mesh.validate import check


def ball(frequency: int = 4) -> tuple[np.ndarray, np.ndarray]:
    sphere = shapes.icosphere(frequency)
    return sphere.vertices.copy(), sphere.faces.astype(np.int64)


def assert_repaired(given_vertices: np.ndarray, given_faces: np.ndarray, repaired: Repaired) -> None:
    """Assert that no defect remains and that the origins lead back to the input."""
    assert [str(defect) for defect in check(repaired.vertices, repaired.faces)] == []
    np.testing.assert_array_equal(repaired.vertices, given_vertices[repaired.vertex_origin])
    old = repaired.face_origin >= 0
    was = given_vertices[given_faces[repaired.face_origin[old]]]
    now = repaired.vertices[repaired.faces[old]]
    np.testing.assert_allclose(np.sort(was, axis=1), np.sort(now, axis=1), rtol=1e-6, atol=0)


def test_a_sound_mesh_comes_back_as_it_is():
    v, f = ball()
    repaired = repair(v, f)
    assert repaired.actions == []
    np.testing.assert_array_equal(repaired.vertices, v)
    np.testing.assert_array_equal(repaired.faces, f)
    np.testing.assert_array_equal(repaired.vertex_origin, np.arange(len(v)))
    np.testing.assert_array_equal(repaired.face_origin, np.arange(len(f)))


@pytest.mark.parametrize("scale", [1e-30, 1.0, 1e30])
def test_a_soup_of_triangles_is_merged_at_any_scale(scale):
    v, f = ball()
    soup = v[f].reshape(-1, 3) * scale
    faces = np.arange(len(soup)).reshape(-1, 3)
    repaired = repair(soup, faces)
    assert_repaired(soup, faces, repaired)
    assert len(repaired.vertices) == len(v)
    assert repaired.actions[0] == "merged 798 vertices with an equal one"


def test_equal_vertices_of_a_sound_mesh_stay_apart():
    """Two vertices at one position, where parts of a sound surface touch, are not merged."""
    v, f = ball()
    top, bottom = int(np.argmax(v[:, 2])), int(np.argmin(v[:, 2]))
    v[top] = v[bottom] = 0.0
    assert repair(v, f).actions == []


def test_faces_turned_at_random_agree_again_and_outward():
    v, f = ball()
    g = f.copy()
    turned = np.random.default_rng(1).random(len(f)) < 0.4
    g[turned] = g[turned][:, ::-1]
    repaired = repair(v, g)
    assert_repaired(v, g, repaired)
    assert repaired.actions == [f"turned {turned.sum()} faces to agree with the others"]
    inward = repair(v, f[:, ::-1])
    assert inward.actions == ["turned all faces outward"]
    assert_repaired(v, f, inward)


@pytest.mark.parametrize("frequency", [4, 12])
def test_holes_are_filled_without_new_vertices(frequency):
    """Holes of one triangle, of a fan of five and of a cap are filled without a new vertex."""
    v, f = ball(frequency)
    near = (v[f].mean(axis=1) @ np.array([0.0, 0.0, 1.0])) > 0.85
    fan = (f == np.argmin(v[:, 2])).any(axis=1)
    gone = near | fan
    gone[np.flatnonzero(~gone)[0]] = True
    repaired = repair(v, f[~gone])
    assert_repaired(v, f[~gone], repaired)
    assert any(action.startswith("filled 3 holes with") for action in repaired.actions)


def test_a_large_hole_is_left_and_named():
    v, f = ball(20)
    half = v[f].mean(axis=1)[:, 2] < 0
    repaired = repair(v, f[half])
    (defect,) = check(repaired.vertices, repaired.faces)
    assert defect.kind == "open-boundary" and defect.count > LARGEST_HOLE


def test_the_largest_component_is_kept():
    v, f = ball()
    small = shapes.icosphere(2)
    vertices = np.concatenate([small.vertices + 4, v])
    faces = np.concatenate([small.faces, f + small.vertex_count])
    repaired = repair(vertices, faces)
    assert_repaired(vertices, faces, repaired)
    assert repaired.actions == ["dropped 80 faces in 1 smaller component", "dropped 42 unused vertices"]
    assert repaired.vertex_origin[0] == 42 and repaired.face_origin[0] == 80


def test_duplicates_impossible_faces_and_unused_vertices_are_dropped():
    v, f = ball()
    vertices = np.concatenate([v, [[9.0, 9, 9], [np.nan, 0, 0]]])
    bad = [f[5], f[9][[1, 0, 2]], [0, 1, 999], [0, 1, len(v) + 1], [3, 3, 4]]
    faces = np.concatenate([f, bad])
    repaired = repair(vertices, faces)
    assert_repaired(vertices, faces, repaired)
    np.testing.assert_array_equal(repaired.faces, f)
    assert len(repaired.actions) == 5


def test_a_folded_flap_goes_whole():
    """Two faces back to back on an edge of a sound mesh are removed completely."""
    v, f = ball()
    a, b = f[0, 0], f[0, 1]
    vertices = np.concatenate([v, [[2.0, 2, 2]]])
    faces = np.concatenate([f, [[a, b, len(v)], [b, a, len(v)]]])
    repaired = repair(vertices, faces)
    assert_repaired(vertices, faces, repaired)
    np.testing.assert_array_equal(repaired.faces, f)


def test_a_collapsed_edge_is_merged():
    v, f = ball()
    v[f[40, 2]] = v[f[40, 0]]
    repaired = repair(v, f)
    assert_repaired(v, f, repaired)
    assert len(repaired.faces) == len(f) - 2


def test_a_vertex_on_its_opposite_edge_is_flipped_free():
    v, f = ball()
    v[f[40, 2]] = (v[f[40, 0]] + v[f[40, 1]]) / 2
    repaired = repair(v, f)
    assert [defect.kind for defect in check(repaired.vertices, repaired.faces)] == []
    assert repaired.actions == ["flipped the longest edge of 1 face of zero area"]


@given(seed=st.integers(0, 200), share=st.floats(0.0, 0.15))
def test_repair_never_fails_and_repairing_twice_changes_nothing(seed, share):
    """Random damage of every kind: repair gives valid arrays, and a second repair of a repaired mesh is a no-op."""
    rng = np.random.default_rng(seed)
    v, f = ball()
    f = f[rng.random(len(f)) >= share]
    turn = rng.random(len(f)) < share
    f[turn] = f[turn][:, ::-1]
    v[rng.random(len(v)) < share / 10] = np.nan
    f[rng.random(len(f)) < share / 10, 0] = 500
    repaired = repair(v, f)
    assert repaired.faces.min(initial=0) >= 0 and repaired.faces.max(initial=0) < max(1, len(repaired.vertices))
    if not check(repaired.vertices, repaired.faces):
        again = repair(repaired.vertices, repaired.faces)
        assert again.actions == []


def bowl() -> tuple[np.ndarray, np.ndarray]:
    vertices, faces = ball()
    used, kept = np.unique(faces[(vertices[faces, 2] < 0.5).all(axis=1)], return_inverse=True)
    return vertices[used], kept.reshape(-1, 3)


def test_an_open_surface_keeps_its_hole_and_its_parts():
    v, f = bowl()
    both = np.concatenate([v, v + 3.0]), np.concatenate([f, f[:, ::-1] + len(v), [[0, 1, 1]]])
    repaired = repair(*both, whole=False)
    assert {defect.kind for defect in check(repaired.vertices, repaired.faces)} == {
        "open-boundary",
        "several-components",
    }
    np.testing.assert_array_equal(repaired.faces, both[1][:-1])
    whole = repair(*both)
    assert check(whole.vertices, whole.faces) == []


def test_fins_crumbs_and_turned_faces_go_from_an_open_surface():
    v, f = bowl()
    points = np.concatenate([v, v[:1] * 2.0, np.eye(3) + 5.0])
    n = len(v)
    faces = np.concatenate([f, [[f[3, 1], f[3, 0], n]], [[n + 1, n + 2, n + 3]]])
    faces[7] = faces[7][::-1]
    repaired = repair(points, faces, whole=False)
    np.testing.assert_array_equal(repaired.vertices, v)
    np.testing.assert_array_equal(repaired.faces, f)


def test_vertices_where_an_open_surface_touches_itself_are_split():
    v, f = bowl()
    inside = int(np.flatnonzero(np.bincount(f.ravel()) == 6)[0])
    around = np.flatnonzero((f == inside).any(axis=1))
    first = f[around[0]]
    apart = [k for k in around if len(np.intersect1d(f[k], first)) == 1]  # across the vertex
    faces = np.delete(f, [around[0], apart[0]], axis=0)  # two holes that touch there
    assert "non-manifold-vertices" in {defect.kind for defect in check(v, faces)}
    repaired = repair(v, faces, whole=False)
    assert {defect.kind for defect in check(repaired.vertices, repaired.faces)} == {"open-boundary"}
    assert len(repaired.vertices) == len(v) + 1
    np.testing.assert_array_equal(repaired.vertices, v[repaired.vertex_origin])
    np.testing.assert_array_equal(repaired.vertex_origin[repaired.faces], faces)
