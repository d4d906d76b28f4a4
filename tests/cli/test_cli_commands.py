"""Commands with good input: their files, summaries, repair and help, and how they end when interrupted."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from omtwarp.commands._cli import main
from omtwarp.errors import OmtwarpError
from omtwarp.maps.result import MapResult
from omtwarp.mesh import shapes
from omtwarp.mesh.read import read_mesh
from omtwarp.mesh.write import SUFFIXES, write_mesh
from omtwarp.metrics.certificate import certify_triangles
from omtwarp.metrics.distortion import measure_triangles


def run(capsys, *arguments) -> tuple[int, str, str]:
    with pytest.raises(SystemExit) as ended:
        main([str(argument) for argument in arguments])
    out, err = capsys.readouterr()
    return int(ended.value.code or 0), out, err


def radial_map(vertices, faces, flip: bool = False) -> MapResult:
    """Project a star-shaped surface from its centre to the sphere: a map that needs no computation."""
    sphere = vertices / np.linalg.norm(vertices, axis=1, keepdims=True)
    if flip:
        sphere[faces[5, 0]] *= -1
    certificate = certify_triangles(faces, sphere, device="cpu").to_dict()
    stage = measure_triangles(vertices, faces, sphere, device="cpu").to_dict() | {"seconds": float("inf")}
    report = {"certificate": certificate, "stages": [stage], "seconds": 1.0}
    return MapResult(vertices, faces, sphere, sphere, np.ones(len(vertices)), report=report)


@pytest.fixture
def radial(monkeypatch):
    """Replace the pipeline of the map command by the radial map, and record the options that reach it."""
    seen = {}

    def make(mesh, mapping, *, quiet, **options):
        seen.update(vars(mapping) | options)
        return radial_map(mesh.vertices, mesh.faces, flip=seen.get("flip", False))

    monkeypatch.setattr("omtwarp.commands.map.make_map", make)
    return seen


@pytest.fixture
def blob(tmp_path):
    surface = shapes.shuffled(shapes.blob(sphere=320), seed=2)
    write_mesh(tmp_path / "blob.ply", surface.vertices, surface.faces)
    return surface


def test_map_writes_the_map_and_the_report(tmp_path, capsys, radial, blob):
    report = tmp_path / "report.json"
    status, out, err = run(
        capsys, "map", tmp_path / "blob.ply", "-o", tmp_path / "blob.npz", "--report", report, "--device", "cpu",
        "--until", "refine", "--cost", "geodesic", "--method", "omt", "--scheme", "paper", "--refine", "0.5",
    )  # fmt: skip
    assert (status, err) == (0, "")
    assert "320 faces; flips 0, degree 1.000000" in out
    with np.load(tmp_path / "blob.npz") as arrays:
        np.testing.assert_array_equal(arrays["vertices"], blob.vertices)
        np.testing.assert_array_equal(arrays["faces"], blob.faces)
    written = json.loads(report.read_text())
    assert written["input"]["path"].endswith("blob.ply") and written["stages"][0]["seconds"] is None
    expected = {"until": "refine", "cost": "geodesic", "method": "omt", "scheme": "paper", "refine": 0.5}
    assert radial == {
        **expected,
        "strict": False,
        "device": "cpu",
        "solver": "auto",
        "exact": False,
        "optimality": True,
        "weights": None,
        "weights_at": "auto",
        "target": None,
        "any_surface": None,
    }


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_map_writes_the_sphere_with_the_faces_of_the_input(tmp_path, capsys, radial, blob, suffix):
    output = tmp_path / f"sphere{suffix}"
    status, out, _ = run(capsys, "map", tmp_path / "blob.ply", "-o", output, "--quiet", "--device", "cpu")
    assert (status, out) == (0, "")
    mesh = read_mesh(output)
    sphere = blob.vertices / np.linalg.norm(blob.vertices, axis=1, keepdims=True)
    exact = suffix in (".ply", ".obj", ".off")
    np.testing.assert_allclose(mesh.vertices[mesh.faces], sphere[blob.faces], atol=0 if exact else 1e-7)
    if suffix != ".stl":
        np.testing.assert_array_equal(mesh.faces, blob.faces)


def test_a_map_that_is_not_one_to_one_is_an_error_and_not_saved(tmp_path, capsys, radial, blob):
    radial["flip"] = True
    status, _, err = run(capsys, "map", tmp_path / "blob.ply", "-o", tmp_path / "blob.npz", "--device", "cpu")
    assert status == 1
    assert "flipped triangles (the first is face " in err and err.count("\n") == 1
    assert not (tmp_path / "blob.npz").exists()


def test_repair_says_what_it_did_and_saves_where_everything_came_from(tmp_path, capsys, blob):
    faces = np.concatenate([blob.faces[1:], blob.faces[[9]]])
    write_mesh(tmp_path / "bad.ply", np.concatenate([[[9.0, 9, 9]], blob.vertices]), faces + 1)
    output = tmp_path / "out.npz"
    options = ["--repair", "--until", "conformal", "--device", "cpu"]
    status, _, err = run(capsys, "map", tmp_path / "bad.ply", "-o", output, *options)
    assert status == 0
    assert "dropped 1 face that were there twice" in err and "filled 1 hole with 1 face" in err
    assert "dropped 1 unused vertex" in err
    with np.load(output) as arrays:
        np.testing.assert_array_equal(arrays["vertex_origin"], np.arange(len(blob.vertices)) + 1)
        np.testing.assert_array_equal(arrays["face_origin"][:-1], np.arange(319))
        assert arrays["face_origin"][-1] == -1
        assert set(arrays) >= {"vertices", "faces", "sphere", "conformal"}


def test_a_mesh_with_defects_beyond_repair_is_refused_after_repair(tmp_path, capsys, radial):
    half = shapes.icosphere(20)
    faces = half.faces[half.vertices[half.faces].mean(axis=1)[:, 2] < 0]
    write_mesh(tmp_path / "half.ply", half.vertices, faces)
    status, _, err = run(capsys, "map", tmp_path / "half.ply", "-o", tmp_path / "out.npz", "--repair")
    assert status == 1
    assert "open boundary: " in err.splitlines()[-1]
    assert not (tmp_path / "out.npz").exists()


def test_check_of_a_sound_mesh(tmp_path, capsys, blob):
    status, out, err = run(capsys, "check", tmp_path / "blob.ply")
    assert (status, err) == (0, "")
    assert "genus 0: it can be mapped" in out


def test_check_repairs_and_writes(tmp_path, capsys, blob):
    write_mesh(tmp_path / "bad.ply", blob.vertices, blob.faces[3:])
    status, out, err = run(capsys, "check", tmp_path / "bad.ply", "--repair", "-o", tmp_path / "good.obj")
    assert (status, err) == (0, "")
    assert "open-boundary: open boundary" in out and "repair: filled" in out
    assert run(capsys, "check", tmp_path / "good.obj")[0] == 0


def test_output_through_a_link_keeps_the_link(tmp_path, capsys, radial, blob):
    (tmp_path / "real").mkdir()
    (tmp_path / "link.npz").symlink_to(tmp_path / "real" / "map.npz")
    assert run(capsys, "map", tmp_path / "blob.ply", "-o", tmp_path / "link.npz", "--device", "cpu")[0] == 0
    assert (tmp_path / "link.npz").is_symlink() and (tmp_path / "real" / "map.npz").is_file()


def test_help_and_version_answer_without_anything_heavy():
    """No array, mesh or kernel library is loaded to print help."""
    heavy = ["numpy", "scipy", "warp", "trimesh", "matplotlib", "pyrender", "PIL"]
    code = "import sys\nfrom omtwarp.commands._cli import main\n"
    code += "try:\n    main(['map', '--help'])\nexcept SystemExit:\n    pass\n"
    code += f"print([name for name in {heavy} if name in sys.modules], file=sys.stderr)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stderr.strip() == "[]"
    assert "--until" in done.stdout


def test_a_map_reads_no_kernels_of_stages_that_it_does_not_have(tmp_path, blob):
    """Kernels of the flow, of baselines and of textures would be read for nothing."""
    unused = ["omtwarp.transport.kernels", "omtwarp.wavelets.kernels", "omtwarp.baselines", "PIL"]
    unused += ["omtwarp.texturing.kernels", "trimesh", "rich"]
    code = "import sys\nfrom omtwarp.commands._cli import main\n"
    code += "try:\n    main(sys.argv[1:])\nexcept SystemExit:\n    pass\n"
    code += f"print([name for name in {unused} if name in sys.modules])\n"
    argv = ["map", tmp_path / "blob.ply", "-o", tmp_path / "blob.npz", "--quiet", "--device", "cpu"]
    done = subprocess.run([sys.executable, "-c", code, *argv], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines() == ["[]"]


def test_one_command_by_itself_has_the_help_and_the_completion_of_all(capsys):
    """Only the command that is asked for is read; what is no command is refused with all of them in mind."""
    shown = {name: run(capsys, *name) for name in (("map", "--help"), ("--help",), ("mapp",))}
    assert shown[("map", "--help")][0] == 0 and "Usage: omtwarp map [OPTIONS]" in shown[("map", "--help")][1]
    assert all(name in shown[("--help",)][1] for name in ("map", "texture", "report", "check"))
    assert shown[("mapp",)][0] == 2 and "Did you mean" in shown[("mapp",)][2]


def test_python_m_omtwarp_and_version(capsys):
    done = subprocess.run([sys.executable, "-m", "omtwarp", "--version"], capture_output=True, text=True, check=True)
    assert done.stdout.startswith("omtwarp ") and done.stderr == ""


# Work without end: in steps that hold the interpreter's lock, and in native code that has let it go.
BUSY = {
    "holding": "[sum(range(10**7)) for _ in iter(int, 1)]",
    "released": "import hashlib; hashlib.pbkdf2_hmac('sha256', b'', b'', 2**31 - 1)",
}

WORKER = """
import signal, sys
# Tests that run in the background of a script have been told to ignore the signal, which a child inherits.
signal.signal(signal.SIGINT, signal.default_int_handler)
from pathlib import Path
import omtwarp.commands.map as map_command
from omtwarp.commands import _cli as cli
def busy(*args, **options):
    print("busy", file=sys.stderr, flush=True)
    {busy}
def save(result, file, **options):
    file.write_bytes(b"half")
    busy()
if {staged}:
    map_command.make_map = lambda *args, **options: None
    map_command.require_bijective = lambda result: None
    map_command.save = save
else:
    map_command.make_map = busy
cli.main(["map", sys.argv[1], "-o", sys.argv[2], "--device", "cpu"])
"""


@pytest.mark.skipif(os.name != "posix", reason="signals are POSIX")
@pytest.mark.parametrize(("kind", "stage"), [("holding", False), ("released", False), ("released", True)])
def test_an_interruption_ends_native_code_and_leaves_no_partial_file(tmp_path, blob, kind, stage):
    """Control-C during a computation or a write ends the process with one line and leaves no partial file."""
    code = WORKER.format(busy=BUSY[kind], staged=stage)
    command = [sys.executable, "-c", code, str(tmp_path / "blob.ply"), str(tmp_path / "out.npz")]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    assert process.stderr.readline() == "busy\n"
    time.sleep(0.2)
    process.send_signal(signal.SIGINT)
    try:
        status = process.wait(timeout=60)  # the computation itself would take hours
    finally:
        process.kill()
    assert status in (-signal.SIGINT, 130)
    assert process.stderr.read() == "omtwarp: interrupted\n"
    assert [path.name for path in tmp_path.iterdir()] == ["blob.ply"]


# The import of a module is where the signal comes: what has read none of its lines yet cannot have installed a handler.
EARLY = """
import importlib.abc, os, runpy, signal, sys, time
signal.signal(signal.SIGINT, signal.default_int_handler)
module = sys.argv.pop(1)
class Interrupting(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path, target=None):
        if name == module:
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(60)
sys.meta_path.insert(0, Interrupting())
runpy.run_module("omtwarp", run_name="__main__")
"""


@pytest.mark.skipif(os.name != "posix", reason="signals are POSIX")
@pytest.mark.parametrize(
    "module", ["omtwarp.files.interruptions", "omtwarp.commands._cli", "omtwarp.commands.map", "click"]
)
def test_an_interruption_while_the_command_is_read_gives_one_line(module):
    """Control-C before the command line has been read ends the process with one line too."""
    done = subprocess.run(
        [sys.executable, "-c", EARLY, module, "map"], check=False, capture_output=True, text=True, timeout=60
    )
    assert done.returncode in (-signal.SIGINT, 130)
    assert done.stderr == "omtwarp: interrupted\n"


def test_no_progress_where_nobody_looks(capsys):
    from omtwarp.commands._streams import progress_bar

    with progress_bar() as progress:
        assert progress is None


def test_progress_on_a_terminal(monkeypatch, capsys):
    from omtwarp.commands._streams import progress_bar

    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    with progress_bar(quiet=True) as progress:
        assert progress is None
    with progress_bar() as progress:
        progress("moser", 1, 2, {})
        progress("omt", 3, 40, {"cost": 0.25, "flips": 0})
    err = capsys.readouterr().err
    assert (
        "50%" in err
        and "moser" in err
        and "omt" in err
        and "cost 0.25" in err
        and "flips 0" in err
        and "\x1b[?25l" not in err
    )


def test_importing_the_package_loads_nothing_heavy():
    code = "import sys, omtwarp; print([n for n in ('numpy', 'warp', 'trimesh') if n in sys.modules]); dir(omtwarp)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_public_names():
    import omtwarp

    assert set(omtwarp.__all__) <= set(dir(omtwarp))
    assert all(getattr(omtwarp, name) is not None for name in omtwarp.__all__)
    assert omtwarp.OmtwarpError is OmtwarpError and omtwarp.shapes is shapes
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = omtwarp.nothing
