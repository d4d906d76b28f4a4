"""Values and state files of wrong form: one line each, or read as if they were not there."""

from __future__ import annotations

import json
import os

import numpy as np
import pytest

from omtwarp.cohort import read_manifest, run_cohort
from omtwarp.cohort.item import Job, key_of, read_journal, read_record
from omtwarp.commands._cli import main
from omtwarp.errors import OmtwarpError
from omtwarp.mesh import shapes
from omtwarp.mesh.read import read_mesh
from omtwarp.mesh.write import write_mesh
from omtwarp.resampling import resample
from omtwarp.shape_analysis.expansion import read_coef

BALL = shapes.icosphere(2)


@pytest.fixture
def place(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_mesh("a.ply", BALL.vertices, BALL.faces)
    (tmp_path / "table.csv").write_text("path\na.ply\n", "utf-8")
    return tmp_path


@pytest.mark.parametrize(
    "words",
    ["--memory-limit nan", "--memory-limit inf", "--time-limit nan", "--time-limit inf", "--shard ²/²", "--shard 1/"]
    + ["--shard 9999999999/9999999999", "--device cuda:²"],
)
def test_limits_and_shards_of_wrong_form_are_one_line(place, capsys, words):
    with pytest.raises(SystemExit) as end:
        main(["cohort", "table.csv", "-o", "out", "--collect", *words.split()])
    said = capsys.readouterr().err
    assert end.value.code in (1, 2) and "internal error" not in said and "Traceback" not in said


@pytest.mark.parametrize("text", ["path,note\na.ply," + "x" * 131_073, "path," + "x" * 131_073 + "\na.ply,1"])
def test_a_field_that_is_too_long_is_one_line(place, text):
    (place / "table.csv").write_text(text, "utf-8")
    with pytest.raises(OmtwarpError, match=r"line [12]: field larger than field limit"):
        read_manifest("table.csv")


@pytest.mark.parametrize(
    "change", [{"status": []}, {"status": "fine"}, {"area": "small"}, {"message": {}}, {"seconds": [1]}, {"id": 7}]
)
def test_a_record_with_wrong_types_is_none(place, change):
    """The item is computed again, and the table has no such value."""
    run_cohort(read_manifest("table.csv"), "out", collect=True)
    job = Job("a", "a.ply", "out", "key", {}, 1.0)
    sound = {"id": "a", "path": "a.ply", "key": "key", "status": "error", "version": "1", "message": "", "area": 2.0}
    job.record_file.write_text(json.dumps(sound), "utf-8")
    assert read_record(job) == sound
    job.record_file.write_text(json.dumps(sound | change), "utf-8")
    assert read_record(job) is None


@pytest.mark.parametrize("column", ["area", "flips", "status", "key"])
def test_a_column_that_would_pass_for_a_result_is_refused(place, column):
    (place / "table.csv").write_text(f"path,{column}\na.ply,2\n", "utf-8")
    with pytest.raises(OmtwarpError, match=f"a column '{column}' of its own"):
        run_cohort(read_manifest("table.csv"), "out", collect=True)
    assert not (place / "out").exists()


def test_a_journal_with_wrong_types_is_read_without_them(place):
    lines = [{"id": [], "key": "k", "status": "ok"}, 3, {"id": "a", "key": "k", "status": "ok"}, {"id": "a"}]
    (place / "journal.jsonl").write_text("\n".join(map(json.dumps, lines)), "utf-8")
    assert read_journal(place) == [lines[2]]


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes here")
@pytest.mark.parametrize("name", ["pipe", "/dev/zero", "."])
def test_items_that_are_no_files_fail_and_are_not_waited_for(place, name):
    os.mkfifo(place / "pipe")
    (place / "table.csv").write_text(f"path,id\n{name},a\n", "utf-8")
    assert len(key_of(name, {})) == 64
    assert run_cohort(read_manifest("table.csv"), "out", workers=1, until="conformal").counts == {"error": 1}


def test_polygons_that_are_not_there_are_one_line(place):
    head = "# vtk DataFile Version 3.0\na\n{}\nDATASET POLYDATA\nPOINTS 3 float\n"
    for kind, points in (("ASCII", b"0 0 0 1 0 0 0 1 0"), ("BINARY", bytes(36))):
        polygons = b"\nPOLYGONS 1000000000000 4000000000000\n3 0 1 2\n"
        (place / "a.vtk").write_bytes(head.format(kind).encode() + points + polygons)
        with pytest.raises(OmtwarpError):
            read_mesh("a.vtk")


def test_a_count_of_many_digits_is_one_line(place):
    (place / "a.coef").write_text("{ " + "9" * 5000 + ",{1, 2, 3}}", "ascii")
    with pytest.raises(OmtwarpError, match=r"no \.coef file"):
        read_coef("a.coef")


def test_data_of_three_dimensions_are_one_line():
    carried = resample((BALL.vertices, BALL.faces), "ico1")
    with pytest.raises(OmtwarpError, match="one row per point"):
        carried.apply(np.zeros((len(BALL.vertices), 2, 2)))
