"""Hostile places to write to: what is there is never lost, and the API and the command line behave alike."""

from __future__ import annotations

import os
import stat
import subprocess
import sys
import time

import numpy as np
import pytest
from PIL import Image

from omtwarp.commands._cli import main
from omtwarp.errors import OmtwarpError
from omtwarp.files import output as files
from omtwarp.maps.result import MapResult
from omtwarp.mesh import shapes
from omtwarp.mesh.write import write_mesh
from omtwarp.render.output import save_film, save_still
from omtwarp.reporting import write_report
from omtwarp.texturing import texture

posix = pytest.mark.skipif(os.name != "posix", reason="of POSIX")


def ball_map(frequency: int = 3) -> MapResult:
    """A sphere mapped to itself: a map that needs no computation."""
    ball = shapes.icosphere(frequency)
    count = len(ball.vertices)
    return MapResult(ball.vertices, ball.faces, ball.vertices, ball.vertices, np.ones(count), report={"seconds": 1.0})


RESULT = ball_map()
EARTH = np.zeros((32, 64, 3), np.uint8)


def textured(image=EARTH):
    return texture(RESULT, image, atlas="equirectangular", size=64, device="cpu")


WRITERS = {
    "mesh.ply": lambda path: write_mesh(path, RESULT.vertices, RESULT.faces),
    "mesh.obj": lambda path: write_mesh(path, RESULT.vertices, RESULT.faces),
    "mesh.off": lambda path: write_mesh(path, RESULT.vertices, RESULT.faces),
    "mesh.stl": lambda path: write_mesh(path, RESULT.vertices, RESULT.faces),
    "mesh.glb": lambda path: write_mesh(path, RESULT.vertices, RESULT.faces),
    "map.npz": RESULT.save,
    "textured.glb": lambda path: textured().export(path),
    "textured.obj": lambda path: textured().export(path),
    "textured.ply": lambda path: textured().export(path),
    "picture.png": lambda path: save_still(Image.fromarray(EARTH), path),
    "picture.jpg": lambda path: save_still(Image.fromarray(EARTH), path),
    "film.gif": lambda path: save_film([Image.fromarray(EARTH)] * 3, path, 10.0),
    "film.mp4": lambda path: save_film([Image.fromarray(EARTH)] * 3, path, 10.0),
}


@pytest.fixture(params=WRITERS)
def writer(request):
    """Return a file's name and a function that writes such a file."""
    if request.param.endswith("mp4"):
        pytest.importorskip("imageio_ffmpeg")
    return request.param, WRITERS[request.param]


def error_of(action) -> str:
    with pytest.raises(OmtwarpError) as caught:
        action()
    assert "\n" not in str(caught.value) and files.PREFIX not in str(caught.value)
    return str(caught.value)


@posix
def test_pipes_devices_and_folders_are_refused_and_stay(tmp_path, writer):
    name, write = writer
    os.mkfifo(tmp_path / name)
    assert "not a regular file" in error_of(lambda: write(tmp_path / name))
    assert stat.S_ISFIFO(os.lstat(tmp_path / name).st_mode)
    (tmp_path / name).unlink()
    (tmp_path / name).symlink_to("/dev/null")
    assert "not a regular file" in error_of(lambda: write(tmp_path / name))
    assert os.readlink(tmp_path / name) == "/dev/null" and stat.S_ISCHR(os.stat("/dev/null").st_mode)
    (tmp_path / name).unlink()
    (tmp_path / name).mkdir()
    assert "a directory" in error_of(lambda: write(tmp_path / name))
    (tmp_path / name).rmdir()
    (tmp_path / name).symlink_to(tmp_path / name)
    assert "leads to itself" in error_of(lambda: write(tmp_path / name))
    assert (tmp_path / name).is_symlink() and len(list(tmp_path.iterdir())) == 1


@posix
def test_the_mode_and_the_link_are_kept(tmp_path, writer):
    name, write = writer
    (tmp_path / "real").mkdir()
    real = tmp_path / "real" / name
    real.write_bytes(b"old")
    real.chmod(0o600)
    (tmp_path / name).symlink_to(real)
    write(tmp_path / name)
    assert (tmp_path / name).is_symlink() and stat.S_IMODE(real.stat().st_mode) == 0o600
    assert real.stat().st_size > 3 and sorted(os.listdir(tmp_path)) == sorted(["real", name])


@posix
def test_a_new_file_has_the_mode_of_other_new_files(tmp_path, writer):
    name, write = writer
    (tmp_path / "plain").write_bytes(b"")
    write(tmp_path / name)
    assert stat.S_IMODE((tmp_path / name).stat().st_mode) == stat.S_IMODE((tmp_path / "plain").stat().st_mode)


def test_names_that_no_file_can_have(tmp_path, writer):
    name, write = writer
    stem, suffix = os.path.splitext(name)
    for bad in (tmp_path / (stem * 90 + suffix), tmp_path / "none" / name, tmp_path / (stem + "\0" + suffix)):
        assert "cannot write" in error_of(lambda bad=bad: write(bad))
    assert list(tmp_path.iterdir()) == []


def test_pictures_and_materials_of_others_are_kept(tmp_path):
    for name in ("world.png", "world.mtl"):
        (tmp_path / name).write_bytes(b"the user's")
    written = textured().export(tmp_path / "world.obj")
    assert [path.name for path in written] == ["world-texture.png", "world-texture.mtl", "world.obj"]
    assert (tmp_path / "world.png").read_bytes() == (tmp_path / "world.mtl").read_bytes() == b"the user's"
    assert "mtllib world-texture.mtl" in (tmp_path / "world.obj").read_text()
    assert "map_Kd world-texture.png" in (tmp_path / "world-texture.mtl").read_text()
    # Again: the package's own files are replaced, and no third name is needed.
    assert textured().export(tmp_path / "world.obj") == written and len(list(tmp_path.iterdir())) == 6


def test_a_texture_that_is_an_input_is_kept_although_the_package_wrote_it(tmp_path):
    first = textured().export(tmp_path / "earth.obj")
    assert [path.name for path in first] == ["earth.png", "earth.mtl", "earth.obj"]
    before = (tmp_path / "earth.png").read_bytes()
    again = textured(tmp_path / "earth.png").export(tmp_path / "earth.obj")
    assert again[0].name == "earth-texture.png" and (tmp_path / "earth.png").read_bytes() == before


@posix
def test_a_link_with_the_name_of_a_companion_is_kept(tmp_path):
    (tmp_path / "world.png").symlink_to(tmp_path / "nowhere.png")
    assert textured().export(tmp_path / "world.obj")[0].name == "world-texture.png"
    assert (tmp_path / "world.png").is_symlink() and not (tmp_path / "nowhere.png").exists()


def test_the_command_keeps_its_picture(tmp_path, capsys):
    RESULT.save(tmp_path / "map.npz")
    Image.fromarray(EARTH).save(tmp_path / "world.png")
    before = (tmp_path / "world.png").read_bytes()
    words = ["texture", "--map", "map.npz", "-o", "world.obj", "--image", "world.png", "--atlas", "equirectangular"]
    words = [str(tmp_path / word) if "." in word else word for word in words]
    with pytest.raises(SystemExit) as ended:
        main([*words, "--device", "cpu"])
    assert not ended.value.code
    assert (tmp_path / "world.png").read_bytes() == before
    assert "world-texture.png" in capsys.readouterr().out


def test_what_a_stage_leaves_beside_its_file_replaces_nothing(tmp_path):
    (tmp_path / "it.mtl").write_text("the user's")
    with pytest.raises(OmtwarpError, match=r"it\.mtl' would be replaced"), files.staged(tmp_path / "it.obj") as file:
        file.write_text("surface")
        file.with_suffix(".mtl").write_text("material")
    assert os.listdir(tmp_path) == ["it.mtl"] and (tmp_path / "it.mtl").read_text() == "the user's"


def test_the_demo_replaces_only_a_demo(tmp_path, capsys):
    (tmp_path / "map.npz").write_bytes(b"the user's")
    with pytest.raises(SystemExit) as ended:
        main(["demo", "-o", str(tmp_path), "--faces", "2000", "--device", "cpu"])
    assert ended.value.code == 1 and "another directory" in capsys.readouterr().err
    assert (tmp_path / "map.npz").read_bytes() == b"the user's" and len(list(tmp_path.iterdir())) == 1


def test_a_report_checks_its_place_before_the_work(tmp_path):
    (tmp_path / "page.html").mkdir()
    assert "a directory" in error_of(lambda: write_report(None, tmp_path / "page.html"))


FULL = """
import resource, signal, sys
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (200, 200))
sys.path.insert(0, sys.argv[1])
from test_outputs import WRITERS
from omtwarp.errors import OmtwarpError
for name, write in WRITERS.items():
    try:
        write(sys.argv[2] + "/" + name)
        print(name, "written")
    except OmtwarpError as error:
        print(name, error)
"""


@posix
def test_a_full_disk_names_the_users_file(tmp_path):
    """Where files are limited to 200 bytes, as on a full disk, the error names the file that the user asked for."""
    # -B: bytecode that is cut at 200 bytes would break every later import.
    command = [sys.executable, "-B", "-c", FULL, os.path.dirname(__file__), str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    lines = dict(line.split(" ", 1) for line in done.stdout.splitlines())
    assert set(lines) == set(WRITERS), done.stderr
    for name, line in lines.items():
        if line != "written":
            assert f"cannot write '{tmp_path}/{name}'" in line and files.PREFIX not in line, (name, line)
    assert sum(line != "written" for line in lines.values()) >= 8
    assert sorted(os.listdir(tmp_path)) == sorted(name for name in lines if lines[name] == "written")


def aged(folder, seconds: float) -> None:
    then = time.time() - seconds
    for path in (*folder.iterdir(), folder):
        os.utime(path, (then, then))


@posix
def test_folders_left_by_killed_processes_are_swept(tmp_path):
    """Old staging folders that no process holds are removed; young ones, held ones and all other files stay."""
    code = """
import os, sys, time
from pathlib import Path
from omtwarp.files.output import staged
with staged(Path(sys.argv[1])) as file:
    file.write_text("half")
    print("ready", flush=True)
    time.sleep(600)
"""
    processes = [
        subprocess.Popen([sys.executable, "-c", code, str(tmp_path / name)], stdout=subprocess.PIPE, text=True)
        for name in ("killed.ply", "young.ply", "living.ply")
    ]
    try:
        assert all(process.stdout.readline() == "ready\n" for process in processes)
        for process in processes[:2]:
            process.kill()
            process.wait()
        found = {next(folder.glob("*.ply")).stem: folder for folder in tmp_path.glob(files.PREFIX + "*")}
        assert set(found) == {"killed", "young", "living"}
        for name in ("killed", "living"):
            aged(found[name], 2 * files.STALE_SECONDS)
        (tmp_path / f"{files.PREFIX}notes").write_text("a file")
        os.utime(tmp_path / f"{files.PREFIX}notes", (0, 0))
        write_mesh(tmp_path / "mesh.ply", RESULT.vertices, RESULT.faces)
        assert not found["killed"].exists() and found["living"].exists() and found["young"].exists()
        assert (tmp_path / f"{files.PREFIX}notes").exists()
    finally:
        for process in processes:
            process.kill()
            process.wait()
