"""Meshes keep their texture coordinates, materials and pictures when they are read, and previews show them."""

import json
import re
import warnings
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from PIL import Image
from scipy.spatial import cKDTree
from two_materials import BLUE, RED, two_halves

import omtwarp
from omtwarp.errors import OmtwarpError
from omtwarp.render.subject import painted_view
from omtwarp.texturing import Material, PaintedMesh, read_painted_mesh


def test_obj_keeps_coordinates_and_materials_in_the_order_of_read_mesh(tmp_path):
    path, upper, uv = two_halves(tmp_path, picture=True)
    mesh, plain = read_painted_mesh(path), omtwarp.read_mesh(path)
    np.testing.assert_array_equal(mesh.vertices, plain.vertices)
    np.testing.assert_array_equal(mesh.faces, plain.faces)
    assert [material.name for material in mesh.materials] == ["red", "blue"]
    lower = np.setdiff1d(np.arange(len(uv)), upper)
    np.testing.assert_allclose(mesh.uv, uv[np.concatenate([upper, lower])], atol=1e-15)
    np.testing.assert_array_equal(np.bincount(mesh.face_material), [len(upper), len(lower)])
    red, blue = mesh.materials
    np.testing.assert_allclose(np.array(red.color[:3]) * 255, RED, atol=1e-3)
    assert red.picture is None and blue.picture.shape == (256, 512, 3)


def test_obj_with_polygons_negative_numbers_and_no_material(tmp_path):
    """Fans keep the coordinates of their corners; corners counted backwards are found; the rest is left without."""
    (tmp_path / "a.obj").write_text(
        "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
        "f 1/1 2/2 3/3 4/4\nusemtl x\nf -4/-4 -3/-3 -2/-2\nf 1//1 2//1 3//1\n"
    )
    mesh = read_painted_mesh(tmp_path / "a.obj")
    np.testing.assert_array_equal(mesh.faces, [[0, 1, 2], [0, 2, 3], [0, 1, 2], [0, 1, 2]])
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
    np.testing.assert_array_equal(mesh.uv[:3], corners[mesh.faces[:3]])
    assert np.isnan(mesh.uv[3]).all() and [m.name for m in mesh.materials] == ["material", "x"]


def test_what_is_named_and_missing_is_said(tmp_path):
    (tmp_path / "a.obj").write_text("mtllib gone.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl m\nf 1 2 3\n")
    assert "gone.mtl" in read_painted_mesh(tmp_path / "a.obj").notes[0]
    (tmp_path / "outside.png").write_bytes(b"x")
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "b.obj").write_text("mtllib b.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl m\nf 1 2 3\n")
    (tmp_path / "in" / "b.mtl").write_text("newmtl m\nmap_Kd ../outside.png\n")
    mesh = read_painted_mesh(tmp_path / "in" / "b.obj")
    assert "outside.png" in mesh.notes[0] and mesh.materials[0].picture is None


def test_an_empty_library_has_no_materials_and_is_said(tmp_path):
    path, *_ = two_halves(tmp_path)
    (tmp_path / "two.mtl").write_bytes(b"")
    mesh = read_painted_mesh(path)
    assert mesh.notes == ("the material library 'two.mtl' is empty",)
    assert [material.name for material in mesh.materials] == ["red", "blue"]


def test_glb_of_several_primitives_is_one_closed_mesh(tmp_path):
    """Vertices doubled along the seams of coordinates and materials are joined; colours and factors come back."""
    path, *_ = two_halves(tmp_path, picture=True)
    original = read_painted_mesh(path)
    scene = trimesh.Scene()
    for number, material in enumerate(original.materials):
        of_it = original.face_material == number
        pbr = trimesh.visual.material.PBRMaterial(name=material.name, roughnessFactor=0.3)
        if material.picture is not None:
            pbr.baseColorTexture = Image.fromarray(material.picture)
        corners = original.vertices[original.faces[of_it]].reshape(-1, 3)
        rows, inverse = np.unique(
            np.column_stack([corners, original.uv[of_it].reshape(-1, 2)]), axis=0, return_inverse=True
        )
        visual = trimesh.visual.TextureVisuals(uv=rows[:, 3:], material=pbr)
        scene.add_geometry(trimesh.Trimesh(rows[:, :3], inverse.reshape(-1, 3), visual=visual, process=False))
    scene.export(tmp_path / "two.glb")
    mesh = read_painted_mesh(tmp_path / "two.glb")
    assert len(mesh.materials) == 2 and len(mesh.faces) == len(original.faces)
    assert len(mesh.vertices) == len(original.vertices)
    assert omtwarp.check(mesh.vertices, mesh.faces) == []
    assert "joined" in " ".join(mesh.notes)
    (striped,) = [number for number, material in enumerate(mesh.materials) if material.picture is not None]
    np.testing.assert_array_equal(mesh.face_material == striped, original.face_material == 1)


@pytest.mark.parametrize("per_face", [False, True])
def test_ply_with_coordinates(tmp_path, per_face):
    Image.fromarray(np.full((4, 4, 3), 90, np.uint8)).save(tmp_path / "p.png")
    head = "ply\nformat ascii 1.0\ncomment TextureFile p.png\nelement vertex 4\n"
    head += "".join(f"property float {name}\n" for name in "xyz")
    corners, uv = (
        np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]),
        np.array([[0, 0], [1, 0], [0, 1], [0.5, 0.25]]),
    )
    points = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]
    if per_face:
        head += (
            "element face 4\nproperty list uchar int vertex_indices\nproperty list uchar float texcoord\nend_header\n"
        )
        rows = [" ".join(map(str, row)) for row in points]
        rows += [f"3 {a} {b} {c} 6 " + " ".join(map(str, uv[[a, b, c]].ravel())) for a, b, c in corners]
    else:
        head += (
            "property float s\nproperty float t\nelement face 4\nproperty list uchar int vertex_indices\nend_header\n"
        )
        rows = [" ".join(map(str, [*row, *pair])) for row, pair in zip(points, uv.tolist(), strict=True)]
        rows += [f"3 {a} {b} {c}" for a, b, c in corners]
    (tmp_path / "a.ply").write_text(head + "\n".join(rows) + "\n")
    mesh = read_painted_mesh(tmp_path / "a.ply")
    np.testing.assert_allclose(mesh.uv, uv[corners])
    assert mesh.materials[0].picture[0, 0, 0] == 90


@pytest.mark.parametrize("opacity", [255, 128])
def test_colours_of_a_plys_faces_are_shown_kept_and_transferred(tmp_path, opacity):
    """Every face has its own colour to the byte, where it is read, kept, transferred and written."""
    ball = omtwarp.shapes.icosphere(4)
    colors = np.random.default_rng(0).integers(0, 256, (len(ball.faces), 4), dtype=np.uint8)
    colors[:, 3] = opacity
    given = trimesh.Trimesh(ball.vertices, ball.faces, process=False)
    given.visual.face_colors = colors
    given.export(tmp_path / "faces.ply")
    mesh = read_painted_mesh(tmp_path / "faces.ply")
    places = np.linalg.norm(ball.vertices, axis=1, keepdims=True)
    result = mesh.vertices, mesh.faces, ball.vertices / places
    kept = omtwarp.paint(result, mesh, pattern="checker", keep="under", opacity=1.0, uv="atlas", size=768)
    moved = omtwarp.transfer_texture(mesh, result, result, aligned=True, size=768)
    mesh.export(tmp_path / "again.glb")
    for made in (mesh, read_painted_mesh(tmp_path / "again.glb"), moved, *([kept] if opacity == 255 else [])):
        picture = made.materials[0].picture
        middle, uv = made.vertices[made.faces].mean(axis=1), made.uv.mean(axis=1)
        _, source = cKDTree(ball.vertices[ball.faces].mean(axis=1)).query(middle)
        whole = len(made.faces) == len(
            ball.faces
        )  # the parts of a face that charts cut may have their middles elsewhere
        size = np.array(picture.shape[1::-1])
        column, row = np.floor(uv * (1, -1) % 1.0 * size).astype(int).T
        off = np.abs(picture[row, column].astype(int) - colors[source, : picture.shape[2]]).max(axis=1)
        assert (off <= 1).mean() > (0.999 if whole else 0.85)
        assert picture.shape[2] == (3 if opacity == 255 else 4)
    (shown,) = painted_view(mesh).materials
    assert shown.image is mesh.materials[0].picture
    with pytest.raises(OmtwarpError, match="has no texture coordinates that give a face an area"):
        omtwarp.paint(result, mesh, pattern="checker", size=64)


def test_colours_of_faces_beside_those_of_vertices_are_left_out_with_a_note(tmp_path):
    colored = "property uchar red\nproperty uchar green\nproperty uchar blue\n"
    head = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n" + colored
    head += f"element face 1\nproperty list uchar int vertex_indices\n{colored}end_header\n"
    (tmp_path / "a.ply").write_text(head + "0 0 0 9 8 7\n1 0 0 9 8 7\n0 1 0 9 8 7\n3 0 1 2 1 2 3\n")
    mesh = read_painted_mesh(tmp_path / "a.ply")
    np.testing.assert_array_equal(mesh.vertex_colors, [[9, 8, 7, 255]] * 3)
    assert mesh.uv is None and "left out the colours of faces" in mesh.notes[0]


def test_coordinates_follow_a_repair_that_turns_faces(tmp_path):
    """After repairing, every corner has the coordinates of the place where it lies."""
    path, *_ = two_halves(tmp_path)
    mesh = read_painted_mesh(path)
    faces = mesh.faces.copy()
    faces[::3] = faces[::3, ::-1]
    uv = mesh.uv.copy()
    uv[::3] = uv[::3, ::-1]
    mixed = PaintedMesh(mesh.vertices, faces[1:], uv[1:], mesh.materials, mesh.face_material[1:])
    repaired = omtwarp.repair(mixed.vertices, mixed.faces)
    after = mixed.on(repaired.vertices, repaired.faces, repaired.face_origin)
    old = repaired.face_origin >= 0
    places = after.vertices[after.faces[old]]
    np.testing.assert_allclose(after.uv[old][..., 1], 0.5 + 0.49 * places[..., 2], atol=1e-12)
    assert np.isfinite(after.uv).all() and len(after.faces) == len(mesh.faces)
    with pytest.raises(OmtwarpError, match="another mesh"):
        mesh.on(mesh.vertices + 1.0, mesh.faces)


def shuffled(mesh, seed=5):
    """The same surface with vertices and faces in another order, and every face begun at another corner."""
    rng = np.random.default_rng(seed)
    vertex, face = rng.permutation(len(mesh.vertices)), rng.permutation(len(mesh.faces))
    number = np.empty(len(vertex), dtype=np.int64)
    number[vertex] = np.arange(len(vertex))
    return mesh.vertices[vertex], np.roll(number[mesh.faces[face]], 1, axis=1), face


def test_coordinates_follow_another_order_of_the_same_triangles(tmp_path):
    """Matched by their places: every corner has the coordinates and the material of the place where it lies."""
    path, *_ = two_halves(tmp_path)
    mesh = read_painted_mesh(path)
    points, faces, order = shuffled(mesh)
    rounded = points.astype(np.float32).astype(np.float64)  # as a file in single precision has them
    after = mesh.on(rounded, faces)
    np.testing.assert_array_equal(after.face_material, mesh.face_material[order])
    np.testing.assert_array_equal(after.uv, np.roll(mesh.uv[order], 1, axis=1))
    with pytest.raises(OmtwarpError, match=r"3 of the map's \d+ faces are not in the mesh, first face 0"):
        PaintedMesh(mesh.vertices, mesh.faces[order[3:]], uv=None).on(points, faces)
    with pytest.raises(OmtwarpError, match="another mesh"):
        mesh.on(points + 1.0, faces)


@pytest.mark.filterwarnings("ignore::omtwarp.OmtwarpWarning")  # the mesh is coarse
@pytest.mark.parametrize("exact", [False, True])
def test_coordinates_follow_a_map_that_divides_triangles(exact):
    """A sheet of squares, of which the diagonals at two corners are split, and with exact areas all edges.

    Coordinates, colours and materials are read off the places, and the mesh lists its triangles in another order.
    """
    x, y = (side.ravel() for side in np.meshgrid(*[np.linspace(-1.0, 1.0, 7)] * 2, indexing="ij"))
    number = np.arange(49).reshape(7, 7)
    a, b, c, d = (number[i : 6 + i, j : 6 + j].ravel() for i, j in ((0, 0), (1, 0), (1, 1), (0, 1)))
    points, faces = np.column_stack([x, y, 0.4 * np.exp(-(x**2) - y**2)]), np.r_[np.c_[a, b, d], np.c_[b, c, d]]
    result = omtwarp.map_surface((points, faces), domain="hemisphere", exact=exact, device="cpu")
    assert (result.vertex_origin < 0).sum() == (128 if exact else 2)

    def colors(at):
        return np.rint(120 + 100 * np.column_stack([at[:, :2], at[:, 0], np.ones(len(at))])).astype(np.uint8)

    def side(triangles, at):
        return (at[triangles].mean(axis=1)[:, 0] > 0).astype(int)

    places, triangles, _ = shuffled(PaintedMesh(points, faces))
    red, blue = Material("red"), Material("blue")
    mesh = PaintedMesh(
        places, triangles, 0.5 + 0.4 * places[triangles][..., :2], (red, blue), side(triangles, places), colors(places)
    )
    after = mesh.on(result.vertices, result.faces, origins=result.origins)
    np.testing.assert_allclose(after.uv, 0.5 + 0.4 * result.vertices[result.faces][..., :2], atol=1e-12)
    np.testing.assert_array_equal(after.face_material, side(result.faces, result.vertices))
    np.testing.assert_allclose(after.vertex_colors, colors(result.vertices), atol=1)
    painted = omtwarp.paint(result, mesh, pattern="checker", keep="over", size=96, device="cpu")
    assert [material.name for material in painted.materials] == ["red", "blue"]
    turned = replace(result.origins, face_origin=result.face_origin[::-1])
    again = after.on(result.vertices, result.faces[::-1], origins=turned)
    np.testing.assert_array_equal(again.uv, after.uv[::-1])  # a mesh that is divided as the map is


def test_triangles_with_the_same_coordinates_along_every_axis_are_told_apart():
    """Three triangles across a cube, whose corners have the same x, the same y and the same z, in other pairs."""
    cube = np.array([[x, y, z] for x in (0.0, 1.0) for y in (0.0, 1.0) for z in (0.0, 1.0)])
    faces = np.array([[4, 2, 1], [6, 1, 0], [5, 2, 0]])
    mesh = PaintedMesh(cube, faces, face_material=[0, 1, 2], materials=tuple(Material(name) for name in "abc"))
    np.testing.assert_array_equal(mesh.on(cube, faces[::-1]).face_material, [2, 1, 0])


@pytest.mark.parametrize("level", [0, 5, 60, 188, 255])
def test_colours_of_glb_are_linear(tmp_path, level):
    """A material's factor and colours at vertices are light in the file, and the colour itself when read and drawn."""
    ball = omtwarp.shapes.icosphere(3)
    material = Material("one", (level / 255.0, 0.5, 1.0, 1.0))
    PaintedMesh(ball.vertices, ball.faces, materials=(material,)).export(tmp_path / "a.glb")
    light = level / 255.0 / 12.92 if level <= 10 else ((level / 255.0 + 0.055) / 1.055) ** 2.4
    data = (tmp_path / "a.glb").read_bytes()
    header = json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")])
    written = header["materials"][0]["pbrMetallicRoughness"]["baseColorFactor"]
    np.testing.assert_allclose(written, [light, ((0.5 + 0.055) / 1.055) ** 2.4, 1.0, 1.0], rtol=1e-12)
    np.testing.assert_allclose(read_painted_mesh(tmp_path / "a.glb").materials[0].color, material.color, atol=1e-6)
    for shown in (tmp_path / "a.glb", trimesh.load_mesh(tmp_path / "a.glb")):  # trimesh keeps eight bits of the light
        drawn = np.asarray(omtwarp.preview(shown, size=(32, 32), light="flat", backend="warp", device="cpu"))
        np.testing.assert_allclose(drawn[16, 16, :3], [level, 127.5, 255], atol=2 if level != 5 else 8)
    colors = np.full((len(ball.vertices), 4), (level, 60, 200, 255), dtype=np.uint8)
    PaintedMesh(ball.vertices, ball.faces, vertex_colors=colors).export(tmp_path / "b.glb")
    back = read_painted_mesh(tmp_path / "b.glb").vertex_colors.astype(int)
    np.testing.assert_array_equal(back, colors)


def share(picture, color):
    """Return the share of a picture's pixels within 12 levels of a colour."""
    return (np.abs(np.asarray(picture.convert("RGB")).astype(int) - color).max(axis=2) <= 12).mean()


@pytest.mark.parametrize("backend", ["warp", "auto"])
def test_a_preview_shows_two_materials(tmp_path, backend):
    """From the front each half of the ball covers as much of the picture as the other, in its colour."""
    path, *_ = two_halves(tmp_path)
    drawn = omtwarp.preview(path, size=(200, 200), views="front", up="z", light="flat", backend=backend)
    assert share(drawn, RED) > 0.25 and share(drawn, BLUE) > 0.25
    pixels = np.asarray(drawn).astype(int)
    assert np.abs(pixels[60, 100] - RED).max() < 12 and np.abs(pixels[140, 100] - BLUE).max() < 12


@pytest.mark.parametrize("backend", ["warp", "auto"])
@pytest.mark.parametrize("suffix", [".obj", ".glb"])
def test_a_preview_shows_a_colour_beside_a_picture(tmp_path, backend, suffix):
    path, *_ = two_halves(tmp_path, picture=True)
    if suffix == ".glb":
        mesh = read_painted_mesh(path)
        mesh.export(tmp_path / "two.glb")
        path = tmp_path / "two.glb"
    drawn = omtwarp.preview(path, size=(240, 240), views="front", up="z", light="flat", backend=backend)
    assert share(drawn, RED) > 0.2 and share(drawn, BLUE) > 0.06 and share(drawn, (240, 240, 240)) > 0.06
    assert np.abs(np.asarray(drawn)[70, 120].astype(int) - RED).max() < 12


@pytest.mark.parametrize("suffix", [".obj", ".glb"])
def test_what_is_written_is_read_again(tmp_path, suffix):
    """Coordinates, materials, pictures and the closed mesh come back; colours to the precision of the format."""
    path, *_ = two_halves(tmp_path, picture=True)
    mesh = read_painted_mesh(path)
    files = mesh.export(tmp_path / f"again{suffix}")
    again = read_painted_mesh(files[-1])
    assert len(again.vertices) == len(mesh.vertices) and omtwarp.check(again.vertices, again.faces) == []
    np.testing.assert_allclose(
        again.vertices[again.faces], mesh.vertices[mesh.faces], atol=1e-6 if suffix == ".glb" else 0
    )
    np.testing.assert_allclose(again.uv, mesh.uv, atol=1e-6)
    np.testing.assert_array_equal(again.face_material, mesh.face_material)
    for one, other in zip(again.materials, mesh.materials, strict=True):
        assert one.name == other.name
        np.testing.assert_allclose(one.color, other.color, atol=0.011)
        assert (one.picture is None) == (other.picture is None)
        if other.picture is not None:
            np.testing.assert_array_equal(one.picture, other.picture)


def test_corners_without_coordinates_leave_the_others_of_their_triangle_theirs(tmp_path):
    mesh = read_painted_mesh(two_halves(tmp_path, picture=True)[0])
    uv = mesh.uv.copy()
    uv[3, 1] = np.nan
    np.testing.assert_array_equal(replace(mesh, uv=uv).on(mesh.vertices, mesh.faces).uv, uv)


def test_materials_may_be_given_one_after_another(tmp_path):
    mesh = read_painted_mesh(two_halves(tmp_path, picture=True)[0])
    names = [material.name for material in replace(mesh, materials=iter(mesh.materials)).materials]
    assert names == [material.name for material in mesh.materials]


def test_objects_and_groups_of_an_obj_come_back(tmp_path):
    """Names behind o and g go with their faces, in the order of the file, also where materials cross them."""
    ball = omtwarp.shapes.icosphere(2)
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in ball.vertices.tolist()]
    wanted = {}
    for number, face in enumerate(ball.faces):
        if number % 20 == 0:
            pair = [("Körper 1", ""), ("Körper 1", "left arm"), ("head", "left arm"), ("head", "")][number // 20]
            lines += [f"o {pair[0]}", f"g {pair[1]}".rstrip()]
        if number % 7 == 0:
            lines.append(f"usemtl m{number % 3}")
        lines.append("f " + " ".join(map(str, face + 1)))
        wanted[tuple(np.roll(face, -np.argmin(face)).tolist())] = (pair, f"m{number // 7 * 7 % 3}")
    (tmp_path / "in.obj").write_text("\n".join(lines) + "\n", "utf-8")
    mesh = read_painted_mesh(tmp_path / "in.obj")
    turned = mesh.on(mesh.vertices, mesh.faces[::-1])
    for made in (mesh, turned):
        made.export(tmp_path / "out.obj")
        again = read_painted_mesh(tmp_path / "out.obj")
        known = {}
        for face, material, of in zip(again.faces, again.material_of, again.face_object, strict=True):
            key = tuple(np.roll(face, -np.argmin(face)).tolist())
            known[key] = (again.objects[of], again.materials[material].name)
        assert known == wanted
    assert again.objects == mesh.objects


def test_a_library_of_blender_comes_back_as_it_went_in(tmp_path):
    """The numbers of every statement, no roughness beside a shininess, and the names, whose files have safe ones."""
    lines = ["Ns 250", "Ka 1 1 1", "Kd 0.8 0.2 0.1", "Ks 0.5 0.5 0.5", "Ke 0 0 0", "Ni 1.45", "d 0.5", "illum 2"]
    library = "".join(f"newmtl {name}\n" + "\n".join(lines) + "\n" for name in ("Körper/1", "körper/1", "b"))
    (tmp_path / "in.mtl").write_text(library.replace("newmtl b\n", "newmtl b\nPr 0.3\n"), "utf-8")
    ball = omtwarp.shapes.icosphere(1)
    text = ["mtllib in.mtl", *(f"v {x} {y} {z}" for x, y, z in ball.vertices), "vt 0 0"]
    for number, face in enumerate(ball.faces + 1):
        text += [f"usemtl {('Körper/1', 'körper/1', 'b')[number % 3]}", "f " + " ".join(f"{k}/1" for k in face)]
    (tmp_path / "in.obj").write_text("\n".join(text) + "\n", "utf-8")
    mesh = read_painted_mesh(tmp_path / "in.obj")
    picture = np.zeros((2, 2, 3), np.uint8)
    with_pictures = [replace(material, picture=picture + k) for k, material in enumerate(mesh.materials)]
    files = replace(mesh, materials=tuple(with_pictures)).export(tmp_path / "out.obj")
    assert all(re.fullmatch(r"out[-.A-Za-z0-9_]+", file.name) for file in files)
    written = (tmp_path / "out.mtl").read_text("utf-8").split("newmtl ")[1:]
    assert [one.splitlines()[0] for one in written] == ["Körper/1", "körper/1", "b"]

    def numbers(block):
        return {
            line.split()[0]: [float(word) for word in line.split()[1:]] for line in block if line and "map" not in line
        }

    for one in written[:2]:
        assert numbers(one.splitlines()[1:]) == numbers(lines)
    assert numbers(written[2].splitlines()[1:])["Pr"] == [0.3]


def test_names_of_materials_and_libraries_may_hold_a_hash(tmp_path):
    """As "Material #1" of 3ds Max does."""
    whole = read_painted_mesh(two_halves(tmp_path)[0])
    for name in ("two.obj", "two.mtl"):
        text = (tmp_path / name).read_text().replace("two.mtl", "a#b.mtl")
        text = re.sub("^(usemtl|newmtl) (red|blue)", r"\1 Material #\2", text, flags=re.M)
        (tmp_path / name.replace("two", "a#b")).write_text(text.replace("\nnewmtl", " # a comment\nnewmtl"))
    read = read_painted_mesh(tmp_path / "a#b.obj")
    assert [material.name for material in read.materials] == ["Material #red", "Material #blue"] and not read.notes
    assert [material.color for material in read.materials] == [material.color for material in whole.materials]


def test_opacity_of_an_opaque_material_of_glb_counts_for_nothing(tmp_path):
    """As glTF 2.0 has it, where alphaMode is OPAQUE or left out."""
    clear = np.full((8, 8, 4), (200, 60, 30, 0), dtype=np.uint8)
    whole = read_painted_mesh(two_halves(tmp_path)[0])
    materials = (Material("clear", picture=clear), *whole.materials[1:])
    file = tmp_path / "clear.glb"
    for mode in ("BLEND", "OPAQUE"):
        replace(whole, materials=materials).export(file)
        data = file.read_bytes()
        length = int.from_bytes(data[12:16], "little")
        text = data[20 : 20 + length].replace(b'"BLEND"', f'"{mode}"'.encode().ljust(7))
        text += b" " * (length - len(text))
        file.write_bytes(data[:20] + text[:length] + data[20 + length :])
        picture = read_painted_mesh(file).materials[0].picture
        assert picture.shape[2] == (4 if mode == "BLEND" else 3)
        np.testing.assert_array_equal(picture[..., :3], clear[..., :3])


@pytest.mark.parametrize(("cutoff", "first"), [(0.4, 128), (0.9, None), (0.0, 0)])
def test_a_mask_of_glb_makes_texels_opaque_or_clear(tmp_path, cutoff, first):
    """As glTF 2.0 has it: opaque where the picture's opacity times the colour's is the cutoff or more."""
    rising = np.full((4, 256, 4), (200, 60, 30, 0), dtype=np.uint8)
    rising[..., 3] = np.arange(256)
    whole, file = read_painted_mesh(two_halves(tmp_path)[0]), tmp_path / "mask.glb"
    materials = (Material("leaf", color=(1.0, 1.0, 1.0, 0.8), picture=rising), *whole.materials[1:])
    replace(whole, materials=materials).export(file)
    data = file.read_bytes()
    length = int.from_bytes(data[12:16], "little")
    document = json.loads(data[20 : 20 + length])
    document["materials"][0] |= {"alphaMode": "MASK", "alphaCutoff": cutoff}
    content = json.dumps(document, separators=(",", ":")).encode()
    content += b" " * (-len(content) % 4)
    total = (len(data) + len(content) - length).to_bytes(4, "little")
    head = data[:8] + total + len(content).to_bytes(4, "little") + data[16:20]
    file.write_bytes(head + content + data[20 + length :])
    material = read_painted_mesh(file).materials[0]
    picture = material.picture
    opaque = np.zeros(256, dtype=bool) if first is None else np.arange(256) >= first
    given = picture[..., 3] if picture.shape[2] == 4 else np.full((4, 256), 255)
    np.testing.assert_array_equal(np.round(given * material.color[3]), np.where(opaque, 255, 0)[None].repeat(4, 0))
    np.testing.assert_array_equal(picture[..., :3], rising[..., :3])


def test_white_of_glb_is_white(tmp_path):
    """So that colours at the vertices alone are seen in a preview."""
    whole = read_painted_mesh(two_halves(tmp_path)[0])
    colors = np.full((len(whole.vertices), 4), (255, 0, 0, 255), dtype=np.uint8)
    replace(whole, materials=(Material("white"),), face_material=None, vertex_colors=colors).export(
        tmp_path / "red.glb"
    )
    read = read_painted_mesh(tmp_path / "red.glb")
    assert read.materials[0].color == (1.0, 1.0, 1.0, 1.0)
    np.testing.assert_array_equal(painted_view(read).colors, colors[:, :3] / 255.0)


def test_a_picture_of_two_opaque_materials_is_read_and_written_once(tmp_path):
    shared = np.random.default_rng(5).integers(0, 255, (16, 16, 3)).astype(np.uint8)
    whole = read_painted_mesh(two_halves(tmp_path)[0])
    materials = tuple(Material(name, picture=shared, emission_picture=shared) for name in ("one", "two"))
    (file,) = replace(whole, materials=materials).export(tmp_path / "one.glb")
    read = read_painted_mesh(file)
    assert len({id(one) for m in read.materials for one in (m.picture, m.emission_picture)}) == 1
    (again,) = read.export(tmp_path / "again.glb")
    assert file.read_bytes().count(b"\x89PNG") == again.read_bytes().count(b"\x89PNG") == 1


def glb_with(path, *, picture=None, material=None, required=False, second=False):
    """Change what a GLB's first material, or the use of its picture, says; make its coordinates the second set."""
    import pygltflib

    content = pygltflib.GLTF2().load(str(path))
    one = content.materials[0]
    for name, value in (material or {}).items():
        setattr(one, name, value)
    for name, value in (picture or {}).items():
        setattr(one.pbrMetallicRoughness.baseColorTexture, name, value)
    content.extensionsRequired = ["KHR_texture_transform"] if required else []
    if second:
        attributes = content.meshes[0].primitives[0].attributes
        attributes.TEXCOORD_0, attributes.TEXCOORD_1 = None, attributes.TEXCOORD_0
    content.save(str(path))


@pytest.mark.parametrize("whole", [False, True])
@pytest.mark.parametrize(
    "moved",
    [
        {"offset": [0, 1], "rotation": np.pi / 2, "scale": [0.5, 0.5]},  # the lower left quarter, turned
        {"offset": [0.1, -0.2], "rotation": 0.3, "scale": [3.0, -0.7]},
        {"scale": [1, -1]},
    ],
)
def test_moved_coordinates_of_a_glb_are_read_where_they_are_moved_to(tmp_path, moved, whole):
    two_halves(tmp_path, picture=True)
    mesh = read_painted_mesh(tmp_path / "two.obj")
    replace(mesh, materials=(mesh.materials[1],), face_material=None).export(tmp_path / "a.glb")
    before = read_painted_mesh(tmp_path / "a.glb")
    glb_with(tmp_path / "a.glb", picture={"extensions": {"KHR_texture_transform": moved}}, required=whole)
    after = read_painted_mesh(tmp_path / "a.glb")
    # In the plane of complex numbers u + i v, with v downwards, counter-clockwise on the screen is times exp(-i angle).
    u, v = before.uv[..., 0], 1.0 - before.uv[..., 1]
    along, down = moved["scale"]
    left, top = moved.get("offset", (0, 0))
    place = np.exp(-1j * moved.get("rotation", 0.0)) * (along * u + 1j * down * v) + left + 1j * top
    np.testing.assert_allclose(after.uv, np.stack([place.real, 1.0 - place.imag], axis=-1), atol=1e-6)
    assert not [note for note in after.notes if note.startswith("left out")]


def test_the_second_set_of_coordinates_of_a_glb_is_read_where_a_picture_wants_it(tmp_path):
    two_halves(tmp_path, picture=True)
    mesh = read_painted_mesh(tmp_path / "two.obj")
    replace(mesh, materials=(mesh.materials[1],), face_material=None).export(tmp_path / "a.glb")
    before = read_painted_mesh(tmp_path / "a.glb")
    glb_with(tmp_path / "a.glb", picture={"texCoord": 1}, second=True)
    after = read_painted_mesh(tmp_path / "a.glb")
    np.testing.assert_array_equal(after.uv, before.uv)
    assert after.notes == before.notes


@pytest.mark.parametrize(
    ("picture", "material", "lost"),
    [
        (
            {"extensions": {"KHR_texture_transform": {"scale": [2, 2]}}},
            {"emissiveTexture": {"index": 0}},
            "coordinates of emissiveTexture alone",
        ),
        (
            None,
            {"normalTexture": {"index": 0, "scale": 0.5, "texCoord": 1}},
            "scale of normalTexture, coordinates of normalTexture alone",
        ),
        ({"texCoord": 0, "extensions": {"KHR_texture_transform": {}}}, None, ""),
    ],
)
def test_what_is_not_read_of_a_glb_is_said(tmp_path, picture, material, lost):
    two_halves(tmp_path, picture=True)
    mesh = read_painted_mesh(tmp_path / "two.obj")
    replace(mesh, materials=(mesh.materials[1],), face_material=None).export(tmp_path / "a.glb")
    glb_with(tmp_path / "a.glb", picture=picture, material=material)
    notes = [note for note in read_painted_mesh(tmp_path / "a.glb").notes if note.startswith("left out")]
    assert notes == ([f"left out {lost}, which are not read"] if lost else [])
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", omtwarp.OmtwarpWarning)
        omtwarp.preview(tmp_path / "a.glb", size=(32, 32), backend="warp")
    assert [str(one.message) for one in caught if one.category is omtwarp.OmtwarpWarning] == [
        f"{tmp_path / 'a.glb'}: {note}" for note in notes
    ]


def test_light_that_is_sent_out_goes_from_obj_to_glb_and_back(tmp_path):
    two_halves(tmp_path)
    with open(tmp_path / "two.mtl", "a") as library:
        library.write("Ke 0.25 0.5 1\n")
    mesh = read_painted_mesh(tmp_path / "two.obj")
    assert [material.emission for material in mesh.materials] == [(0.0, 0.0, 0.0), (0.25, 0.5, 1.0)]
    mesh.export(tmp_path / "a.glb")
    again = read_painted_mesh(tmp_path / "a.glb")
    assert again.materials[1].emission == (0.25, 0.5, 1.0)
    replace(again, materials=tuple(replace(one, phong=()) for one in again.materials)).export(tmp_path / "b.obj")
    assert "Ke 0.25 0.5 1\n" in (tmp_path / "b.mtl").read_text()
    assert read_painted_mesh(tmp_path / "b.obj").materials[1].emission == (0.25, 0.5, 1.0)


@pytest.mark.parametrize(("factor", "emission"), [("", (1.0, 1.0, 1.0)), ("Ke 0 0 0\n", (0.0, 0.0, 0.0))])
def test_a_picture_of_light_without_a_factor_shines_as_it_is(tmp_path, factor, emission):
    path, *_ = two_halves(tmp_path, picture=True)
    with open(tmp_path / "two.mtl", "a") as library:
        library.write(f"map_Ke stripes.png\n{factor}")
    mesh = read_painted_mesh(path)
    assert mesh.materials[1].emission_picture is not None and mesh.materials[1].emission == emission
    mesh.export(tmp_path / "a.glb")
    again = read_painted_mesh(tmp_path / "a.glb")
    assert again.materials[1].emission == emission
    again.export(tmp_path / "b.obj")
    assert read_painted_mesh(tmp_path / "b.obj").materials[1].emission == emission


@pytest.mark.parametrize("encoding", ["png", "webp"])
def test_light_brighter_than_white_is_read_and_written(tmp_path, encoding):
    two_halves(tmp_path, picture=True)
    mesh = read_painted_mesh(tmp_path / "two.obj")
    bright, dim = (
        replace(mesh.materials[0], emission=(0.5, 4.0, 1.0)),
        replace(mesh.materials[1], emission=(0.0, 0.1, 1.0)),
    )
    replace(mesh, materials=(bright, dim)).export(tmp_path / "a.glb", texture_format=encoding)
    again = read_painted_mesh(tmp_path / "a.glb")
    np.testing.assert_allclose([one.emission for one in again.materials], [bright.emission, dim.emission], rtol=1e-12)
    assert not [note for note in again.notes if note.startswith("left out")]
    there = trimesh.load_scene(tmp_path / "a.glb").geometry.values()  # trimesh does not know the extension
    assert sum(len(one.faces) for one in there) == len(mesh.faces)


def test_several_libraries_may_be_named_in_a_line(tmp_path):
    path, *_ = two_halves(tmp_path)
    first, second = (tmp_path / "two.mtl").read_text().split("newmtl blue")
    (tmp_path / "two.mtl").write_text(first)
    (tmp_path / "my own.mtl").write_text(first.replace("red", "other"))
    (tmp_path / "more.mtl").write_text("newmtl blue" + second)
    path.write_text(path.read_text().replace("mtllib two.mtl", "mtllib two.mtl more.mtl\nmtllib my own.mtl"))
    mesh = read_painted_mesh(path)
    assert not mesh.notes
    np.testing.assert_allclose(np.array(mesh.materials[1].color[:3]) * 255, BLUE, atol=1e-3)


@pytest.mark.parametrize(("options", "left"), [("-s 2 2 1 -clamp on", "-s"), ("-s 1 1 1 -o 0 0 0", "")])
def test_a_picture_that_a_library_moves_is_said(tmp_path, options, left):
    path, *_ = two_halves(tmp_path, picture=True)
    library = (tmp_path / "two.mtl").read_text()
    (tmp_path / "two.mtl").write_text(library.replace("-clamp off", options))
    mesh = read_painted_mesh(path)
    assert mesh.materials[1].picture is not None
    assert list(mesh.notes) == [f"left out {left} of the picture 'stripes.png', which is not read"] * bool(left)


@pytest.mark.parametrize("everywhere", [True, False])
def test_a_picture_of_an_obj_is_not_darkened_by_colours_at_vertices(tmp_path, everywhere):
    """They are multiplied in a GLB, where an OBJ has one or the other; under no picture they stay."""
    path, *_ = two_halves(tmp_path, picture=True)
    text = re.sub(r"^(v .*)$", r"\1 0.5 0.5 0.5", path.read_text(), flags=re.MULTILINE)
    path.write_text(text.replace("usemtl red", "usemtl blue" if everywhere else "usemtl red"))
    mesh = read_painted_mesh(path)
    (file,) = mesh.export(tmp_path / "two.glb")
    assert (b"COLOR_0" in file.read_bytes()) is not everywhere
    if everywhere:
        assert mesh.vertex_colors is None
        return
    plain = np.unique(mesh.faces[mesh.face_material == 0])
    assert (np.delete(mesh.vertex_colors, plain, axis=0) == 255).all() and (mesh.vertex_colors[plain, :3] == 128).all()


def test_a_preview_warns_of_a_picture_that_is_not_there(tmp_path):
    path, *_ = two_halves(tmp_path, picture=True)
    (tmp_path / "stripes.png").unlink()
    with pytest.warns(omtwarp.OmtwarpWarning, match=r"two.obj: the picture 'stripes.png' is not there"):
        omtwarp.preview(path, size=(32, 32), backend="warp")


def test_a_preview_shows_colours_at_vertices_beside_a_picture(tmp_path):
    """Of a scene in which one part has a picture and another colours at its vertices."""
    path, *_ = two_halves(tmp_path, picture=True)
    mesh = read_painted_mesh(path)
    green = np.full((len(mesh.vertices), 4), (20, 160, 60, 255), dtype=np.uint8)
    mixed = replace(mesh, materials=(Material("plain"), mesh.materials[1]), vertex_colors=green)
    drawn = omtwarp.preview(mixed, size=(120, 120), views="front", up="z", light="flat", backend="warp")
    assert share(drawn, (20, 160, 60)) > 0.2 and share(drawn, BLUE) > 0.06


def test_bytes_in_tiffs_of_32_bits_are_not_black(tmp_path):
    values = np.arange(256, dtype=np.int32).reshape(16, 16)
    Image.fromarray(values).save(tmp_path / "small.tif")
    np.testing.assert_allclose(omtwarp.texturing.read_image(tmp_path / "small.tif")[..., 0], values / 255.0, atol=1e-6)
    Image.fromarray(257 * values).save(tmp_path / "large.tif")
    np.testing.assert_allclose(omtwarp.texturing.read_image(tmp_path / "large.tif")[..., 0], values / 255.0, atol=1e-6)
