"""Commands for finished maps in hostile places: one line and exit status 1, or the output; nothing left or replaced."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from omtwarp.commands._cli import main
from omtwarp.files import output as files
from omtwarp.maps.result import MapResult
from omtwarp.mesh import shapes
from omtwarp.mesh.write import write_mesh

pytestmark = pytest.mark.skipif(os.name != "posix", reason="of POSIX")

# Every command with an output, without -o, and the output.
COMMANDS = {
    "align": (["align", "map.npz"], "out.npz"),
    "resample": (["resample", "map.npz", "--to", "ico1"], "out.ply"),
    "spharm": (["spharm", "--map", "map.npz", "--degree", "2"], "out.coef"),
    "group": (["group", "map.npz", "map.npz", "--grid", "ico1", "--degree", "2"], "study"),
    "film": (["film", "map.npz", "--size", "16x16", "--seconds", "0.2", "--fps", "2", "--backend", "warp"], "out.gif"),
    "transfer": (
        ["transfer", "own.glb", "own.glb", "--map-from", "map.npz", "--map-to", "map.npz", "--size", "16"],
        "out.glb",
    ),
    "unwrap": (["unwrap", "map.npz"], "out.glb"),
    "texture": (["texture", "own.glb", "--map", "map.npz", "--uv", "own", "--size", "16"], "out.glb"),
}
FOLDERS = ("group",)  # write into a folder
SINGLE = [name for name in COMMANDS if name not in FOLDERS]


@pytest.fixture(scope="module")
def inputs(tmp_path_factory):
    """A folder with a map and a mesh with texture coordinates."""
    folder = tmp_path_factory.mktemp("inputs")
    ball = shapes.icosphere(2)
    ovoid = ball.vertices * [1.0, 1.3, 1.7]
    MapResult(ovoid, ball.faces, ball.vertices, ball.vertices, np.ones(ball.vertex_count)).save(folder / "map.npz")
    finished, plain, own = (str(folder / name) for name in ("map.npz", "plain.glb", "own.glb"))
    for words in (["unwrap", finished, "-o", plain], ["texture", plain, "--map", finished, "--uv", "own", "-o", own]):
        with pytest.raises(SystemExit) as end:
            main(words + ["--size", "16"] * (words[0] == "texture"))
        assert not end.value.code
    return folder


@pytest.fixture
def place(inputs, tmp_path, monkeypatch, small_pictures):
    """A working folder with copies of the inputs."""
    for file in inputs.iterdir():
        shutil.copy(file, tmp_path)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def ended(capsys, words) -> tuple[int, str]:
    """Run a command; return its exit status and the last line on standard error."""
    with pytest.raises(SystemExit) as end:
        main(words)
    text = capsys.readouterr().err
    assert "Traceback" not in text and "internal error" not in text and files.PREFIX not in text
    lines = [line for line in text.splitlines() if line.startswith("omtwarp: error: ")]
    status = end.value.code or 0
    assert (status == 0) == (not lines) and len(lines) <= 1, text
    return status, lines[0] if lines else ""


def listing(folder) -> dict[str, tuple]:
    """List a folder: names, kinds and times of modification."""
    return {path.name: (os.lstat(path).st_mode, os.lstat(path).st_mtime_ns) for path in folder.iterdir()}


@pytest.mark.parametrize("name", COMMANDS)
def test_outputs_that_are_no_files_are_refused_before_the_work(place, capsys, name):
    words, output = COMMANDS[name]
    os.mkfifo("pipe" + os.path.splitext(output)[1])
    os.symlink("/dev/full", "full" + os.path.splitext(output)[1])
    if name in FOLDERS:
        (place / "file").write_text("the user's")
    else:
        (place / ("folder" + os.path.splitext(output)[1])).mkdir()
    before = listing(place)
    bad = ["pipe", "full", "folder"] if name in SINGLE else ["pipe", "full", "file"]
    for kind in bad:
        there = kind + os.path.splitext(output)[1]
        status, line = ended(capsys, [*words, "-o", there])
        assert status == 1 and there in line, (kind, line)
    assert listing(place) == before


@pytest.mark.parametrize("name", SINGLE)
def test_a_link_is_followed_and_kept(place, capsys, name):
    words, output = COMMANDS[name]
    (place / "real").mkdir()
    (place / output).symlink_to(place / "real" / output)
    status, line = ended(capsys, [*words, "-o", output])
    assert status == 0, line
    assert (place / output).is_symlink() and (place / "real" / output).stat().st_size > 20
    assert not list(place.rglob(files.PREFIX + "*"))


@pytest.mark.parametrize("name", [*COMMANDS, "distance"])
def test_inputs_that_are_folders_or_missing(place, capsys, name):
    words, output = COMMANDS.get(name, (["distance", "map.npz", "map.npz", "--degree", "2"], ""))
    (place / "folder.npz").mkdir()
    before = listing(place)
    for bad in ("folder.npz", "missing.npz"):
        status, line = ended(
            capsys, [bad if word == "map.npz" else word for word in words] + ["-o", output] * bool(output)
        )
        assert status == 1 and bad in line, line
    assert listing(place) == before


@pytest.mark.parametrize("name", COMMANDS)
def test_an_interruption_leaves_nothing(place, monkeypatch, name):
    """An interruption between writing the staged output and moving it to its place leaves no file."""
    words, output = COMMANDS[name]

    def interrupted(*_):
        raise KeyboardInterrupt

    before = listing(place)
    monkeypatch.setattr(files, "_move", interrupted)
    with pytest.raises((SystemExit, KeyboardInterrupt)) as end:
        main([*words, "-o", output])
    assert end.type is KeyboardInterrupt or end.value.code == 130
    if (place / "study").is_dir():
        assert not list((place / "study").iterdir())
        (place / "study").rmdir()
    assert listing(place) == before


PARTIAL = {
    "spharm": ["spharm", "--map", "part.npz", "--degree", "2", "-o", "out.coef"],
    "distance": ["distance", "map.npz", "part.npz", "--degree", "2"],
    "group": ["group", "map.npz", "part.npz", "--grid", "ico1", "--degree", "2", "-o", "study"],
}


@pytest.mark.parametrize("name", PARTIAL)
def test_maps_that_cover_a_part_of_the_sphere_have_no_harmonics(place, capsys, name):
    ball = shapes.icosphere(2)
    upper = ball.vertices[:, 2] > -1e-9
    used, faces = np.unique(ball.faces[upper[ball.faces].all(axis=1)], return_inverse=True)
    points = ball.vertices[used]
    faces = faces.reshape(-1, 3)
    MapResult(points, faces, points, points, np.ones(len(points)), domain="hemisphere").save(place / "part.npz")
    before = listing(place)
    status, line = ended(capsys, PARTIAL[name])
    assert status == 1 and "'part.npz': a map to a hemisphere does not cover the sphere" in line
    assert listing(place) == before


INTERRUPTED = """
import signal
signal.signal(signal.SIGINT, signal.default_int_handler)  # which a child of a script in the background lacks
from omtwarp.commands._cli import main
main()
"""


def hosts(folder) -> list[int]:
    """List the processes of a cohort that runs in a folder; none on systems without /proc."""
    found = []
    for entry in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            if b"omtwarp.cohort" in (entry / "cmdline").read_bytes() and os.readlink(entry / "cwd") == str(folder):
                found.append(int(entry.name))
    return found


def test_an_interrupted_cohort_leaves_no_process_and_no_partial_file(tmp_path):
    """An interrupted cohort ends its running item, longer than the test waits, and leaves no partial file."""
    if not os.path.isdir("/proc/self"):
        pytest.skip("processes are looked for in /proc")
    surface = shapes.icosphere(100)
    write_mesh(tmp_path / "ball.ply", surface.vertices, surface.faces)
    command = [sys.executable, "-c", INTERRUPTED, "cohort", "*.ply", "-o", "out", "--workers", "1"]
    driver = subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.PIPE, text=True)
    try:
        deadline = time.monotonic() + 60
        while len(hosts(tmp_path)) < 2 and driver.poll() is None and time.monotonic() < deadline:
            time.sleep(0.1)  # the host, and the process of the item
        assert len(hosts(tmp_path)) == 2
        driver.send_signal(signal.SIGINT)
        assert driver.wait(60) == 130
        assert driver.stderr.read() == "omtwarp: interrupted: 0 of 1 items done; run again to continue\n"
        while hosts(tmp_path) and time.monotonic() < deadline:
            time.sleep(0.1)
        assert not hosts(tmp_path)
    finally:
        driver.kill()
        driver.wait()
    assert not list(tmp_path.rglob("*.npz")) and not list(tmp_path.rglob(files.PREFIX + "*"))
    assert not list((tmp_path / "out" / "records").iterdir())  # the next run computes it


# One process loads everything, and forks for every command: a process each would take most of the time to begin.
AT_ANY_MOMENT = """
import json, os, signal, sys, time
from omtwarp.commands._cli import main
from small_pictures import shrink
shrink()  # pictures, which otherwise take most of the time

def run(words, after):
    with open("lines", "w+") as lines:
        child = os.fork()
        if child == 0:
            os.dup2(lines.fileno(), 2)
            signal.signal(signal.SIGINT, signal.default_int_handler)
            status = 70
            try:
                sys.argv[1:] = words
                main()
            except SystemExit as end:
                status = end.code or 0
            finally:
                os._exit(status)
        begun = time.monotonic()
        if after is not None:
            time.sleep(after)
            os.kill(child, signal.SIGINT)
        _, status = os.waitpid(child, 0)
        lines.seek(0)
        text = lines.read()
    os.remove("lines")
    return os.waitstatus_to_exitcode(status), time.monotonic() - begun, text

for words, output in json.loads(sys.argv[1]):
    words += ["-o", output]
    status, seconds, text = run(words, None)
    assert status == 0, (words, text)
    size = os.path.getsize(output)
    os.remove(output)
    before = sorted(os.listdir())
    for share in (0.7,) if words[0] in ("film", "report") else (0.4, 0.9):
        status, _, text = run(words, share * seconds)
        # A signal that comes when the output is in its place ends the process without a line.
        written = os.path.exists(output) and (status == 0 or (status in (-signal.SIGINT, 130) and "Error" not in text))
        ended = status in (-signal.SIGINT, 130) and text.splitlines()[-1:] == ["omtwarp: interrupted"]
        assert written or ended, (words, share, status, text)
        if os.path.exists(output):  # whole, also where the signal came just after it
            assert os.path.getsize(output) > 0.9 * size, words
            os.remove(output)
        assert sorted(os.listdir()) == before, (words, share, sorted(os.listdir()))
"""
MAPPED = (["map", "plain.glb"], "out.npz")
REPORT = (["report", "--map", "map.npz", "--device", "cpu"], "out.html")


def test_an_interruption_at_any_moment_leaves_a_whole_output_or_none(place):
    """A signal from outside ends each command at once, with one line."""
    words = json.dumps([*(COMMANDS[name] for name in SINGLE), REPORT, MAPPED])
    (place / "temporary").mkdir()
    paths = os.pathsep.join([str(Path(__file__).parents[1]), *filter(None, [os.environ.get("PYTHONPATH")])])
    environment = os.environ | {"TMPDIR": str(place / "temporary"), "PYTHONPATH": paths}
    command = [sys.executable, "-c", AT_ANY_MOMENT, words]
    done = subprocess.run(command, check=False, cwd=place, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert not list(place.rglob(files.PREFIX + "*"))


def damaged(place: Path, kind: str) -> str:
    """Write a map with one defect, and return its name."""
    name = kind.replace(" ", "_") + ".npz"
    if kind == "cut short":
        content = (place / "map.npz").read_bytes()
        (place / name).write_bytes(content[: len(content) // 2])
        return name
    with np.load(place / "map.npz") as file:
        arrays = dict(file)
    if kind == "not a number":
        arrays["sphere"][3] = np.nan
    elif kind == "too short":
        arrays["sphere"] = arrays["sphere"][:-1]
    elif kind == "beyond the vertices":
        arrays["faces"][0, 0] = len(arrays["vertices"])
    elif kind == "not of unit length":
        arrays["sphere"] *= 2.0
    elif kind == "no vertices":  # without a sphere it would be a mesh, which may be filmed
        del arrays["vertices"]
    np.savez(place / name, **arrays)
    return name


DAMAGES = ("cut short", "not a number", "too short", "beyond the vertices", "not of unit length", "no vertices")
READERS = {
    **COMMANDS,
    "distance": (["distance", "map.npz", "map.npz", "--degree", "2"], ""),
    "preview": (["preview", "map.npz", "--size", "16x16"], "out.png"),
    "report": REPORT,
    "align to": (["align", "map.npz", "--to", "map.npz"], "out.npz"),
}


@pytest.mark.parametrize("kind", DAMAGES)
def test_damaged_maps_are_one_line_for_every_command(place, capsys, kind):
    bad = damaged(place, kind)
    before = listing(place)
    for name, (words, output) in READERS.items():
        last = max(index for index, word in enumerate(words) if word == "map.npz")
        damaged_words = [*words[:last], bad, *words[last + 1 :]]
        status, line = ended(capsys, damaged_words + ["-o", output] * bool(output))
        assert status in (1, 2) and bad in line, (name, line)
        assert listing(place) == before, name


def test_a_map_of_another_mesh_does_not_carry_textures(place, capsys):
    ball = shapes.icosphere(3)
    MapResult(ball.vertices, ball.faces, ball.vertices, ball.vertices, np.ones(ball.vertex_count)).save(
        place / "other.npz"
    )
    before = listing(place)
    for option in ("--map-from", "--map-to"):
        words = [*COMMANDS["transfer"][0], "-o", "out.glb"]
        words[words.index(option) + 1] = "other.npz"
        status, line = ended(capsys, words)
        assert status == 1 and "other.npz" in line, line
        assert listing(place) == before


@pytest.mark.parametrize("lost", ["sphere", "wraps"])
def test_a_map_that_lost_its_points_is_not_taken_for_a_mesh(tmp_path, monkeypatch, capsys, lost):
    """A map's file without its points, or a torus's without its wraps, is refused in one line; nothing is written."""
    monkeypatch.chdir(tmp_path)
    ball = shapes.icosphere(4)
    arrays = {"vertices": ball.vertices * [1.0, 1.2, 0.9], "faces": ball.faces}
    kept = (
        {"conformal": ball.vertices}
        if lost == "sphere"
        else {"coordinates": ball.vertices[:, :2], "lattice": np.eye(2)}
    )
    np.savez("lost.npz", **arrays, **kept)
    np.savez("good.npz", **arrays, sphere=ball.vertices, conformal=ball.vertices, density=np.ones(len(ball.vertices)))
    commands = (
        "film lost.npz -o out.gif",
        "texture lost.npz -o out.glb",
        "texture --map lost.npz -o out.glb",
        "preview lost.npz -o out.png",
        "report lost.npz -o out.html",
        "report --map lost.npz -o out.html",
        "align lost.npz --to good.npz -o out.npz",
        "align good.npz --to lost.npz -o out.npz",
        "distance lost.npz good.npz",
    )
    for command in commands:
        with pytest.raises(SystemExit) as end:
            main(command.split())
        lines = capsys.readouterr().err.splitlines()
        assert end.value.code == 1 and len(lines) == 1, (command, lines)
        assert "it has no '" in lines[0] or "is a map to a torus" in lines[0], (command, lines)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["good.npz", "lost.npz"]


@pytest.mark.parametrize("kept", [(), ("conformal",), ("sphere", "conformal", "density")])
def test_maps_that_are_mapped_or_checked_are_taken_for_their_meshes_in_a_line(tmp_path, monkeypatch, capsys, kept):
    """``map`` and ``check`` take meshes: of a map's file, whole or not, they take the mesh and say so."""
    monkeypatch.chdir(tmp_path)
    ball = shapes.icosphere(4)
    arrays = {"sphere": ball.vertices, "conformal": ball.vertices, "density": np.ones(ball.vertex_count)}
    np.savez(
        "some.npz", vertices=ball.vertices * [1, 1.2, 0.9], faces=ball.faces, **{name: arrays[name] for name in kept}
    )
    said = "a map's file, of which only the mesh is read"
    for command, shown in (
        ("map some.npz -o out.npz --device cpu --quiet", "some.npz: "),
        ("check some.npz", "note: "),
    ):
        with pytest.raises(SystemExit) as end:
            main(command.split())
        lines = "".join(capsys.readouterr()).splitlines()
        assert not end.value.code
        assert [line.endswith(shown + said) for line in lines].count(True) == (1 if kept else 0), lines
    assert MapResult.load("out.npz").bijective


@pytest.mark.parametrize(
    ("command", "words"),
    [
        ("preview ball.ply -o out.png --size 9000x16", "8192"),
        ("film map.npz -o out.gif --size 9000x16", "8192"),
        ("film map.npz -o out.mp4 --seconds 1e6", "at most"),
        ("film map.npz -o out.gif --fps 1e6", "240"),
        ("texture --map map.npz -o out.glb --size 40000", "32768"),
        ("demo --faces 100000000", "2000000"),
    ],
)
def test_options_beyond_the_limits_are_refused_before_the_work(tmp_path, monkeypatch, capsys, command, words):
    """Limits are said with their value, and no map is made, drawn or written."""
    monkeypatch.chdir(tmp_path)
    ball = shapes.icosphere(4)
    write_mesh("ball.ply", ball.vertices, ball.faces)
    np.savez(
        "map.npz",
        vertices=ball.vertices,
        faces=ball.faces,
        sphere=ball.vertices,
        conformal=ball.vertices,
        density=np.ones(len(ball.vertices)),
    )
    with pytest.raises(SystemExit) as end:
        main(command.split())
    assert end.value.code in (1, 2)
    assert words in capsys.readouterr().err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["ball.ply", "map.npz"]
