"""What commands open, import and start, as Python's audit events tell it: nothing outside of where they belong.

``OMTWARP_CASES`` names a folder of further files, each of which is read too.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))

from test_references import PNG, write_gifti, write_gltf, write_obj, write_ply

import omtwarp

# Runs the lines of a file, a list of folders and words each, and writes what was touched elsewhere.
CHILD = """
import json, os, sys, tempfile
lines = json.loads(open(sys.argv[1]).read())
touched = os.open(sys.argv[2], os.O_WRONLY | os.O_CREAT | os.O_APPEND)
places = {sys.prefix, sys.base_prefix, sys.exec_prefix, os.environ["WARP_CACHE_PATH"], *sys.path}
own = [os.path.realpath(place) for place in places if place]
system = ["/proc", "/sys", "/etc/localtime", "/usr/share/zoneinfo", "/dev/null", "/dev/urandom", "/etc/mime.types"]
scratch = os.path.join(os.path.realpath(tempfile.gettempdir()), ".omtwarp-")
allowed = []

def hook(event, words):
    if not allowed:
        return
    if event in ("open", "ctypes.dlopen"):
        path = words[0]
        if not isinstance(path, (str, bytes)) or (event == "ctypes.dlopen" and "/" not in os.fsdecode(path)):
            return
        place = os.path.realpath(os.fsdecode(path))
        # A temporary file without a name opens the folder; a traceback looks for the source of code.
        unnamed = place == os.path.realpath(tempfile.gettempdir()) or os.path.basename(place).startswith("<")
        inside = any(place == one or place.startswith(one + os.sep) for one in allowed)
        fine = unnamed or inside or place.startswith(scratch)
    else:
        place = words
        fine = not event.startswith(("subprocess.", "os.exec", "os.system", "os.posix_spawn", "os.spawn"))
        fine = fine or (event == "subprocess.Popen" and list(words[1]) == ["uname", "-p"])  # platform.processor
    if not fine:
        os.write(touched, (json.dumps([event, str(place)[:300]]) + chr(10)).encode())

sys.addaudithook(hook)
from omtwarp.commands._cli import main
for folders, words in lines:
    allowed[:] = [*own, *system, *map(os.path.realpath, folders)]
    try:
        main(words)
    except SystemExit as end:
        status = end.code
    allowed.clear()
    print(json.dumps([words[0], status]))
"""
COMMANDS = (
    ("check", "--repair"),
    ("map", "--until", "conformal", "-o", "{}/o.npz"),
    ("preview", "--size", "16", "--backend", "warp", "-o", "{}/o.png"),
    ("texture", "--until", "conformal", "--size", "16", "--uv", "own", "-o", "{}/o.obj"),
)


@pytest.fixture
def cases(tmp_path):
    """Files that name others: in their folder, elsewhere, by links; and what an environment names."""
    private = tmp_path / "private"
    private.mkdir()
    (private / "secret.png").write_bytes(PNG)
    (private / "secret.bin").write_bytes(bytes(10_000))
    writers = {
        "obj": write_obj,
        "ply": write_ply,
        "picture": lambda folder, name: write_gltf(folder, {"uri": name}),
        "buffer": lambda folder, name: write_gltf(folder, {"uri": "own.png"}, name),
        "gifti": write_gifti,
    }
    found = []
    for kind, write in writers.items():
        for number, name in enumerate(("own.png", "../private/secret.png", str(private / "secret.bin"), "link")):
            folder = tmp_path / f"{kind}-{number}"
            folder.mkdir()
            (folder / "own.png").write_bytes(PNG)
            (folder / "link").symlink_to(private / "secret.png")
            found.append(write(folder, name))
    more = os.environ.get("OMTWARP_CASES")
    for file in sorted(Path(more).iterdir()) if more else []:
        folder = tmp_path / f"case-{file.name}"
        folder.mkdir()
        shutil.copy(file, folder)
        found.append(folder / file.name)
    return found


def test_commands_touch_their_inputs_and_outputs_alone(tmp_path, cases):
    """Nothing is opened, imported or started outside of inputs, outputs, the cache and Python's own folders."""
    work, out = tmp_path / "work", tmp_path / "out"
    for folder in (work, out):
        folder.mkdir()
    for name in ("signal", "json", "numpy", "trimesh", "collada", "lxml", "PIL"):
        (work / f"{name}.py").write_text("raise SystemExit(9)\n", "utf-8")
    lines = [
        ([str(file.parent), str(out)], [command[0], str(file), *(word.format(out) for word in command[1:])])
        for file in cases
        for command in COMMANDS
    ]
    (tmp_path / "lines.json").write_text(json.dumps(lines), "utf-8")
    root = str(Path(omtwarp.__file__).parents[1])
    cache = os.environ["WARP_CACHE_PATH"]
    done = subprocess.run(
        [sys.executable, "-P", "-c", CHILD, str(tmp_path / "lines.json"), str(tmp_path / "touched")],
        cwd=work, env=os.environ | {"PYTHONPATH": root, "WARP_CACHE_PATH": cache}, capture_output=True, text=True,
        timeout=600, check=False,
    )  # fmt: skip
    ended = [json.loads(line) for line in done.stdout.splitlines() if line.startswith("[")]
    assert len(ended) == len(lines), done.stderr[-2000:]
    assert "Traceback" not in done.stderr and "internal error" not in done.stderr
    assert sum(status in (0, None) for _, status in ended) >= len(cases)
    touched = {line for line in (tmp_path / "touched").read_text("utf-8").splitlines() if "__pycache__" not in line}
    assert touched == set()
