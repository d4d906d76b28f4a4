"""What commands may replace: the file that the user names, and what they wrote before and nobody changed."""

from __future__ import annotations

import os
import time

import numpy as np
import pytest
from PIL import Image

from omtwarp.cohort import read_manifest, run_cohort
from omtwarp.commands._cli import SUMMARIES, main
from omtwarp.errors import OmtwarpError
from omtwarp.files import output as files
from omtwarp.maps.result import MapResult
from omtwarp.mesh import shapes
from omtwarp.mesh.write import write_mesh

BALL = shapes.icosphere(2)


@pytest.fixture
def place(tmp_path, monkeypatch):
    """A working folder with maps, a sphere, and a mesh with a picture."""
    monkeypatch.chdir(tmp_path)
    for name, scale in (("a", 1.3), ("b", 1.6)):
        vertices = BALL.vertices * [1.0, scale, 2.0]
        MapResult(vertices, BALL.faces, BALL.vertices, BALL.vertices, np.ones(len(vertices))).save(f"{name}.npz")
        write_mesh(f"{name}.ply", vertices, BALL.faces)
    write_mesh("sphere.ply", BALL.vertices, BALL.faces)
    lines = [f"v {x} {y} {z}" for x, y, z in BALL.vertices] + ["vt 0 0", "usemtl skin"]
    lines += ["f " + " ".join(f"{k}/1" for k in face + 1) for face in BALL.faces]
    (tmp_path / "mesh.mtl").write_text("newmtl skin\nmap_Kd skin.png\n", "utf-8")
    (tmp_path / "mesh.obj").write_text("\n".join(["mtllib mesh.mtl", *lines]), "utf-8")
    Image.new("RGB", (8, 8), (200, 30, 30)).save("skin.png")
    return tmp_path


def ended(capsys, line: str) -> tuple[int, str]:
    """Run a command line; return its exit status and the last line on standard error."""
    with pytest.raises(SystemExit) as end:
        main(line.split())
    return int(end.value.code or 0), (capsys.readouterr().err.strip().splitlines() or [""])[-1]


@pytest.mark.parametrize(
    ("line", "kept"),
    [
        ("align a.npz --to b.npz -o b.npz", "b.npz"),
        ("align a.npz --to sphere.ply --to-surface b.ply -o b.ply", "b.ply"),
        ("align sphere.ply --surface b.ply -o b.ply", "b.ply"),
        ("resample a.npz --to b.npz -o b.npz --data b.npy", "b.npz"),
        ("resample a.npz --to ico1 -o c.ply --sphere a.npz", "a.npz"),
        ("resample a.npz --to sphere.ply -o sphere.ply", "sphere.ply"),
        ("preview mesh.obj -o skin.png --size 16 --backend warp", "skin.png"),
        ("texture mesh.obj --map a.npz --uv own -o mesh.obj --size 16", "mesh.obj"),
    ],
)
def test_an_output_that_is_also_read_is_refused(place, capsys, line, kept):
    np.save(place / "b.npy", np.arange(len(BALL.vertices), dtype=float))
    before = {file.name: file.read_bytes() for file in place.iterdir()}
    status, said = ended(capsys, line)
    assert status and ("input" in said or "unknown suffix" in said), said
    assert {file.name: file.read_bytes() for file in place.iterdir()} == before and kept in before


def test_a_companion_that_was_changed_is_kept(place, capsys):
    """A picture of the user's, one that mentions the package, and one that was edited are left as they are."""
    line = "texture --map a.npz -o o.obj --size 16"
    (place / "o.mtl").write_text("# notes about omtwarp\n", "utf-8")
    assert ended(capsys, line)[0] == 0
    assert (place / "o.mtl").read_text("utf-8") == "# notes about omtwarp\n"
    first = (place / "o.obj").read_text("utf-8")
    assert "mtllib o-texture.mtl" in first and (place / "o.png").exists()
    assert ended(capsys, line)[0] == 0  # what the first run wrote is replaced
    assert not list(place.glob("o-texture-*"))
    Image.new("RGB", (8, 8)).save("o.png")
    edited = (place / "o.png").read_bytes()
    assert ended(capsys, line)[0] == 0
    assert (place / "o.png").read_bytes() == edited and (place / "o-texture.png").exists()


@pytest.mark.parametrize("name", ["table.csv", "table.parquet", "report.html"])
def test_a_cohort_replaces_no_table_or_page_of_others(place, name):
    out = place / "out"
    out.mkdir()
    (out / name).write_text("of omtwarp, by another", "utf-8")
    with pytest.raises(OmtwarpError, match="omtwarp did not write what is there"):
        run_cohort(read_manifest("[ab].ply"), out, collect=True)
    assert os.listdir(out) == [name] and (out / name).read_text("utf-8") == "of omtwarp, by another"


def test_a_cohort_replaces_its_own_table_and_page(place):
    for _ in range(2):
        assert run_cohort(read_manifest("[ab].ply"), place / "out", collect=True).counts == {"waiting": 2}


def test_a_cohort_maps_no_file_that_it_writes(place):
    (place / "out" / "maps").mkdir(parents=True)
    os.rename(place / "a.npz", place / "out" / "maps" / "a.npz")
    (place / "list.csv").write_text("path,id\nout/maps/a.npz,a\n", "utf-8")
    with pytest.raises(OmtwarpError, match="would be replaced as a result"):
        run_cohort(read_manifest("list.csv"), place / "out", collect=True)


@pytest.mark.parametrize("there", ["a map", "a text", "a link", "a folder"])
def test_a_cohort_replaces_no_map_of_others(place, capsys, there):
    """Nor does one count as done; --force replaces files, and neither links nor folders."""
    own = place / "out" / "maps" / "a.npz"
    own.parent.mkdir(parents=True)
    if there == "a map":
        os.rename(place / "b.npz", own)
    elif there == "a text":
        own.write_text("maps by omtwarp", "utf-8")
    elif there == "a link":
        own.symlink_to(place / "b.npz")
    else:
        own.mkdir()
    before = own.is_file() and own.read_bytes()
    line = "cohort [ab].ply -o out --until conformal --workers 1 -q --device cpu"
    status, said = ended(capsys, line)
    assert status == 1 and "maps/a.npz': omtwarp did not write what is there" in said, said
    assert (own.is_file() and own.read_bytes()) == before and not list((place / "out" / "records").iterdir())
    assert run_cohort(read_manifest("[ab].ply"), "out", collect=True, until="conformal").counts == {"waiting": 2}
    status, said = ended(capsys, line + " --force")
    assert status == int(there in ("a link", "a folder")), said
    if not status:
        assert MapResult.load(own).faces.shape == BALL.faces.shape and ended(capsys, line)[0] == 0


def test_a_group_replaces_no_table_of_others(place, capsys):
    (place / "study").mkdir()
    (place / "study" / "table.csv").write_text("omtwarp,1\n", "utf-8")
    status, said = ended(capsys, "group a.npz b.npz -o study --grid ico1 --degree 2 --permutations 3")
    assert status == 1 and "omtwarp did not write what is there" in said
    assert os.listdir(place / "study") == ["table.csv"]
    for _ in range(2):
        assert ended(capsys, "group a.npz b.npz -o other --grid ico1 --degree 2 --permutations 3")[0] == 0


def test_folders_of_others_are_not_swept(tmp_path):
    """A folder is swept where it has the marker with its own name, and not for its name alone."""
    theirs, copied, ours = (tmp_path / f"{files.PREFIX}{number:016x}" for number in range(3))
    for folder in (theirs, copied, ours):
        folder.mkdir()
        (folder / "data.txt").write_text("data", "utf-8")
    (copied / files.MARKER).write_text(ours.name, "utf-8")
    (ours / files.MARKER).write_text(ours.name, "utf-8")
    old = time.time() - 30 * files.STALE_UNKNOWN_SECONDS
    for folder in (theirs, copied, ours):
        for path in (*folder.iterdir(), folder):
            os.utime(path, (old, old))
    write_mesh(tmp_path / "ball.ply", BALL.vertices, BALL.faces)
    assert theirs.exists() and copied.exists() and not ours.exists()


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes here")
def test_a_pipe_as_record_or_marker_is_not_waited_for(tmp_path):
    folder = tmp_path / f"{files.PREFIX}{0:016x}"
    folder.mkdir()
    os.mkfifo(folder / files.MARKER)
    os.mkfifo(tmp_path / files.RECORD)
    assert not files.written_by_omtwarp(tmp_path / "nothing")
    write_mesh(tmp_path / "ball.ply", BALL.vertices, BALL.faces)
    assert folder.exists()


def test_force_replaces_companions_and_results_of_others(place, capsys):
    """With --force a companion has its first name, and a group its folder; inputs are kept all the same."""
    (place / "o.mtl").write_text("# notes\n", "utf-8")
    assert ended(capsys, "texture --map a.npz -o o.obj --size 16 --force")[0] == 0
    assert "mtllib o.mtl" in (place / "o.obj").read_text("utf-8") and not list(place.glob("o-texture*"))
    (place / "study").mkdir()
    (place / "study" / "table.csv").write_text("of another\n", "utf-8")
    line = "group a.npz b.npz -o study --grid ico1 --degree 2 --permutations 3"
    assert ended(capsys, line)[0] == 1
    assert ended(capsys, line + " --force")[0] == 0
    assert "of another" not in (place / "study" / "table.csv").read_text("utf-8")
    skin = (place / "skin.png").read_bytes()
    own = "texture mesh.obj --map a.npz --uv own --keep-materials over -o skin.obj --size 16"
    for line in ("preview mesh.obj -o skin.png --size 16 --backend warp", own):
        ended(capsys, line + " --force")
        assert (place / "skin.png").read_bytes() == skin
    assert ended(capsys, "align a.npz --to b.npz -o b.npz --force")[0] == 1


@pytest.mark.parametrize("kind", ["directory", "link"])
def test_force_replaces_files_alone(place, capsys, kind):
    """A folder or a link where a result goes is never replaced."""
    (place / "study").mkdir()
    there = place / "study" / "table.csv"
    if kind == "directory":
        there.mkdir()
    else:
        there.symlink_to(place / "a.npz")
    before = (place / "a.npz").read_bytes()
    status, _ = ended(capsys, "group a.npz b.npz -o study --grid ico1 --degree 2 --permutations 3 --force")
    assert status == 1 and (place / "a.npz").read_bytes() == before and os.path.lexists(there)


def test_every_command_that_writes_has_the_option(capsys):
    for command in SUMMARIES:
        with pytest.raises(SystemExit):
            main([command, "--help"])
        assert ("--force" in capsys.readouterr().out) == (command != "distance")
