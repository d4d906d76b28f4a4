"""Files of every kind give their own vertices and faces in their own order, or say in one line why not."""

import gzip

import numpy as np
import pytest
import trimesh

from omtwarp.errors import OmtwarpError
from omtwarp.mesh import shapes
from omtwarp.mesh.read import read_mesh
from omtwarp.mesh.validate import check
from omtwarp.texturing import read_painted_mesh

BALL = shapes.shuffled(shapes.icosphere(3), seed=1)
CUBE = [[0, 3, 2, 1], [4, 5, 6, 7], [0, 1, 5, 4], [2, 3, 7, 6], [1, 2, 6, 5], [0, 4, 7, 3]]
CUBE_VERTICES = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]]


def as_trimesh() -> trimesh.Trimesh:
    return trimesh.Trimesh(BALL.vertices, BALL.faces, process=False)


@pytest.mark.parametrize("suffix", ["ply", "obj", "off", "glb"])
def test_order_is_kept(tmp_path, suffix):
    path = tmp_path / f"ball.{suffix}"
    as_trimesh().export(path)
    mesh = read_mesh(path)
    np.testing.assert_allclose(mesh.vertices, BALL.vertices, atol=1e-6)
    np.testing.assert_array_equal(mesh.faces, BALL.faces)
    assert mesh.vertices.dtype == np.float64 and mesh.faces.dtype == np.int64 and mesh.notes == ()


def test_capital_suffix_and_npz(tmp_path):
    np.savez(tmp_path / "ball.npz", vertices=BALL.vertices, faces=BALL.faces, sphere=BALL.vertices)
    np.testing.assert_array_equal(read_mesh(tmp_path / "ball.npz").vertices, BALL.vertices)
    as_trimesh().export(tmp_path / "ball.ply")
    (tmp_path / "ball.ply").rename(tmp_path / "BALL.PLY")
    np.testing.assert_array_equal(read_mesh(tmp_path / "BALL.PLY").faces, BALL.faces)


def test_stl_corners_become_vertices_in_order(tmp_path):
    as_trimesh().export(tmp_path / "ball.stl")
    mesh = read_mesh(tmp_path / "ball.stl")
    assert check(mesh.vertices, mesh.faces) == []
    np.testing.assert_allclose(mesh.vertices[mesh.faces], BALL.vertices[BALL.faces], atol=1e-6)
    first_seen = np.unique(mesh.faces.ravel(), return_index=True)[1]
    assert (np.diff(first_seen) > 0).all()
    assert mesh.notes == ("STL stores no shared vertices: 540 corners became 92 vertices where equal",)


def test_obj_with_texture_normals_and_groups_is_not_split(tmp_path):
    """An OBJ with seams, materials, groups, comments and negative indices gives the same mesh as one without."""
    rng = np.random.default_rng(0)
    lines = ["mtllib none.mtl", "o thing"]
    lines += [f"v {x!r} {y!r} {z!r}" for x, y, z in BALL.vertices.tolist()] + ["v 5 5 5  # in no face"]
    lines += [f"vt {u:g} {w:g}" for u, w in rng.random((50, 2))] + ["vn 0 0 1"]
    for number, face in enumerate(BALL.faces + 1):
        if number % 40 == 0:
            lines += [f"g part{number}", f"usemtl m{number % 3}"]
        if number % 2:
            face = face - 94
        a, b, c = (f"{vertex}/{rng.integers(1, 51)}/1" for vertex in face)
        lines.append(f"f {a} {b} \\\n {c}" if number % 7 == 0 else f"f {a} {b} {c}")
    (tmp_path / "ball.obj").write_text("\n".join(lines))
    mesh = read_mesh(tmp_path / "ball.obj")
    np.testing.assert_array_equal(mesh.vertices[:-1], BALL.vertices)
    np.testing.assert_array_equal(mesh.faces, BALL.faces)
    assert [defect.kind for defect in check(mesh.vertices, mesh.faces)] == ["unused-vertices"]


def ply(vertices, polygons, extra: str = "", per_vertex: str = "") -> str:
    head = f"ply\nformat ascii 1.0\nelement vertex {len(vertices)}\n"
    head += f"property double x\nproperty double y\nproperty double z\n{extra}"
    head += f"element face {len(polygons)}\nproperty list uchar int vertex_indices\nend_header\n"
    rows = [" ".join(map(repr, map(float, v))) + per_vertex for v in vertices]
    return head + "\n".join(rows + [" ".join(map(str, [len(p), *p])) for p in polygons]) + "\n"


def obj(vertices, polygons) -> str:
    rows = ["v " + " ".join(map(repr, map(float, v))) for v in vertices]
    return "\n".join(rows + ["f " + " ".join(str(i + 1) for i in p) for p in polygons]) + "\n"


def off(vertices, polygons) -> str:
    rows = [" ".join(map(repr, map(float, v))) for v in vertices]
    return f"OFF\n{len(vertices)} {len(polygons)} 0\n" + "\n".join(
        rows + [" ".join(map(str, [len(p), *p])) for p in polygons]
    )


def test_ply_with_texture_coordinates_is_not_split(tmp_path):
    text = ply(BALL.vertices, BALL.faces.tolist(), "property float s\nproperty float t\n", " 0.5 0.25")
    (tmp_path / "ball.ply").write_text(text)
    mesh = read_mesh(tmp_path / "ball.ply")
    np.testing.assert_array_equal(mesh.vertices, BALL.vertices)
    np.testing.assert_array_equal(mesh.faces, BALL.faces)


@pytest.mark.parametrize("write", [ply, obj, off])
def test_polygons_are_cut_with_a_note(tmp_path, write):
    path = tmp_path / f"cube.{write.__name__}"
    path.write_text(write(CUBE_VERTICES, CUBE))
    mesh = read_mesh(path)
    assert check(mesh.vertices, mesh.faces) == [] and len(mesh.faces) == 12
    assert mesh.notes == ("cut 6 faces with more than three corners into triangles",)


@pytest.mark.parametrize("write", [ply, obj, off])
def test_a_single_pentagon_among_triangles_is_found(tmp_path, write):
    """A pyramid's one pentagon among triangles is found and triangulated."""
    angle = 2 * np.pi * np.arange(5) / 5
    vertices = [*np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1).tolist(), [0.0, 0.0, 1.0]]
    polygons = [[k, (k + 1) % 5, 5] for k in range(5)] + [[4, 3, 2, 1, 0]]
    path = tmp_path / f"pyramid.{write.__name__}"
    path.write_text(write(vertices, polygons))
    mesh = read_mesh(path)
    assert check(mesh.vertices, mesh.faces) == [] and len(mesh.faces) == 8
    assert mesh.notes == ("cut 1 face with more than three corners into triangles",)


@pytest.mark.parametrize(
    ("polygons", "words"),
    [([[0, 3, 2], [0, 2, 1], *CUBE[1:]], "cut 5 faces"), ([*CUBE, [0, 1, 2], [4, 5, 6, 7, 3]], "cut 7 faces")],
)
def test_binary_ply_with_mixed_polygons_is_not_read_as_nonsense(tmp_path, polygons, words):
    """A body of mixed polygons as long as one of quads alone is not read as quads."""
    head = "ply\nformat binary_little_endian 1.0\nelement vertex 8\n"
    head += "property float x\nproperty float y\nproperty float z\n"
    head += f"element face {len(polygons)}\nproperty list uchar int vertex_indices\nend_header\n"
    body = np.array(CUBE_VERTICES, "<f4").tobytes()
    body += b"".join(bytes([len(p)]) + np.array(p, "<i4").tobytes() for p in polygons)
    (tmp_path / "cube.ply").write_bytes(head.encode() + body)
    mesh = read_mesh(tmp_path / "cube.ply")
    assert mesh.notes[0].startswith(words)
    fans = [[polygon[0], *polygon[k : k + 2]] for polygon in polygons for k in range(1, len(polygon) - 1)]
    np.testing.assert_array_equal(mesh.faces, fans)


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("missing.ply", None, "no such file"),
        ("empty.ply", b"", "an empty file"),
        ("noise.ply", b"these are no polygons\n" * 5, "cannot be read as ply"),
        ("cut.ply", b"ply\nformat binary_little_endian 1.0\nelement vertex 9\n", "cannot be read as ply"),
        ("cut.off", b"OFF\n9 9 0\n1 2 3\n", "cut short: 9 vertices and 9 faces announced, 1 lines there"),
        ("noise.stl", b"\x00\x01" * 300, "stl"),
        ("noise.glb", b"\x00\x01" * 300, "cannot be read as glb"),
        ("noise.off", b"OFF\nthree four five\n", "cannot be read as off"),
        ("noise.npz", b"PK but not really", "no .npz"),
        ("words.obj", b"v a b c\nf 1 2 3\n", "damaged: vertex 0 has 'a b c'"),
        ("points.obj", b"v 0 0 0\nv 1 0 0\n", "no faces in it"),
        ("line.obj", b"v 0 0 0\nv 1 0 0\nf 1 2\n", "face 0 has fewer than three corners"),
        ("points.ply", ply(CUBE_VERTICES, []).encode(), "not a triangle mesh"),
        ("mesh.xyz", b"0 0 0\n1 1 1\n", "unknown format '.xyz'"),
        ("mesh.other", b"OTHER", "unknown format '.other': known are"),
        ("mesh", b"nothing", "unknown format"),
        ("brain.gii", b"<not gifti>", "cannot be read as gii"),
    ],
)
def test_unreadable_files_say_why_in_one_line(tmp_path, name, content, words):
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(OmtwarpError) as caught:
        mesh = read_mesh(tmp_path / name)
        assert not check(mesh.vertices, mesh.faces)
    assert words in str(caught.value) and str(tmp_path / name) in str(caught.value)
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 400


SQUARE = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"
FACET = "solid\nfacet\nouter loop\nvertex 0 0 0\nvertex 1 {} 0\nvertex 0 1 0\nendloop\nendfacet\nendsolid\n"


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("a.obj", SQUARE[:-3], "cut short: vertex 2 has 2 of its three coordinates"),
        ("a.obj", SQUARE.replace("1 0 0", "1 x 0") + "f 1 2 3\n", "damaged: vertex 1 has '1 x 0', not numbers alone"),
        ("a.obj", "v 0 0\nv 1 0\nv 0 1\nf 1 2 3\n", "cut short: vertex 0 has 2 of its three coordinates"),
        ("a.obj", SQUARE + "f 1 2 3\nf 1 y/4 3/5\n", "damaged: face 1 has '1 y 3', not whole numbers alone"),
        ("a.off", "OFF\n3 1 0\n0 0 0\n1 x 0\n0 1 0\n3 0 1 2\n", "damaged: vertex 1 has '1 x 0', not numbers alone"),
        ("a.off", "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1\n3 0 1 2\n", "cut short: vertex 2 has 2 of its three"),
        ("a.stl", FACET.format("x"), "damaged: vertex 1 has '1 x 0', not numbers alone"),
        ("a.stl", FACET.format(""), "cut short: vertex 1 has 2 of its three coordinates"),
    ],
)
@pytest.mark.parametrize("read", [read_mesh, read_painted_mesh])
def test_a_text_says_which_vertex_or_face_is_damaged(tmp_path, read, name, content, words):
    (tmp_path / name).write_text(content)
    with pytest.raises(OmtwarpError) as caught:
        read(tmp_path / name)
    assert str(caught.value).startswith(f"{tmp_path / name}: {words}")


def test_a_directory_is_not_a_mesh(tmp_path):
    with pytest.raises(OmtwarpError, match="a directory, not a mesh file"):
        read_mesh(tmp_path)


def test_arrays_that_are_missing_in_npz_are_named(tmp_path):
    np.savez(tmp_path / "other.npz", points=BALL.vertices)
    with pytest.raises(OmtwarpError, match="no arrays 'vertices' and 'faces'"):
        read_mesh(tmp_path / "other.npz")


def test_indices_out_of_range_are_left_for_the_check(tmp_path):
    for write in (ply, obj, off):
        path = tmp_path / f"bad.{write.__name__}"
        path.write_text(write(CUBE_VERTICES, [[0, 1, 2], [0, 2, 17]]))
        mesh = read_mesh(path)
        assert check(mesh.vertices, mesh.faces)[0].kind == "index-out-of-range"


def test_several_geometries_are_refused_and_taken_together_on_request(tmp_path):
    scene = trimesh.Scene({"one": as_trimesh(), "two": as_trimesh().apply_translation([5, 0, 0])})
    scene.export(tmp_path / "two.glb")
    with pytest.raises(OmtwarpError, match=r"2 geometries in one scene \(one, two\)"):
        read_mesh(tmp_path / "two.glb")
    mesh = read_mesh(tmp_path / "two.glb", together=True)
    assert len(mesh.vertices) == 184 and mesh.notes == ("took 2 geometries together",)


def test_a_scene_puts_its_mesh_where_it_says(tmp_path):
    scene = trimesh.Scene()
    matrix = trimesh.transformations.translation_matrix([1, 2, 3])
    scene.add_geometry(as_trimesh(), transform=matrix)
    scene.export(tmp_path / "moved.glb")
    np.testing.assert_allclose(read_mesh(tmp_path / "moved.glb").vertices, BALL.vertices + [1, 2, 3], atol=1e-5)


def test_brain_surfaces(tmp_path):
    """GIFTI, plain and compressed, and FreeSurfer's format under its usual name give the same surface."""
    nibabel = pytest.importorskip("nibabel")
    arrays = [
        nibabel.gifti.GiftiDataArray(BALL.vertices.astype(np.float32), intent="NIFTI_INTENT_POINTSET"),
        nibabel.gifti.GiftiDataArray(BALL.faces.astype(np.int32), intent="NIFTI_INTENT_TRIANGLE"),
    ]
    nibabel.save(nibabel.gifti.GiftiImage(darrays=arrays), tmp_path / "lh.white.gii")
    (tmp_path / "lh.gii.gz").write_bytes(gzip.compress((tmp_path / "lh.white.gii").read_bytes()))
    nibabel.freesurfer.write_geometry(tmp_path / "lh.white", BALL.vertices, BALL.faces)
    for name in ("lh.white.gii", "lh.gii.gz", "lh.white"):
        mesh = read_mesh(tmp_path / name)
        np.testing.assert_allclose(mesh.vertices, BALL.vertices, atol=1e-6)
        np.testing.assert_array_equal(mesh.faces, BALL.faces)
