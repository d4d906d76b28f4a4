"""The commands for meshes with texture coordinates and materials: their files, and one line for every mistake."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from test_cli_commands import run

import omtwarp
from omtwarp.mesh.write import write_mesh
from omtwarp.texturing import read_painted_mesh

sys.path.insert(0, str(Path(__file__).parents[1] / "materials"))
from two_materials import two_halves


@pytest.fixture
def desk(tmp_path, monkeypatch):
    """A ball of two materials with its map, and a plain mesh without texture coordinates."""
    path, *_ = two_halves(tmp_path, picture=True)
    mesh = omtwarp.read_mesh(path)
    result = omtwarp.map_to_sphere((mesh.vertices, mesh.faces), until="moser", device="cpu")
    result.save(tmp_path / "two.npz")
    write_mesh(tmp_path / "plain.ply", mesh.vertices, mesh.faces)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_own_coordinates_with_materials_and_occlusion(desk, capsys):
    words = "texture two.obj --map two.npz -o painted.glb --uv own --keep-materials over --bake ao --size 128"
    status, out, _ = run(capsys, *words.split())
    assert status == 0 and "blue occlusion" in out and "red colour 128 x 128" in out
    made, given = read_painted_mesh("painted.glb"), read_painted_mesh("two.obj")
    np.testing.assert_allclose(made.uv, given.uv, atol=1e-6)
    assert all(m.occlusion_picture is not None and m.picture is not None for m in made.materials)


def test_occlusion_that_is_smaller_than_asked_says_so(desk, capsys, monkeypatch):
    words = "texture --map two.npz -o ao.glb --bake ao --size 96".split()
    assert "at most" not in run(capsys, *words)[1]
    monkeypatch.setattr("omtwarp.texturing.bakes.MOST_RAYS", 8 * 2000)  # 2,000 texels
    status, out, _ = run(capsys, *words)
    assert status == 0 and "occlusion 48 x 32, occlusion by" in out and "rays at most" in out


def test_a_texture_that_seams_cut_is_transferred_without_its_map(desk, capsys):
    assert run(capsys, *"texture --map two.npz -o cut.glb --size 48 --rotate 20,30,0".split())[0] == 0
    words = "transfer cut.glb plain.ply -o t.glb --map-to two.npz --aligned --size 48".split()
    status, _, err = run(capsys, *words, "--map-from", "two.npz")
    assert status == 1 and "leave out the map" in err
    status, _, err = run(capsys, *words)
    assert status == 0, err


@pytest.mark.parametrize(
    "words",
    [
        "texture two.obj --map two.npz --uv own --keep-materials over --pattern globe -o noted.glb --size 64",
        "transfer two.obj plain.ply --map-from two.npz --map-to two.npz --aligned -o noted.glb --size 64",
    ],
)
def test_what_reading_left_out_is_said_beside_a_finished_map(desk, capsys, words):
    (desk / "stripes.png").unlink()
    status, _, err = run(capsys, *words.split())
    assert status == 0 and err.count("two.obj: the picture 'stripes.png' is not there\n") == 1
    (desk / "two.mtl").unlink()
    _, _, err = run(capsys, *words.split())
    assert "two.obj: the material library 'two.mtl' is not there\n" in err


def test_obj_gets_a_library_and_its_pictures_and_leaves_the_input_alone(desk, capsys):
    before = {name: (desk / name).read_bytes() for name in ("two.obj", "two.mtl", "stripes.png")}
    status, out, _ = run(
        capsys, *"texture two.obj --map two.npz -o new.obj --uv own --pattern checker --size 64".split()
    )
    assert status == 0 and "new.mtl" in out
    assert len(read_painted_mesh("new.obj").materials) == 2
    assert all((desk / name).read_bytes() == content for name, content in before.items())
    status, _, err = run(capsys, *"texture two.obj --map two.npz -o two.obj --uv own".split())
    assert status == 1 and "it is the input" in err


def middles(mesh):
    return mesh.vertices[mesh.faces].mean(axis=1)


@pytest.mark.parametrize("words", ["texture", "texture --bake ao", "texture --keep-materials over", "unwrap"])
def test_a_new_layout_keeps_the_names_of_objects(tmp_path, monkeypatch, capsys, words):
    """Every triangle is in the object and group whose part of the surface it lies on, cut or not."""
    monkeypatch.chdir(tmp_path)
    ball = omtwarp.shapes.icosphere(4)
    low, high = (ball.faces[(middles(ball)[:, 2] > 0) == above] + 1 for above in (0, 1))
    lines = ["v {} {} {}".format(*point) for point in ball.vertices.tolist()]
    for names, faces in ((["o south"], low[1:]), (["o north", "g cap"], high), (["o south", "g"], low[:1])):
        lines += [*names, *("f {} {} {}".format(*face) for face in faces)]
    Path("in.obj").write_text("\n".join(lines) + "\n")
    sized = ["--size", "64"] if words.startswith("texture") else []
    command, *more = words.split()
    status, _, err = run(capsys, command, "in.obj", "-o", "out.obj", *more, *sized)
    assert status == 0, err
    made = read_painted_mesh("out.obj")
    assert made.objects == (("south", ""), ("north", "cap"))
    share = np.einsum("fij,pj->pfi", np.linalg.inv(ball.vertices[ball.faces].transpose(0, 2, 1)), middles(made))
    source = share.min(axis=2).argmax(axis=1)  # the triangle through which the ray to a middle goes
    np.testing.assert_array_equal(made.face_object, middles(ball)[source, 2] > 0)
    assert len(made.faces) > len(ball.faces) or command == "unwrap"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("texture two.obj -o a.glb --opacity 0.3", "an opacity is for materials that are kept"),
        ("texture two.obj -o a.glb --opacity 0.3 --uv own", "an opacity is for materials that are kept"),
        ("texture two.obj -o a.glb --seam 20", "--seam is for --atlas equirectangular"),
        ("texture two.obj -o a.glb --seam auto --atlas octahedral", "--seam is for --atlas equirectangular"),
        ("texture two.obj -o a.glb --uv own --atlas octahedral", "an atlas is for new texture coordinates"),
        ("transfer two.obj two.obj -o a.glb --uv own --atlas octahedral", "an atlas is for new texture coordinates"),
        ("texture two.obj -o a.ply --uv own --bake ao", "use .glb or .obj, or leave out --uv own and --bake\n"),
        ("texture two.obj -o a.ply --keep-materials over", "use .glb or .obj, or leave out --keep-materials\n"),
        ("texture two.obj -o a.glb --keep-materials over --bake area", "area and the materials that are kept"),
        ("texture two.obj -o a.glb --pattern globe --bake area", "area and the pattern would both be the colour"),
        ("texture plain.ply -o a.glb --uv own", "plain.ply: no texture coordinates in it"),
    ],
)
def test_options_that_do_not_go_together_are_refused_before_the_map(desk, capsys, monkeypatch, words, message):
    monkeypatch.setattr("omtwarp.commands._work.map_on_the_way", None)
    status, _, err = run(capsys, *words.split())
    assert status == 1 and message in err
    assert not list(desk.glob("a.*"))


def test_unwrap_then_transfer(desk, capsys):
    status, out, _ = run(capsys, *"unwrap --map two.npz -o new.obj".split())
    assert status == 0 and "6 charts" in out
    status, out, _ = run(
        capsys,
        *"transfer two.obj new.obj --map-from two.npz --map-to two.npz --aligned --uv own -o t.glb --size 64".split(),
    )
    assert status == 0 and "with the texture of two.obj" in out
    (material,) = read_painted_mesh("t.glb").materials
    assert material.picture.shape == (64, 64, 3)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("texture plain.ply --map two.npz -o a.glb --uv own", "plain.ply: no texture coordinates in it"),
        ("texture --map two.npz -o a.glb --uv own", "need the mesh itself"),
        ("texture two.obj --map two.npz -o a.ply --uv own", "PLY holds no materials"),
        ("texture two.obj --map two.npz -o a.glb --bake bumps", "add one of them"),
        ("texture --map two.npz -o a.glb --bake bumps", "cannot bake 'bumps'"),
        ("texture --map two.npz -o a.glb --detail plain.ply", "--detail is for --bake normal"),
        ("texture --map two.npz -o a.glb --bake ao --seam 20", "--seam"),
        ("transfer plain.ply two.obj --map-from two.npz --map-to two.npz -o a.glb", "nothing to transfer"),
        ("transfer two.obj gone.ply -o a.glb", "gone.ply: no such file"),
        ("unwrap plain.ply -o a.stl", "unknown suffix"),
    ],
)
def test_mistakes_are_one_line(desk, capsys, words, message):
    status, _, err = run(capsys, *words.split())
    assert status == 1 and message in err and "Traceback" not in err
    assert not list(desk.glob("a.*"))


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("texture --map two.npz -o a.glb --pattern checker --size 96", {"faces": 720, "files": ["a.glb"]}),
        ("texture two.obj --map two.npz -o b.obj --uv own --pattern checker --size 64", {"output": "b.obj"}),
        ("unwrap --map two.npz -o c.obj", {"charts": 6, "files": ["c.mtl", "c.obj"]}),
        ("preview two.obj -o d.png --size 40x30 --backend warp", {"width": 40, "height": 30, "frames": 1}),
        ("transfer two.obj plain.ply -o e.glb --map-from two.npz --map-to two.npz --size 96", {"from": "two.obj"}),
        ("report --map two.npz -o f.html", {"output": "f.html", "vertices": 362}),
    ],
    ids=lambda value: value.split()[0] if isinstance(value, str) else "",
)
def test_json_is_all_there_is_on_standard_output(desk, capsys, small_pictures, words, expected):
    status, out, _ = run(capsys, *words.split(), "--json")
    facts = json.loads(out)
    assert status == 0 and expected.items() <= facts.items()
    for file in facts.get("files", [facts["output"]]):
        assert (desk / file).stat().st_size > 0
    if "pictures" in facts:
        made = read_painted_mesh(facts["output"])
        shown = [material.picture.shape[:2] for material in made.materials if material.picture is not None]
        assert shown == [(one["height"], one["width"]) for one in facts["pictures"]]


def middle_of_the_coloured(file):
    """Return the mean place, by area, of triangles whose middle is white in the picture of a textured mesh."""
    mesh = read_painted_mesh(file)
    picture, corners = np.asarray(mesh.materials[0].picture), mesh.vertices[mesh.faces]
    columns, rows = (mesh.uv.mean(axis=1) * (picture.shape[1], -picture.shape[0])).astype(int).T
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    white = np.where(picture[rows - 1, columns, 0] > 127, area, 0.0)
    return white @ corners.mean(axis=1) / white.sum()


@pytest.mark.parametrize(
    ("options", "axis", "sign"), [("", 1, 1), ("--up z", 2, 1), ("--up -y", 1, -1), ("--up x --front y", 0, 1)]
)
def test_a_picture_stands_upright_on_a_body_that_lies_along_another_axis(
    tmp_path, monkeypatch, capsys, options, axis, sign
):
    monkeypatch.chdir(tmp_path)
    body = omtwarp.shapes.ellipsoid((1.0, 0.6, 0.8), 1280)
    write_mesh("body.ply", body.vertices, body.faces)
    picture = np.zeros((32, 64, 3), dtype=np.uint8)
    picture[:16] = 255
    Image.fromarray(picture).save("north.png")
    words = "texture body.ply -o body.glb --until conformal --image north.png --size 256 --device cpu --quiet"
    status, _, err = run(capsys, *words.split(), *options.split())
    assert status == 0, err
    middle = middle_of_the_coloured("body.glb")
    assert int(np.abs(middle).argmax()) == axis and middle[axis] * sign > 0.2
    assert np.abs(np.delete(middle, axis)).max() < 0.1


def test_the_front_is_in_the_middle_of_a_picture(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    body = omtwarp.shapes.ellipsoid((1.0, 0.6, 0.8), 1280)
    write_mesh("body.ply", body.vertices, body.faces)
    picture = np.zeros((32, 64, 3), dtype=np.uint8)
    picture[:, 16:48] = 255
    Image.fromarray(picture).save("middle.png")
    words = "texture body.ply -o body.glb --until conformal --image middle.png --size 256 --device cpu --quiet"
    assert run(capsys, *words.split(), "--up", "z", "--front", "-x")[0] == 0
    middle = middle_of_the_coloured("body.glb")
    assert middle[0] < -0.2 and np.abs(middle[1:]).max() < 0.1
    status, _, err = run(capsys, *words.split(), "--up", "z", "--front", "-z")
    assert status == 1 and "must be different axes" in err and "Traceback" not in err


def test_a_finished_map_keeps_its_poles_unless_an_axis_is_given(desk, capsys):
    def uv_of(words):
        assert run(capsys, *words.split(), "--device", "cpu", "--quiet")[0] == 0
        return read_painted_mesh("out.glb").uv

    kept = omtwarp.unwrap_uv(omtwarp.MapResult.load("two.npz"))
    np.testing.assert_allclose(uv_of("unwrap --map two.npz -o out.glb"), kept.uv, atol=1e-6)
    turned = uv_of("unwrap --map two.npz -o out.glb --up -z")
    assert np.abs(turned - kept.uv).max() > 0.1


def test_an_obj_keeps_what_its_library_says_of_highlights(desk, capsys):
    library = desk / "two.mtl"
    said = {"Ns": "250.5", "Ks": "0.5 0.25 0.125", "Ka": "0.1 0.2 0.3", "Ni": "1.45", "illum": "2"}
    lines = "".join(f"{word} {numbers}\n" for word, numbers in said.items())
    text = library.read_text()
    first = text.index("newmtl")
    end = text.index("\n", first) + 1
    library.write_text(text[:end] + lines + text[end:])
    words = "texture two.obj --map two.npz -o kept.obj --uv own --keep-materials under --size 64 --device cpu"
    assert run(capsys, *words.split())[0] == 0
    given, made = (dict(read_painted_mesh(name).materials[0].phong) for name in ("two.obj", "kept.obj"))
    assert made == given
    assert given["Ns"] == (250.5,) and given["Ks"] == (0.5, 0.25, 0.125) and given["illum"] == (2.0,)
