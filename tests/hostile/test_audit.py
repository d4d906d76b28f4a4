"""What commands open, import and start, as Python's audit events tell it: nothing outside of where they belong.

Cases are meshes of five formats that name a file in their folder, two elsewhere and one by a link, a sound mesh and
its map, and each file of the folder that ``OMTWARP_CASES`` names. Commands that read pictures and materials open every
case, the others one of each format, another one each, all lines in one process. ``cohort`` opens all in one line, by
children; ``demo`` takes none.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent))

from test_references import PNG, write_gifti, write_gltf, write_obj, write_ply

import omtwarp
from omtwarp.commands._cli import SUMMARIES
from omtwarp.maps.result import MapResult
from omtwarp.mesh import shapes
from omtwarp.mesh.write import write_mesh

# Imported by every interpreter that is started, children too: notes what is touched outside of where it belongs.
HOOK = """
import json, os, sys, sysconfig, tempfile

places = {sys.prefix, sys.base_prefix, sys.exec_prefix, os.environ["WARP_CACHE_PATH"], *sys.path}
places |= {*sysconfig.get_paths().values(), tempfile.gettempdir()}
own = [os.path.realpath(place) for place in places if place]
own += ["/proc", "/sys", "/etc/localtime", "/usr/share/zoneinfo", "/dev/null", "/dev/urandom", "/etc/mime.types"]
allowed = json.loads(os.environ.get("AUDIT_ALLOWED", "[]"))
notes = os.open(os.environ["AUDIT_NOTES"], os.O_WRONLY | os.O_CREAT | os.O_APPEND)

def hook(event, words):
    if not allowed:
        return
    if event in ("open", "ctypes.dlopen"):
        path = words[0]
        if not isinstance(path, (str, bytes)) or (event == "ctypes.dlopen" and "/" not in os.fsdecode(path)):
            return
        place = os.path.realpath(os.fsdecode(path))
        # A traceback looks for the source of code that has none.
        fine = any(place == one or place.startswith(one + os.sep) for one in (*own, *allowed))
        fine = fine or os.path.basename(place).startswith("<")
    else:
        place = words
        starts = ("subprocess.", "os.exec", "os.system", "os.posix_spawn", "os.spawn", "socket.connect")
        fine = not event.startswith(starts)
        if event == "subprocess.Popen":  # this interpreter, safely; what platform and ctypes.util ask of the system
            command = list(words[1])
            fine = command in (["uname", "-p"], ["/sbin/ldconfig", "-p"]) or command[:2] == [sys.executable, "-P"]
    if not fine:
        os.write(notes, (json.dumps([event, str(place)[:300]]) + chr(10)).encode())

sys.addaudithook(hook)
"""
# Runs the lines of a file, a list of folders and words each, on few pixels and in few steps; says how each ended.
DRIVER = """
import json, os, sys
import sitecustomize
from omtwarp.commands._cli import main
from small_pictures import shorten, shrink
shrink()
shorten()
for folders, words in json.loads(open(sys.argv[1]).read()):
    sitecustomize.allowed[:] = map(os.path.realpath, folders)
    os.environ["AUDIT_ALLOWED"] = json.dumps(sitecustomize.allowed)
    status = None
    try:
        main(words)
    except SystemExit as end:
        status = end.code
    sitecustomize.allowed.clear()
    print(json.dumps([words[0], status]))
"""
# Command lines with a case {0}, a sound mesh and its map in {1}, and a folder of their own {2} for outputs.
COMMANDS = (
    "check {0} --repair",
    "map {0} --until conformal -o {2}/o.npz",
    "preview {0} --size 16 --backend warp -o {2}/o.png",
    "texture {0} --until conformal --size 16 --uv own -o {2}/o.obj",
    "unwrap {0} -o {2}/u.glb",
    "transfer {0} {1}/ball.ply --map-from {1}/ball.npz --map-to {1}/ball.npz --size 16 -o {2}/t.glb",
    "spharm {0} --degree 2 -o {2}/s.coef",
    "align {0} -o {2}/a.ply",
    "align {1}/ball.npz --to {1}/ball.npz --feature {0} --to-feature {0} -o {2}/a.npz",
    "register {0} --to {1}/ball.npz -o {2}/g.ply",
    "resample {0} --surface {1}/ball.ply --to ico1 -o {2}/m.ply",
    "resample {1}/ball.npz --to ico1 --data {0} -o {2}/d.npy",
    "distance {0} {1}/ball.npz --degree 2",
    "group {0} {1}/ball.npz --grid ico1 --degree 2 -o {2}/group",
    "report {0} --until conformal -o {2}/r.html",
    # Flat pictures, as the motion that a film needs frames for is looked for on those of its own shape.
    "film {0} --method tutte --size 64x16 --seconds 0.2 --fps 2 --pattern checker --backend warp -o {2}/f.gif",
)
# Those that read what a mesh names.
READERS = ("check", "preview", "texture", "unwrap", "transfer")
# Once, of all cases, of a sound map, or of nothing.
ONCE = (
    "cohort {1}/cases.csv --until conformal --workers 1 -o {2}/cohort",
    "group {1}/ball.npz {1}/ball.npz --grid ico1 --degree 2 --permutations 9 -o {2}/group",
    "demo --faces 2000 --device cpu -o {2}/demo",
)
FORMATS, WAYS = 5, 4  # of cases, and in how many ways each names a file


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
    work, site, sound, temporary = (tmp_path / name for name in ("work", "site", "sound", "temporary"))
    for folder in (work, site, sound, temporary):
        folder.mkdir()
    for name in ("signal", "json", "numpy", "trimesh", "collada", "lxml", "PIL"):
        (work / f"{name}.py").write_text("raise SystemExit(9)\n", "utf-8")
    (site / "sitecustomize.py").write_text(HOOK, "utf-8")
    ball = shapes.icosphere(3)
    shape = shapes.blob(seed=1, sphere=ball)
    colours = {name: np.full(ball.vertex_count, 99, np.uint8) for name in ("red", "green", "blue")}
    write_mesh(sound / "ball.ply", shape.vertices, shape.faces, beside=colours)
    MapResult(shape.vertices, shape.faces, ball.vertices, ball.vertices, np.ones(ball.vertex_count)).save(
        sound / "ball.npz"
    )
    lines = []
    for number, file in enumerate([*cases, sound / "ball.npz", sound / "ball.ply"]):
        for place, command in enumerate((*COMMANDS, *(ONCE if file == sound / "ball.ply" else ()))):
            if number < WAYS * FORMATS and command.split()[0] not in READERS and (number + place) % WAYS:
                continue
            out = tmp_path / "out" / str(number)
            words = [word.format(file, sound, out) for word in command.split()]
            inputs = cases if words[0] == "cohort" else [file]
            lines.append(([*(str(one.parent) for one in inputs), str(sound), str(out)], words))
            out.mkdir(parents=True, exist_ok=True)
    (sound / "cases.csv").write_text("\n".join(["path", *map(str, [sound / "ball.ply", *cases])]) + "\n", "utf-8")
    (tmp_path / "lines.json").write_text(json.dumps(lines), "utf-8")
    paths = os.pathsep.join([str(site), *(str(Path(file).parents[1]) for file in (omtwarp.__file__, __file__))])
    environment = {"PYTHONPATH": paths, "AUDIT_NOTES": str(tmp_path / "notes"), "TMPDIR": str(temporary)}
    done = subprocess.run(
        [sys.executable, "-P", "-c", DRIVER, str(tmp_path / "lines.json")],
        cwd=work, env=os.environ | environment, capture_output=True, text=True, timeout=900, check=False,
    )  # fmt: skip
    ended = [json.loads(line) for line in done.stdout.splitlines() if line.startswith("[")]
    assert len(ended) == len(lines), done.stderr[-2000:]
    assert "Traceback" not in done.stderr and "internal error" not in done.stderr
    assert {name for name, _ in ended} == set(SUMMARIES)
    worked = {name for name, status in ended if status in (0, None)} | {"cohort"}  # of which some cases fail
    rows = list((tmp_path / "out").glob("*/cohort/maps/*.npz"))
    assert len(rows) > len(cases) // 4
    assert worked == set(SUMMARIES), done.stderr[-2000:]
    touched = {line for line in (tmp_path / "notes").read_text("utf-8").splitlines() if "__pycache__" not in line}
    assert touched == set()


def test_the_hook_sees_what_is_outside(tmp_path):
    """What the test above relies on: a file elsewhere, a program and a library are noted, of children too."""
    (tmp_path / "sitecustomize.py").write_text(HOOK, "utf-8")
    (tmp_path / "secret").write_text("")
    child = "import os; open(os.environ['SECRET'])"
    code = f"import subprocess, sys; subprocess.run([sys.executable, '-P', '-c', {child!r}]); subprocess.run(['true'])"
    environment = {"SECRET": str(tmp_path.parent / "elsewhere"), "AUDIT_NOTES": str(tmp_path / "notes")}
    environment |= {"PYTHONPATH": str(tmp_path), "AUDIT_ALLOWED": json.dumps([str(tmp_path)])}
    (tmp_path.parent / "elsewhere").write_text("")
    cache = {"WARP_CACHE_PATH": str(tmp_path / "cache"), "TMPDIR": str(tmp_path)}
    subprocess.run([sys.executable, "-P", "-c", code], env=os.environ | environment | cache, check=True)
    events = [json.loads(line) for line in (tmp_path / "notes").read_text("utf-8").splitlines()]
    assert ["open", environment["SECRET"]] in events
    assert any(event == "subprocess.Popen" and "true" in words for event, words in events)
