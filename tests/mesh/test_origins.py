"""Data of the input's vertices follow a surface through repair, cuts, splits and quartering, by one record."""

import numpy as np
import pytest

import omtwarp
from omtwarp import OmtwarpError, resample, shapes
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
    both = four.origins.compose(again.origins)
    assert np.array_equal(both.face_origin, np.arange(len(again.surface.faces)) // 16)
    assert np.array_equal(four.origins.prolong(BALL.vertices), four.surface.vertices)
    assert np.array_equal(again.origins.prolong(four.origins.prolong(BALL.vertices)), again.surface.vertices)


def test_labels_in_the_middle_of_an_edge_are_those_of_an_end():
    labels = np.arange(len(BALL.vertices)) * 10
    four = quarter(BALL)
    assert set(four.origins.prolong(labels)) == set(labels)


def test_data_of_another_length_are_returned_as_they_are():
    origins = Origins(np.array([2, 0, -1]), np.array([0]), given=4)
    for length in (3, 5):
        assert np.array_equal(origins.prolong(np.arange(length)), np.arange(length))
    assert np.array_equal(origins.prolong(np.arange(4)), np.arange(4))  # of a new vertex nothing is known


def test_data_of_the_input_are_resampled_through_a_quartered_map():
    result = omtwarp.map_to_sphere(BALL, exact=True, optimality=False, device="cpu")
    assert len(result.vertices) > len(BALL.vertices)
    found = resample(result, "ico2", device="cpu")
    assert np.allclose(found.apply(BALL.vertices), found.apply(result.vertices))
    with pytest.raises(OmtwarpError, match="the data have"):
        found.apply(BALL.vertices[1:])


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
    moved = np.load(tmp_path / "out.npy")
    assert np.allclose(moved, resample(result, "ico2", device="cpu").apply(result.vertices[:, 0]))
