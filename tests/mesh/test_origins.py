"""Data of the input's vertices follow a surface through repair, cuts, splits and quartering, by one record."""

import numpy as np
import pytest
import trimesh

import omtwarp
from omtwarp import OmtwarpError, resample, shapes
from omtwarp.cohort.executors import make_folders
from omtwarp.cohort.host import run_item
from omtwarp.cohort.item import Job
from omtwarp.commands._cli import main
from omtwarp.mesh.origins import Origins
from omtwarp.mesh.quarter import quarter
from omtwarp.mesh.write import write_mesh
from omtwarp.topology.closing import split_chords

BALL = shapes.icosphere(4)


def test_linear_data_stay_linear_where_triangles_are_split_twice():
    """Middles of edges have the mean of the ends, also where an end is itself the middle of another edge."""
    square = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    split = split_chords(square, np.array([[0, 1, 2], [0, 2, 3]]))
    assert np.allclose(split.prolong(square), split.vertices)
    four = quarter(BALL)
    again = quarter(four.surface)
    both = four.compose(again)
    assert np.array_equal(both.face_origin, np.arange(len(again.surface.faces)) // 16)
    assert np.array_equal(four.prolong(BALL.vertices), four.surface.vertices)
    assert np.array_equal(again.prolong(four.prolong(BALL.vertices)), again.surface.vertices)
    assert np.array_equal(both.prolong(BALL.vertices), again.surface.vertices)


def test_labels_in_the_middle_of_an_edge_are_those_of_an_end():
    labels = np.arange(len(BALL.vertices)) * 10
    four = quarter(BALL)
    assert set(four.prolong(labels)) == set(labels)


def test_data_of_another_length_are_returned_as_they_are():
    origins = Origins(np.array([2, 0, -1]), np.array([0]), given=4)
    for length in (3, 5):
        assert np.array_equal(origins.prolong(np.arange(length)), np.arange(length))
    assert np.array_equal(origins.prolong(np.arange(4)), np.arange(4))  # of a new vertex nothing is known


def test_data_return_to_the_surface_they_came_from():
    """The first of a vertex's copies counts, and where it is gone there is no number."""
    four = quarter(BALL)
    assert np.array_equal(four.restrict(four.prolong(BALL.vertices)), BALL.vertices)
    origins = Origins(np.array([2, 0, -1, 2]), np.array([0]), given=4)
    assert np.array_equal(origins.restrict(np.array([5.0, 6.0, 7.0, 8.0])), [6.0, np.nan, 5.0, np.nan], equal_nan=True)
    for values, words in ((np.arange(4), "2 vertices are gone, first vertex 1"), (np.ones(3), "for 4 vertices")):
        with pytest.raises(OmtwarpError, match=words):
            origins.restrict(values)


def test_new_vertices_of_both_steps_get_data():
    """Edges are split, one of their middles is doubled by a cut, and one of their ends comes last in what is kept."""
    split = Origins(np.array([0, 1, 2, -1, -1]), np.array([0]), split_edges=np.array([[0, 1], [1, 2]]), given=3)
    cut = Origins(np.array([3, 4, 0, 2, 1, 3, -1]), np.array([0]), split_edges=np.array([[5, 4]]), given=5)
    values = np.array([0.0, 8.0, 64.0])
    assert np.array_equal(split.compose(cut).prolong(values), [4.0, 36.0, 0.0, 64.0, 8.0, 4.0, 6.0])
    # An end of the second edge is gone, not of the first.
    without = Origins(np.array([0, 1, 3]), np.array([0]), given=5)
    assert np.array_equal(split.compose(without).prolong(values), [0.0, 8.0, 4.0])


def test_data_of_the_input_are_resampled_through_a_quartered_map():
    result = omtwarp.map_to_sphere(BALL, exact=True, optimality=False, device="cpu")
    assert len(result.vertices) > len(BALL.vertices)
    found = resample(result, "ico2", device="cpu")
    assert np.allclose(found.apply(BALL.vertices), found.apply(result.vertices))
    with pytest.raises(OmtwarpError, match="the data have"):
        found.apply(BALL.vertices[1:])


def test_edges_of_vertices_that_are_not_there_are_refused():
    result = omtwarp.map_to_sphere(BALL, until="conformal", device="cpu")
    with pytest.raises(OmtwarpError, match="'split_edges': 162 in row 0 is out of range"):
        result.with_arrays({"split_edges": [[0, 162]]})


def test_data_of_the_file_follow_a_map_to_a_torus(tmp_path):
    ring = trimesh.creation.torus(1.0, 0.4, major_sections=12, minor_sections=6)
    write_mesh(tmp_path / "ring.ply", ring.vertices, ring.faces)
    np.save(tmp_path / "data.npy", ring.vertices[:, 0])
    for line in (
        f"map {tmp_path}/ring.ply -o {tmp_path}/map.npz --torus --exact --quiet --device cpu",
        f"texture --map {tmp_path}/map.npz --bake {tmp_path}/data.npy -o {tmp_path}/out.glb "
        "--size 64 --quiet --device cpu",
    ):
        with pytest.raises(SystemExit) as end:
            main(line.split())
        assert not end.value.code
    result = omtwarp.MapResult.load(tmp_path / "map.npz")
    assert np.array_equal(result.origins.prolong(np.asarray(ring.vertices)), result.vertices)


def test_data_follow_a_repair_that_drops_the_last_vertices():
    vertices = np.concatenate([BALL.vertices, [[9.0, 9.0, 9.0]] * 2])
    repaired = omtwarp.repair(vertices, BALL.faces)
    assert len(repaired.vertices) == len(BALL.vertices)
    assert np.array_equal(repaired.prolong(vertices), repaired.vertices)
    assert np.array_equal(repaired.restrict(repaired.vertices)[:-2], BALL.vertices)


def test_data_of_the_file_follow_a_repaired_mesh(tmp_path, capsys):
    """A vertex that no face uses and one that is doubled are gone after the repair; the data count on."""
    vertices = np.concatenate([[[9.0, 9.0, 9.0]], BALL.vertices, BALL.vertices[:1]])
    faces = BALL.faces + 1
    first = int(np.flatnonzero((faces == 1).any(axis=1))[0])
    faces[first][faces[first] == 1] = len(vertices) - 1
    write_mesh(tmp_path / "broken.ply", vertices, faces)
    np.save(tmp_path / "data.npy", vertices[:, 0])
    for line in (
        f"map {tmp_path}/broken.ply -o {tmp_path}/map.npz --repair --quiet --device cpu",
        f"resample {tmp_path}/map.npz --to ico2 --data {tmp_path}/data.npy -o {tmp_path}/out.npy --quiet",
        f"texture --map {tmp_path}/map.npz --bake {tmp_path}/data.npy -o {tmp_path}/out.glb --quiet --device cpu",
        f"align {tmp_path}/map.npz --to {tmp_path}/map.npz -o {tmp_path}/same.npz --feature {tmp_path}/data.npy "
        f"--to-feature {tmp_path}/data.npy --quiet",
    ):
        with pytest.raises(SystemExit) as end:
            main(line.split())
        assert not end.value.code, capsys.readouterr().err
    result = omtwarp.MapResult.load(tmp_path / "map.npz")
    assert result.report["mesh"]["input_vertices"] == len(vertices) > len(result.vertices)
    assert np.array_equal(result.origins.prolong(vertices), result.vertices)
    make_folders(tmp_path)
    options = {"repair": True, "device": "cpu", "until": "conformal"}
    run_item(Job("broken", str(tmp_path / "broken.ply"), str(tmp_path), "key", options, 60.0))
    of_cohort = omtwarp.MapResult.load(tmp_path / "maps" / "broken.npz")
    assert np.array_equal(of_cohort.origins.prolong(vertices), of_cohort.vertices)
    moved = np.load(tmp_path / "out.npy")
    assert np.allclose(moved, resample(result, "ico2", device="cpu").apply(result.vertices[:, 0]))
