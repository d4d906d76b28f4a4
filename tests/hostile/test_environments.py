"""Every command in every environment: streams closed or full, plain terminals, no home, no place for kernels.

It does its work, or says why not in one line.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from omtwarp.commands._cli import SUMMARIES, main
from omtwarp.maps.result import MapResult
from omtwarp.mesh import shapes
from omtwarp.mesh.write import write_mesh

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="commands run in forks of a process that is loaded")

# The output is the last word, in place of which each run has its own; ö is no ASCII.
COMMANDS = {
    "map": "map bäll.ply --until conformal -o o.npz",
    "texture": "texture --map bäll.npz --size 16 -o o.glb",
    "transfer": "transfer öwn.glb öwn.glb --map-from bäll.npz --map-to bäll.npz --size 16 -o o.glb",
    "unwrap": "unwrap bäll.npz -o o.glb",
    "preview": "preview bäll.ply --size 16 --backend warp -o o.png",
    "film": "film bäll.npz --size 16x16 --seconds 0.2 --fps 2 --backend warp -o o.gif",
    "report": "report --map bäll.npz -o o.html",
    "align": "align bäll.npz -o o.npz",
    "register": "register bäll.npz --to bäll.npz -o o.npz",
    "resample": "resample bäll.npz --to ico1 -o o.ply",
    "check": "check bäll.ply --repair -o o.ply",
    "cohort": "cohort b*.ply --until conformal --collect -o o",
    "spharm": "spharm --map bäll.npz --degree 2 -o o.coef",
    "distance": "distance bäll.npz bäll.npz --degree 2",
    "group": "group bäll.npz bäll.npz --grid ico1 --degree 2 -o o",
    "demo": "demo --device cuda:77 -o o",  # which takes a quarter of a minute where it can
}
FAILS = {"demo": "cuda:77"}
# They take as long as all others together, and have one stream closed only together with the others.
DEAR = ("report", "group", "register", "film", "distance")
ONE_CLOSED = ("input closed", "output closed", "errors closed")
# OpenGL starts in a process of its own, which takes seconds: where it could meet what is missing.
WITH_OPENGL = ("all closed", "no temporary folder")
# What closes streams ("-"), leads them to a file, sets their encoding, or sets variables; "" unsets these.
STREAMS = {
    "input closed": {"stdin": "-"},
    "output closed": {"stdout": "-"},
    "errors closed": {"stderr": "-"},
    "all closed": {"stdin": "-", "stdout": "-", "stderr": "-"},
    "output full": {"stdout": "/dev/full"},
    "errors full": {"stderr": "/dev/full"},
    "ASCII": {"encoding": "ascii", "LC_ALL": "C"},
    "no terminal": {"TERM": "", "HOME": "", "COLUMNS": "1"},
}
PLACES = {
    "home is a file": {"HOME": "{}/bäll.ply", "WARP_CACHE_PATH": "", "XDG_CACHE_HOME": ""},
    "kernels in a file": {"WARP_CACHE_PATH": "{}/bäll.ply"},
}
TEMPORARY = {"no temporary folder": {"TMPDIR": "/proc/nothing"}}

# Runs every command of a table in a fork with what an interpreter that starts in that environment has.
TABLE = """
import functools, gc, importlib, io, json, os, sys, tempfile
import numpy, scipy.optimize, scipy.sparse.linalg, scipy.spatial, PIL.Image, rich.progress, trimesh, warp
import omtwarp.commands._cli
from omtwarp.__main__ import main

def stream(name, number, given, encoding, errors):
    if given == "-":
        os.close(number)
        setattr(sys, name, None)
        setattr(sys, "__" + name + "__", None)
        return
    if given:
        os.dup2(os.open(given, os.O_RDWR), number)
    mode = "r" if number == 0 else "w"
    setattr(sys, name, open(number, mode, encoding=encoding, errors=errors, closefd=False))

def run(words, setting, said, opengl):
    child = os.fork()
    if child:
        return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    status = 99
    try:
        os.dup2(os.open(said, os.O_RDWR | os.O_CREAT), 2)
        os.dup2(os.open(os.devnull, os.O_RDWR), 0)
        os.dup2(0, 1)
        for name, value in setting.items():
            if name.isupper():
                os.environ.pop(name, None)
                os.environ.update({name: value} if value else {})
        tempfile.tempdir = None
        if loaded and not opengl:
            page.preview, client.prepare = functools.partial(page.preview, backend="warp"), lambda: None
        encoding = setting.get("encoding", "utf-8")
        stream("stdin", 0, setting.get("stdin"), encoding, "strict")
        stream("stdout", 1, setting.get("stdout"), encoding, "strict")
        stream("stderr", 2, setting.get("stderr"), encoding, "backslashreplace")
        sys.argv[1:] = words
        try:
            main()
        except SystemExit as end:
            status = end.code or 0
        for stream_left in (sys.stdout, sys.stderr):
            try:
                stream_left.flush()
            except OSError:
                status = 120  # of an interpreter that cannot write its last words
    except BaseException:
        import traceback
        os.write(os.open(said, os.O_WRONLY | os.O_APPEND), traceback.format_exc().encode())
    finally:
        os._exit(status)

commands, settings, loaded, tests, left_out, with_opengl = json.loads(sys.argv[1])
if loaded:
    # Small pictures and few steps, which otherwise take most of the time.
    sys.path.append(tests)
    modules = "small_pictures", "omtwarp.reporting.page", "omtwarp.render.gl_client"
    small, page, client = map(importlib.import_module, modules)
    small.shrink()
    small.shorten()
    for words in commands:  # loads the modules and kernels of each
        sys.argv[1:] = words
        try:
            main()
        except SystemExit:
            pass
gc.freeze()  # a collection in a fork would copy every page of what is loaded
for words in commands:
    for name, setting in settings.items():
        if [words[0], name] in left_out:
            continue
        own = f"{words[0]} {name}"
        os.mkdir(own)
        end = words[-1].removeprefix("o")
        to = [f"{own}/o{end}"] if words[-1][0] == "o" else words[-1:]
        status = run([*words[:-1], *to], setting, f"{own}.txt", name in with_opengl)
        written = sorted(os.listdir(own))
        with open(f"{own}.txt", encoding="utf-8", errors="replace") as file:
            said = file.read()
        print(json.dumps([words[0], name, status, said, written]))
"""


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A folder with a mesh, its map and a mesh with texture coordinates."""
    folder = tmp_path_factory.mktemp("environments")
    ball = shapes.icosphere(2)
    vertices = ball.vertices * [1.0, 1.3, 1.7]
    write_mesh(folder / "bäll.ply", vertices, ball.faces)
    result = MapResult(vertices, ball.faces, ball.vertices, ball.vertices, np.ones(ball.vertex_count))
    result.save(folder / "bäll.npz")
    mapped, plain, own = (str(folder / name) for name in ("bäll.npz", "plain.glb", "öwn.glb"))
    for words in (["unwrap", mapped, "-o", plain], ["texture", plain, "--map", mapped, "--uv", "own", "-o", own]):
        with pytest.raises(SystemExit) as end:
            main(words + ["--size", "16"] * (words[0] == "texture"))
        assert not end.value.code
    return folder


def table(place, settings: dict[str, dict[str, str]], *, loaded: bool) -> dict[tuple[str, str], tuple[int, str, list]]:
    """Run all commands in some environments; return their status, what they said, and what they wrote."""
    filled = {name: {key: value.format(place) for key, value in setting.items()} for name, setting in settings.items()}
    lines = [line.split() for line in COMMANDS.values()]
    left_out = [(command, name) for command in DEAR for name in ONE_CLOSED if name in settings]
    words = json.dumps([lines, filled, loaded, str(Path(__file__).parents[1]), left_out, WITH_OPENGL])
    environment = os.environ | {"PYTHONUTF8": "1"}
    done = subprocess.run(
        [sys.executable, "-c", TABLE, words], cwd=place, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    lines = [json.loads(line) for line in done.stdout.splitlines() if line.startswith("[")]
    found = {(command, name): (status, said, written) for command, name, status, said, written in lines}
    assert len(found) == len(COMMANDS) * len(settings) - len(left_out)
    for key, (status, said, _) in found.items():
        assert status in (0, 1) and "Traceback" not in said and "internal error" not in said, (key, status, said)
        errors = [line for line in said.splitlines() if line.startswith("omtwarp: error: ")]
        readable = settings[key[1]].get("stderr") is None
        assert len(errors) == (status == 1 and readable), (key, status, said)
    return found


def test_the_table_has_every_command():
    assert sorted(COMMANDS) == sorted(SUMMARIES)


def test_streams_that_are_closed_full_or_plain(place):
    """Every command works; where standard output is full it says so, after its work."""
    found = table(place, STREAMS | TEMPORARY, loaded=True)
    for (command, name), (status, said, written) in found.items():
        if command in FAILS:
            assert status == 1, (command, name)
            continue
        full = name == "output full"
        assert status == full, (command, name, said)
        assert written or command == "distance", (command, name, said)
        if full:
            assert said.splitlines()[-1] == "omtwarp: error: cannot write to standard output: No space left on device"


def test_kernels_that_cannot_be_kept_are_one_line(place):
    """The line names the place that cannot be written and the variable that names another; nothing is written."""
    for (command, name), (status, said, written) in table(place, PLACES, loaded=False).items():
        assert status == 1 and not written, (command, name, said)
        assert "compiled kernels cannot be kept in '" in said and "WARP_CACHE_PATH" in said, (command, name, said)


@pytest.mark.parametrize("closing", [">&-", "2>&-", "<&- >&- 2>&-", "2>/dev/full", ">/dev/full"])
def test_a_new_interpreter_without_streams(place, tmp_path, closing):
    """What the table imitates, by a shell: children of a cohort have streams of their own too."""
    commands = [f"check bäll.ply --repair -o {tmp_path}/o.ply", "--version"]
    if closing == "<&- >&- 2>&-":
        commands.append(f"cohort 'b*.ply' --until conformal --workers 1 -o {tmp_path}/o")
    for command in commands:
        line = f"'{sys.executable}' -m omtwarp {command} {closing}"
        done = subprocess.run(["sh", "-c", line], cwd=place, capture_output=True, check=False, text=True)
        assert done.returncode == (closing == ">/dev/full") and "Traceback" not in done.stderr, done.stderr
    assert (tmp_path / "o.ply").exists() and (tmp_path / "o" / "maps" / "b_ll.npz").exists() == (len(commands) == 3)


def test_an_output_to_a_closed_stream_is_refused(place):
    line = f"'{sys.executable}' -m omtwarp map bäll.ply -o - >&-"
    done = subprocess.run(["sh", "-c", line], cwd=place, capture_output=True, check=False, text=True)
    assert (done.returncode, done.stderr) == (1, "omtwarp: error: standard output is closed: name a file with -o\n")


def test_a_terminal_without_the_characters_is_shown_their_codes(place):
    plain = os.environ | {"PYTHONIOENCODING": "ascii", "LC_ALL": "C"}
    done = subprocess.run(
        [sys.executable, "-m", "omtwarp", "check", "bäll.ply"], cwd=place, env=plain, capture_output=True, check=False
    )
    assert done.returncode == 0 and done.stdout.startswith(b"b\\xe4ll.ply: 42 vertices, 80 faces")
