"""Repair does what it reports, gives the origin of vertices and faces, and leaves meshes without defects alone."""

import numpy as np
import pytest
from hypothesis import given, strategies as st

from omtwarp.commands._cli import main
from omtwarp.errors import OmtwarpError
from omtwarp.mesh import shapes
from omtwarp.mesh.read import read_mesh
from omtwarp.mesh.repair import LARGEST_HOLE, Repaired, repair
from omtwarp.mesh.validate import check
from omtwarp.mesh.write import write_mesh
from omtwarp.texturing import PaintedMesh, read_painted_mesh


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


def test_a_face_alone_is_not_filled_with_itself():
    repaired = repair((np.eye(3), [[0, 1, 2]]))
    assert (len(repaired.faces), repaired.actions) == (1, [])
    assert [defect.kind for defect in check(repaired.vertices, repaired.faces)] == ["open-boundary"]
    two = repair((np.vstack([np.eye(3), np.zeros(3)]), [[0, 1, 2], [1, 0, 3]]))
    assert len(two.faces) == 4 and not check(two.vertices, two.faces)


def test_the_largest_component_is_kept():
    v, f = ball()
    small = shapes.icosphere(2)
    vertices = np.concatenate([small.vertices + 4, v])
    faces = np.concatenate([small.faces, f + small.vertex_count])
    repaired = repair(vertices, faces)
    assert_repaired(vertices, faces, repaired)
    actions = ["dropped 80 faces in 1 smaller component", "dropped 42 unused vertices", "dropped 48.6 % of the area"]
    assert repaired.actions == actions
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


def soup_of(v: np.ndarray, f: np.ndarray, jitter: float, seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Give every face corners of its own, each moved by a share of its shortest edge."""
    corners = v[f]
    shortest = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2).min(axis=1)
    shift = np.random.default_rng(seed).uniform(-1, 1, corners.shape) * jitter * shortest[:, None, None]
    return (corners + shift).reshape(-1, 3), np.arange(f.size).reshape(-1, 3)


@pytest.mark.parametrize("jitter", [1e-7, 1e-5])
def test_corners_that_are_nearly_equal_are_merged_by_the_length_of_their_edges(jitter):
    """Edges of a ball drawn out on one side differ by a factor of 100, and each is joined at its own scale."""
    v, f = ball(8)
    v *= np.exp(2.3 * v[:, 2:])
    soup, faces = soup_of(v, f, jitter)
    repaired = repair(soup, faces)
    assert check(repaired.vertices, repaired.faces) == []
    assert (len(repaired.vertices), len(repaired.faces)) == (len(v), len(f))
    assert repaired.actions[0] == f"merged {f.size - len(v)} vertices with one nearer than 0.001 of the edges there"
    np.testing.assert_array_equal(repaired.vertices, soup[repaired.vertex_origin])
    np.testing.assert_array_equal(repaired.face_origin, np.arange(len(f)))


def test_corners_that_are_further_apart_stay():
    v, f = ball()
    soup, faces = soup_of(v, f, 0.05)
    repaired = repair(soup, faces, whole=False)
    assert not any(action.startswith("merged") for action in repaired.actions)


@pytest.mark.parametrize("shift", [1, -1])
def test_faces_that_count_from_another_number_are_refused(shift):
    v, f = ball()
    with pytest.raises(OmtwarpError, match=f"all are one too {'high' if shift > 0 else 'low'}"):
        repair(v, f + shift)
    assert (
        repair(v, np.concatenate([f, [[0, 1, len(v)]]])).actions[0] == "dropped 1 face with a vertex index out of range"
    )


@pytest.mark.parametrize("read", [read_mesh, read_painted_mesh])
def test_an_obj_that_counts_from_zero_is_refused(tmp_path, read):
    v, f = ball()
    rows = ["v " + " ".join(map(repr, row)) for row in v.tolist()] + [f"f {a} {b} {c}" for a, b, c in f.tolist()]
    (tmp_path / "a.obj").write_text("\n".join(rows))
    with pytest.raises(OmtwarpError, match="refers to vertex 0, and OBJ counts vertices from 1"):
        read(tmp_path / "a.obj")


@pytest.mark.parametrize("whole", [True, False])
def test_a_vertex_of_two_fans_is_split_and_fins_go_whatever_the_option(whole):
    """Two balls that share a vertex, with a fin, become two surfaces; a whole one is the larger of them."""
    v, f = ball()
    small = shapes.icosphere(3)
    moved = small.vertices - small.vertices[0] + v[0]
    other = np.where(small.faces == 0, 0, small.faces + len(v) - 1)
    n = len(v) + small.vertex_count - 1
    points = np.concatenate([v, moved[1:], v[:1] * 3])
    faces = np.concatenate([f, other, [[f[3, 1], f[3, 0], n]]])
    assert {defect.kind for defect in check(points, faces)} >= {"non-manifold-vertices", "non-manifold-edges"}
    repaired = repair(points, faces, whole=whole)
    left = [defect.kind for defect in check(repaired.vertices, repaired.faces)]
    assert left == ([] if whole else ["several-components"])
    assert repaired.actions[:2] == [
        "dropped 1 face that hung by an edge of two others",
        "split 1 vertex where the surface touches itself",
    ]
    if whole:
        np.testing.assert_array_equal(repaired.faces[:, 0], f[:, 0])


@pytest.mark.parametrize("damage", ["soup", "jitter", "fin", "flat", "turned"])
def test_a_closed_surface_is_repaired_in_the_same_way_whatever_the_option(damage):
    v, f = ball()
    if damage in ("soup", "jitter"):
        v, f = soup_of(v, f, 1e-6 * (damage == "jitter"))
    elif damage == "fin":
        v, f = np.concatenate([v, v[:1] * 3]), np.concatenate([f, [[f[3, 1], f[3, 0], len(v)]]])
    elif damage == "flat":
        v[f[40, 2]] = (v[f[40, 0]] + v[f[40, 1]]) / 2
    else:
        f[7] = f[7][::-1]
    one, other = repair(v, f), repair(v, f, whole=False)
    assert one.actions == other.actions and len(one.actions)
    np.testing.assert_array_equal(one.vertices, other.vertices)
    np.testing.assert_array_equal(one.faces, other.faces)


def test_how_much_of_the_area_is_gone_is_said():
    """Of two balls of radius 1 and r the smaller has r^2 / (1 + r^2) of the area."""
    v, f = ball(8)
    for radius in (0.05, 0.2, 0.7):
        points, faces = np.concatenate([v, radius * v + 3]), np.concatenate([f, f + len(v)])
        repaired = repair(points, faces)
        expected = radius**2 / (1 + radius**2)
        np.testing.assert_allclose(repaired.loss, expected, rtol=1e-9)
        said = f"dropped {100 * expected:.3g} % of the area"
        assert (repaired.actions[-1] == said) == (expected > 0.01)
    twice = repair(v, np.concatenate([f, f[:100]]))
    assert twice.loss == 0.0


def test_the_loss_is_said_on_standard_error(tmp_path, capsys):
    v, f = ball(8)
    write_mesh(tmp_path / "two.ply", np.concatenate([v, 0.7 * v + 3]), np.concatenate([f, f + len(v)]))
    with pytest.raises(SystemExit) as ended:
        main(["check", str(tmp_path / "two.ply"), "--repair"])
    assert not ended.value.code
    assert "two.ply: dropped 32.9 % of the area" in capsys.readouterr().err


def test_coordinates_and_materials_follow_a_repair_that_merges_nearly_equal_corners():
    v, f = ball(8)
    soup, faces = soup_of(v, f, 1e-5)
    uv = np.random.default_rng(2).random((len(f), 3, 2))
    painted = PaintedMesh(soup, faces, uv)
    repaired = repair(soup, faces)
    moved = painted.on(repaired.vertices, repaired.faces, repaired.face_origin)
    np.testing.assert_array_equal(moved.uv, uv)
