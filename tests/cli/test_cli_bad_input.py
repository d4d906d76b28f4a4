"""Bad input to the command line: a status other than 0, one clear line, no traceback, and nothing left behind."""

from __future__ import annotations

import os

import numpy as np
import pytest

from omtwarp.commands._cli import main
from omtwarp.errors import OmtwarpError, with_options
from omtwarp.mesh import shapes
from omtwarp.mesh.read import read_mesh
from omtwarp.mesh.validate import require_valid
from omtwarp.mesh.write import write_mesh


def run(capsys, *arguments) -> tuple[int, str, str]:
    """Run a command; return its exit status, standard output and standard error."""
    with pytest.raises(SystemExit) as ended:
        main([str(argument) for argument in arguments])
    out, err = capsys.readouterr()
    code = ended.value.code
    return (0 if code is None else int(code)), out, err


def assert_one_line(err: str, *words: str) -> None:
    assert err.startswith("omtwarp: error: "), err
    assert err.count("\n") == 1 and err.endswith("\n"), err
    assert "Traceback" not in err
    for word in words:
        assert word in err


def ball() -> tuple[np.ndarray, np.ndarray]:
    sphere = shapes.icosphere(3)
    return sphere.vertices.copy(), sphere.faces.astype(np.int64)


def torus() -> tuple[np.ndarray, np.ndarray]:
    u, v = np.meshgrid(2 * np.pi * np.arange(12) / 12, 2 * np.pi * np.arange(9) / 9, indexing="ij")
    ring = 2 + 0.7 * np.cos(v)
    vertices = np.stack([ring * np.cos(u), ring * np.sin(u), 0.7 * np.sin(v)], axis=2).reshape(-1, 3)
    at = np.arange(108).reshape(12, 9)
    right, up = np.roll(at, -1, axis=0), np.roll(at, -1, axis=1)
    both = np.roll(right, -1, axis=1)
    return vertices, np.concatenate([np.stack(t, axis=2).reshape(-1, 3) for t in ((at, right, both), (at, both, up))])


def bad_meshes() -> dict[str, tuple[np.ndarray, np.ndarray, str, str]]:
    """Return bad meshes with the words that their error lines need: the defect, its number and place, the remedy."""
    v, f = ball()
    cases = {}
    cases["open"] = (
        v,
        f[1:],
        "open boundary: 3 edges with one face, in 1 hole, a loop of 3 edges at vertex",
        "--repair",
    )
    fin = np.concatenate([f, [[f[0, 0], f[0, 1], 92]]])
    fin_points = np.concatenate([v, [[3.0, 0, 0]]])
    cases["fin"] = (fin_points, fin, "1 non-manifold edge (more than two faces), first between", "--repair")
    a, b = int(np.argmax(v[:, 2])), int(np.argmin(v[:, 2]))
    glued = np.where(f == b, a, f)
    glued = np.where(glued > b, glued - 1, glued)
    cases["pinched"] = (np.delete(v, b, axis=0), glued, "1 non-manifold vertex", "split them with --repair")
    g = f.copy()
    g[6] = g[6, ::-1]
    cases["turned"] = (v, g, "inconsistent orientation: 3 edges", "--repair")
    cases["inward"] = (v, f[:, ::-1], "inward orientation: all 180 faces", "--repair")
    two = (np.concatenate([v, v + 5]), np.concatenate([f, f + 92]))
    words = "2 components, the largest with 180 of 360 faces, first face of another is 180"
    cases["two pieces"] = (*two, words, "--repair")
    words = "genus 1, not 0: 1 handle, a loop around the first runs through vertices"
    cases["torus"] = (*torus(), words, "cut the handles")
    cases["twice"] = (v, np.concatenate([f, f[[3]]]), "1 duplicate face, first face 180", "--repair")
    w = v.copy()
    w[f[40, 2]] = w[f[40, 0]]
    cases["no area"] = (w, f, "2 faces of zero area, first face", "--repair")
    cases["unused"] = (np.concatenate([v, v[:2] * 2]), f, "2 vertices in no face, first vertex 92", "--repair")
    w = v.copy()
    w[7, 1] = np.nan
    cases["nan"] = (w, f, "1 vertex with NaN or infinite coordinates, first vertex 7", "--repair")
    w = v.copy()
    w[8:10, 1] = np.inf
    cases["inf"] = (w, f, "2 vertices with NaN or infinite coordinates, first vertex 8", "--repair")
    g = f.copy()
    g[11, 0] = 99
    cases["index"] = (v, g, "1 face with a vertex index out of range, first face 11", "--repair")
    return cases


@pytest.mark.parametrize("name", bad_meshes())
@pytest.mark.parametrize("command", ["map", "texture"])
def test_bad_meshes_are_refused_with_the_text_of_the_python_error(tmp_path, capsys, command, name):
    vertices, faces, defect, remedy = bad_meshes()[name]
    write_mesh(tmp_path / "bad.ply", vertices, faces)
    output = tmp_path / ("out.npz" if command == "map" else "out.glb")
    status, out, err = run(capsys, command, tmp_path / "bad.ply", "-o", output, "--device", "cpu")
    assert status == 1 and out == ""
    assert_one_line(err, "bad.ply", defect, remedy)
    mesh = read_mesh(tmp_path / "bad.ply")
    with pytest.raises(OmtwarpError) as caught:
        require_valid(mesh.vertices, mesh.faces, str(tmp_path / "bad.ply"))
    assert err == f"omtwarp: error: {with_options(str(caught.value))}\n"
    assert [path.name for path in tmp_path.iterdir()] == ["bad.ply"]


@pytest.mark.parametrize("name", bad_meshes())
def test_check_lists_defects_and_fails(tmp_path, capsys, name):
    vertices, faces, defect, remedy = bad_meshes()[name]
    write_mesh(tmp_path / "bad.ply", vertices, faces)
    status, out, err = run(capsys, "check", tmp_path / "bad.ply")
    assert status == 1
    assert defect in out and remedy in out
    assert_one_line(err, "of defect, see above")


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("missing.ply", None, "no such file"),
        ("empty.ply", b"", "an empty file"),
        ("noise.ply", b"no mesh\nat all\n", "cannot be read as ply"),
        ("noise.glb", b"\0\1\2" * 99, "cannot be read as glb"),
        ("mesh.docx", b"PK", "unknown format '.docx'"),
        ("none.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\n", "not a triangle mesh"),
        ("nothing.off", b"OFF\n0 0 0\n", "no faces in it"),
    ],
)
@pytest.mark.parametrize("command", ["map", "texture", "preview", "check"])
def test_unreadable_files(tmp_path, capsys, command, name, content, words):
    if command == "preview" and name == "quads.obj":
        pytest.skip("quads can be drawn")
    if content is not None:
        (tmp_path / name).write_bytes(content)
    before = sorted(tmp_path.iterdir())
    outputs = {"map": "out.npz", "texture": "out.glb", "preview": "out.png"}
    rest = ["-o", tmp_path / outputs[command]] if command in outputs else []
    status, out, err = run(capsys, command, tmp_path / name, *rest)
    assert status == 1 and out == ""
    assert_one_line(err, name)
    if command != "preview":  # which reads textured meshes with a reader of its own
        assert words in err
    assert sorted(tmp_path.iterdir()) == before


def good(tmp_path):
    write_mesh(tmp_path / "good.ply", *ball())
    return tmp_path / "good.ply"


@pytest.mark.parametrize(
    ("device", "words"),
    [("gpu", "unknown device 'gpu'"), ("cuda:x", "unknown device 'cuda:x'"), ("CPU ", "unknown device")],
)
def test_unknown_devices(tmp_path, capsys, device, words):
    status, _, err = run(capsys, "map", good(tmp_path), "-o", tmp_path / "out.npz", "--device", device)
    assert status == 2 and words in " ".join(err.split()) and "Traceback" not in err


def test_cuda_where_there_is_none(tmp_path, capsys):
    from omtwarp.device.start import wp

    if wp.is_cuda_available():
        pytest.skip("this machine has a CUDA device")
    status, _, err = run(capsys, "map", good(tmp_path), "-o", tmp_path / "out.npz", "--device", "cuda:0")
    assert status == 1
    assert_one_line(err, "cuda:0", "--device cpu")
    assert not (tmp_path / "out.npz").exists()


def unwritable(tmp_path) -> dict[str, tuple]:
    (tmp_path / "file").write_text("kept")
    (tmp_path / "folder.npz").mkdir()
    return {
        "no folder": (tmp_path / "none" / "out.npz", "there is no directory"),
        "a file as folder": (tmp_path / "file" / "out.npz", "there is no directory"),
        "a folder": (tmp_path / "folder.npz", "it is a directory"),
        "a device": ("/dev/null", "unknown suffix ''"),
        "kernel's": ("/proc/out.npz", "cannot write '/proc/out.npz'"),
        "other suffix": (tmp_path / "out.docx", "unknown suffix '.docx', use .npz, .ply"),
        "the input": (tmp_path / "good.ply", "it is the input"),
    }


@pytest.mark.parametrize(
    "case", ["no folder", "a file as folder", "a folder", "a device", "kernel's", "other suffix", "the input"]
)
def test_unwritable_outputs_are_found_before_the_work_starts(tmp_path, capsys, monkeypatch, case):
    mesh = good(tmp_path)
    content = mesh.read_bytes()

    def never(*args, **options):
        raise AssertionError("the work was started")

    monkeypatch.setattr("omtwarp.commands.map.make_map", never)
    output, words = unwritable(tmp_path)[case]
    if case == "kernel's" and not os.path.isdir("/proc/self"):
        pytest.skip("no /proc here")
    status, out, err = run(capsys, "map", mesh, "-o", output)
    assert status == 1 and out == ""
    assert_one_line(err, words)
    assert mesh.read_bytes() == content and (tmp_path / "file").read_text() == "kept"
    assert not list(tmp_path.rglob(".omtwarp-*"))


def test_unwritable_report(tmp_path, capsys):
    report = tmp_path / "none" / "report.json"
    status, _, err = run(capsys, "map", good(tmp_path), "-o", tmp_path / "out.npz", "--report", report)
    assert status == 1
    assert_one_line(err, "report.json", "there is no directory")


@pytest.mark.parametrize("content", [b"", b"no picture", b"\x89PNG\r\n\x1a\n cut short"])
def test_images_that_are_none(tmp_path, capsys, content):
    (tmp_path / "earth.png").write_bytes(content)
    output = tmp_path / "out.glb"
    status, _, err = run(
        capsys, "texture", good(tmp_path), "-o", output, "--image", tmp_path / "earth.png", "--device", "cpu"
    )
    assert status == 1
    assert_one_line(err, "earth.png")
    assert not output.exists()


def test_maps_that_are_none(tmp_path, capsys):
    for name, content in (("text.npz", b"no map"), ("zip.npz", None)):
        if content is None:
            np.savez(tmp_path / name, points=np.zeros(3))
        else:
            (tmp_path / name).write_bytes(content)
        status, _, err = run(capsys, "texture", "--map", tmp_path / name, "-o", tmp_path / "out.glb", "--device", "cpu")
        assert status == 1
        assert_one_line(err, name)
    status, _, err = run(capsys, "texture", "--map", tmp_path / "none.npz", "-o", tmp_path / "out.glb")
    assert status == 1
    assert_one_line(err, "none.npz", "no such file")


@pytest.mark.parametrize(
    "arguments",
    [
        ["map"],
        ["map", "it.ply"],
        ["map", "it.ply", "-o", "out.npz", "--until", "soon"],
        ["map", "it.ply", "-o", "out.npz", "--refine", "0"],
        ["map", "it.ply", "-o", "out.npz", "--refine", "nan"],
        ["map", "it.ply", "-o", "out.npz", "--radius", "nan"],
        ["map", "it.ply", "-o", "out.npz", "--cost"],
        ["preview", "it.ply", "-o", "out.png", "--size", "0x10"],
        ["preview", "it.ply", "-o", "out.png", "--size", "large"],
        ["texture", "it.ply", "-o", "out.glb", "--pattern", "stripes"],
        ["demo", "--faces", "10"],
        ["knit"],
        ["--nothing"],
    ],
)
def test_wrong_usage_has_status_2(capsys, arguments):
    status, _, err = run(capsys, *arguments)
    assert status == 2
    assert "Error: " in err and "Traceback" not in err


def test_texture_wants_one_subject_and_one_source(tmp_path, capsys):
    mesh, out = good(tmp_path), tmp_path / "out.glb"
    status, _, err = run(capsys, "texture", "-o", out)
    assert status == 1
    assert_one_line(err, "give a mesh")
    status, _, err = run(capsys, "texture", mesh, "--map", tmp_path / "m.npz", "-o", out, "--device", "cpu")
    assert status == 1
    assert_one_line(err, "add one of them")
    status, _, err = run(capsys, "texture", mesh, "-o", out, "--image", "a.png", "--pattern", "globe")
    assert status == 1
    assert_one_line(err, "--image and --pattern")
    status, _, err = run(capsys, "texture", mesh, "-o", out, "--rotate", "10,20")
    assert status == 1
    assert_one_line(err, "--rotate '10,20'")


def test_errors_nobody_thought_of_are_one_line_too(tmp_path, capsys, monkeypatch):
    def broken(*args, **options):
        raise ZeroDivisionError("two\nlines")

    monkeypatch.setattr("omtwarp.commands.map.make_map", broken)
    status, _, err = run(capsys, "map", good(tmp_path), "-o", tmp_path / "out.npz", "--device", "cpu")
    assert status == 1
    assert_one_line(err, "internal error, ZeroDivisionError: two lines")
