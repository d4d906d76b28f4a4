"""Vertices that formats double along seams are joined, and the file's own are found again."""

import json

import numpy as np
import pytest
import trimesh

import omtwarp
from omtwarp.commands._cli import main
from omtwarp.errors import OmtwarpError
from omtwarp.mesh.read import read_joined_mesh, seam_copies


@pytest.fixture
def split(tmp_path):
    """A ball in two materials with coordinates, as GLB has it: two primitives, vertices doubled along seams."""
    ball = omtwarp.shapes.icosphere(5)
    corner = ball.vertices[ball.faces]
    u = np.arctan2(corner[..., 1], corner[..., 0]) / (2 * np.pi) + 0.5
    u = np.where((np.ptp(u, axis=1) > 0.5)[:, None] & (u < 0.5), u + 1.0, u)
    upper = (corner[..., 2].mean(axis=1) > 0).astype(int)
    mesh = omtwarp.PaintedMesh(
        ball.vertices * (1.0, 1.2, 0.9), ball.faces, np.stack([u, 0.5 + 0.5 * corner[..., 2]], axis=2),
        (omtwarp.Material("low", (1, 0, 0, 1)), omtwarp.Material("high", (0, 0, 1, 1))), upper,
    )  # fmt: skip
    mesh.export(tmp_path / "split.glb")
    return mesh, tmp_path


def run(*words):
    with pytest.raises(SystemExit) as ended:
        main([str(word) for word in words])
    return int(ended.value.code or 0)


def test_copies_are_joined_in_the_order_of_the_file(split):
    mesh, folder = split
    joined = read_joined_mesh(folder / "split.glb")
    assert len(joined.vertices) == len(mesh.vertices) < len(joined.file.vertices)
    np.testing.assert_array_equal(joined.vertices[joined.vertex_of_file], joined.file.vertices)
    np.testing.assert_array_equal(joined.vertex_of_file[joined.file.faces], joined.faces)
    np.testing.assert_array_equal(joined.file.vertices[joined.vertex_origin], joined.vertices)
    assert (np.diff(joined.vertex_origin) > 0).all() and omtwarp.check(joined.vertices, joined.faces) == []
    assert "copies of vertices along seams" in joined.notes[-1]


def test_map_keeps_the_vertices_of_the_file(split, capsys):
    mesh, folder = split
    file = folder / "split.glb"
    assert run("check", file, "--json") == 0 and json.loads(capsys.readouterr().out)["mappable"]
    assert run("map", file, "-o", folder / "map.npz", "--until", "conformal", "--device", "cpu") == 0
    assert "joined" in capsys.readouterr().err
    result, joined = omtwarp.MapResult.load(folder / "map.npz"), read_joined_mesh(file)
    np.testing.assert_array_equal(result.vertex_of_file, joined.vertex_of_file)
    np.testing.assert_array_equal(result.vertices[result.vertex_of_file], joined.file.vertices)
    np.testing.assert_array_equal(result.vertex_origin, joined.vertex_origin)
    assert run("map", file, "-o", folder / "ball.ply", "--until", "conformal", "--device", "cpu") == 0
    ball = omtwarp.read_mesh(folder / "ball.ply")
    np.testing.assert_array_equal(ball.faces, joined.file.faces)
    np.testing.assert_allclose(ball.vertices, result.sphere[result.vertex_of_file], atol=1e-12)
    # The mesh in another format and order still fits the map.
    other = omtwarp.PaintedMesh(
        mesh.vertices, mesh.faces[::-1], mesh.uv[::-1], mesh.materials, mesh.face_material[::-1]
    )
    other.export(folder / "other.obj")
    painting = ["--map", folder / "map.npz", "--uv", "own", "--pattern", "checker", "--size", "32", "--device", "cpu"]
    assert run("texture", folder / "other.obj", "-o", folder / "own.glb", *painting) == 0
    painted = omtwarp.read_painted_mesh(folder / "own.glb")
    assert sorted(material.name for material in painted.materials) == ["high", "low"]
    assert all(material.picture is not None for material in painted.materials)


def test_options_that_add_no_vertices_or_add_them_behind_keep_those_of_the_file(split):
    _, folder = split
    file, joined = folder / "split.glb", read_joined_mesh(folder / "split.glb")
    words = ["map", file, "--device", "cpu", "--quiet"]
    assert run(*words, "-o", folder / "ball.ply", "--fill-area", "natural", "--until", "conformal") == 0
    np.testing.assert_array_equal(omtwarp.read_mesh(folder / "ball.ply").faces, joined.file.faces)
    assert run(*words, "-o", folder / "exact.npz", "--exact") == 0
    result = omtwarp.MapResult.load(folder / "exact.npz")
    assert len(result.vertices) > len(joined.file.vertices)
    np.testing.assert_array_equal(result.vertices[result.vertex_of_file], joined.file.vertices)
    assert run(*words, "-o", folder / "exact.ply", "--exact") == 0
    assert len(omtwarp.read_mesh(folder / "exact.ply").vertices) == len(result.vertices)


def test_cuts_of_a_map_are_joined_again_beside_a_hole(tmp_path):
    ring = trimesh.creation.torus(1.0, 0.4, major_sections=16, minor_sections=8)
    holed = ring.faces[(ring.faces != ring.faces[0, 0]).all(axis=1)]
    used, faces = np.unique(holed, return_inverse=True)
    vertices, faces = ring.vertices[used], faces.reshape(-1, 3)
    omtwarp.map_surface((vertices, faces), cut=True, fill_area="small").save(tmp_path / "cut.npz")
    again = read_joined_mesh(tmp_path / "cut.npz")
    assert len(again.file.vertices) > len(vertices)
    np.testing.assert_array_equal(again.vertices, vertices)
    assert any("cut open" in note for note in again.notes)


def test_what_does_not_belong_together_is_left_apart(tmp_path):
    """Two balls of a scene are not joined, nor are copies of vertices in PLY whose joining would leave a hole."""
    ball = omtwarp.shapes.icosphere(2)
    one = trimesh.Trimesh(ball.vertices, ball.faces, process=False)
    other = trimesh.Trimesh(ball.vertices + 5.0, ball.faces, process=False)
    trimesh.Scene([one, other]).export(tmp_path / "two.glb")
    with pytest.raises(OmtwarpError, match="2 geometries in one scene"):
        read_joined_mesh(tmp_path / "two.glb")
    assert seam_copies(ball.vertices, ball.faces) is None
    upper = ball.vertices[ball.faces].mean(axis=1)[:, 2] > 0
    halves = ball.faces[upper], ball.faces[~upper]
    shown = np.concatenate([ball.vertices, ball.vertices])
    apart = np.concatenate([halves[0], halves[1] + len(ball.vertices)])
    trimesh.Trimesh(shown, apart, process=False).export(tmp_path / "closed.ply")
    assert read_joined_mesh(tmp_path / "closed.ply").vertex_of_file is not None
    trimesh.Trimesh(shown, apart[1:], process=False).export(tmp_path / "open.ply")
    assert read_joined_mesh(tmp_path / "open.ply").vertex_of_file is None
