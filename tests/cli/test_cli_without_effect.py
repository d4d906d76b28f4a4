"""Options that would have no effect are refused in a line, and what cannot be done is said before the work."""

import numpy as np
import pytest

import omtwarp
from omtwarp.commands._cli import main
from omtwarp.mesh import shapes
from omtwarp.mesh.write import write_mesh
from omtwarp.texturing import Material


@pytest.fixture(scope="module")
def desk(tmp_path_factory):
    """A folder with a ball, its map, the ball with a texture, and the ball with a hole."""
    folder = tmp_path_factory.mktemp("desk")
    ball = shapes.icosphere(3)
    write_mesh(folder / "ball.ply", ball.vertices, ball.faces)
    write_mesh(folder / "open.ply", ball.vertices, np.delete(ball.faces, 7, axis=0))
    result = omtwarp.map_to_sphere(ball, until="conformal", device="cpu")
    result.save(folder / "ball.npz")
    omtwarp.texture(result, pattern="checker", size=96, device="cpu").export(folder / "ball.glb")
    return folder


def run(capsys, *arguments) -> tuple[int, str]:
    """Run a command; return its exit status and standard error."""
    with pytest.raises(SystemExit) as ended:
        main([str(argument) for argument in arguments])
    return int(ended.value.code or 0), capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("texture --map ball.npz -o a.glb --method tutte", "--method is for new maps, and 'ball.npz' is finished"),
        ("report --map ball.npz -o a.html --repair", "--repair is for new maps, and 'ball.npz' is finished"),
        ("film ball.npz -o a.gif --refine area", "--refine is for new maps, and 'ball.npz' is finished"),
        ("preview ball.ply -o a.png --fps 10", "--fps is for films, with --frames"),
        (
            "preview ball.ply -o a.png --field-of-view 40 --projection orthographic",
            "--field-of-view is for --projection perspective",
        ),
        ("preview ball.ply -o a.png --transparent --background red", "--background is not seen with --transparent"),
        ("map ball.ply -o a.npz --radius 3", "--radius is for spheres as meshes, not for .npz"),
        ("align ball.npz -o a.npz --radius 3", "--radius is for spheres as meshes, not for .npz"),
        ("align ball.npz --to-surface ball.ply -o a.npz", "--to-surface is of a sphere without a surface"),
        (
            "register ball.npz --to fsaverage5-left --to-surface ball.ply -o a.npz",
            "--to-surface is of a sphere without a surface",
        ),
        (
            "transfer ball.glb ball.ply -o a.glb --aligned --mirror",
            "--mirror is for maps that are to be aligned, without --aligned",
        ),
        ("texture ball.ply -o a.glb --pattern globe --projection sinusoidal", "--projection sinusoidal is for"),
        ("texture ball.ply -o a.glb --bake ao --projection sinusoidal", "--projection sinusoidal is for an image"),
        ("texture ball.glb -o a.glb --uv own --bake ao --rotate 30", "--rotate turns pictures and patterns"),
        ("texture ball.glb -o a.glb --uv own --bake ao --up x", "--up turns pictures and patterns"),
        ("texture ball.glb -o a.glb --uv own --bake ao --front x", "--front turns pictures and patterns"),
        ("map ball.ply -o a.npz --method tutte --until moser", "--until is for methods of several stages"),
    ],
)
def test_an_option_without_effect_is_refused(desk, capsys, monkeypatch, words, said):
    monkeypatch.chdir(desk)
    status, err = run(capsys, *words.split())
    assert status == 1 and said in err and err.endswith(": leave it out\n")
    assert not list(desk.glob("a.*"))


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("film ball.ply -o a.gif --background nocolour", "'nocolour' is not a background"),
        ("film ball.ply -o a.gif --view nowhere", "unknown view 'nowhere'"),
        ("transfer ball.ply ball.ply -o a.glb", "nothing to transfer: 'ball.ply' has neither a picture nor colours"),
    ],
)
def test_what_needs_no_map_is_said_before_one_is_made(desk, capsys, monkeypatch, words, said):
    monkeypatch.chdir(desk)
    monkeypatch.setattr(omtwarp, "map_to_sphere", lambda *a, **k: pytest.fail("a map was made"))
    status, err = run(capsys, *words.split())
    assert status == 1 and err.startswith("omtwarp: error: ") and said in err and err.count("\n") == 1


@pytest.mark.parametrize("option", ["--fill-area=small", "--cut", "--together", "--components"])
def test_options_for_holes_of_a_surface_without_any_are_warned_of(desk, capsys, monkeypatch, option):
    monkeypatch.chdir(desk)
    status, err = run(capsys, "map", "ball.ply", "-o", "b.npz", "--until", "conformal", option)
    assert status == 0 and "options for holes, handles and parts do nothing" in err
    _, err = run(capsys, "map", "open.ply", "-o", "b.npz", "--until", "conformal", "--fill-area", "small")
    assert "do nothing" not in err


def test_six_views_go_with_others():
    ball = shapes.icosphere(2)
    sheet = omtwarp.preview((ball.vertices, ball.faces), views=["six", "30,20"], size=(32, 32), backend="warp")
    seven = [*("front", "back", "left", "right", "top", "bottom"), (30.0, 20.0)]
    again = omtwarp.preview((ball.vertices, ball.faces), views=seven, size=(32, 32), backend="warp")
    np.testing.assert_array_equal(np.asarray(sheet), np.asarray(again))


def test_a_repaired_mesh_without_its_colours_is_warned_of(desk, capsys, tmp_path):
    ball = shapes.icosphere(2)
    painted = omtwarp.PaintedMesh(
        ball.vertices, ball.faces, np.zeros((len(ball.faces), 3, 2)), (Material("m", (1.0, 0.0, 0.0, 1.0)),)
    )
    painted.export(tmp_path / "in.obj")
    lost = f"warning: {tmp_path / 'out.ply'}: without the colours and texture coordinates of {tmp_path / 'in.obj'}"
    assert lost in run(capsys, "check", tmp_path / "in.obj", "--repair", "-o", tmp_path / "out.ply")[1]
    assert "without" not in run(capsys, "check", desk / "open.ply", "--repair", "-o", tmp_path / "out.ply")[1]


def test_a_folder_in_which_nothing_was_written_is_not_left(desk, capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(desk)
    made, own = tmp_path / "made", tmp_path / "own"
    own.mkdir()
    for folder in (made, own):
        assert run(capsys, "map", "open.ply", "gone.ply", "-o", folder)[0] == 1
    assert own.is_dir() and not made.exists()
    assert run(capsys, "map", "ball.ply", "gone.ply", "-o", made, "--until", "conformal")[0] == 1
    assert [file.name for file in made.glob("*.npz")] == ["ball.npz"]
