"""Files appear whole or not at all."""

from __future__ import annotations

import json
import os
from concurrent.futures import ThreadPoolExecutor

import pytest

import omtwarp
from omtwarp.cohort import tables
from omtwarp.errors import OmtwarpError
from omtwarp.files import output
from omtwarp.files.output import RECORD, check_output, staged


def test_staging_leaves_nothing_after_an_error(tmp_path):
    target = tmp_path / "it.obj"
    check_output(target, (".obj",))
    target.write_text("old")
    with pytest.raises(RuntimeError), staged(target) as file:
        file.write_text("half")
        raise RuntimeError
    assert target.read_text() == "old" and list(tmp_path.iterdir()) == [target]
    with staged(target) as file:
        file.write_text("new")
        file.with_suffix(".mtl").write_text("beside")
    assert target.read_text() == "new" and (tmp_path / "it.mtl").read_text() == "beside"
    assert len(list(tmp_path.iterdir())) == 3  # with the record


def test_a_full_disk_is_one_line(tmp_path):
    with pytest.raises(OmtwarpError, match="No space left on device"), staged(tmp_path / "it.npz"):
        raise OSError(28, "No space left on device")
    assert list(tmp_path.iterdir()) == []


def test_a_missing_directory_is_one_line(tmp_path):
    with pytest.raises(OmtwarpError, match=r"cannot write '.*it\.npz': there is no directory"):
        with staged(tmp_path / "none" / "it.npz") as file:
            file.write_text("never")
    assert list(tmp_path.iterdir()) == []


def test_a_link_to_a_folder_that_is_not_there_names_that_folder(tmp_path):
    link = tmp_path / "link.npz"
    link.symlink_to(tmp_path / "gone" / "it.npz")
    with pytest.raises(OmtwarpError, match=r"there is no directory '.*gone'$"), staged(link):
        pass


def test_a_directory_in_the_way_is_one_line(tmp_path):
    (tmp_path / "it.npz").mkdir()
    with pytest.raises(OmtwarpError, match="cannot write"), staged(tmp_path / "it.npz") as file:
        file.write_text("new")
    assert os.listdir(tmp_path) == ["it.npz"] and os.listdir(tmp_path / "it.npz") == []


def test_staging_inside_of_staging(tmp_path):
    """Staging works inside of staging, as where a command stages what a function stages again."""
    target = tmp_path / "it.obj"
    with staged(target) as outer:
        with staged(outer) as inner:
            inner.write_text("surface")
            inner.with_suffix(".mtl").write_text("material")
        assert not target.exists() and outer.read_text() == "surface"
    assert sorted(os.listdir(tmp_path)) == [RECORD, "it.mtl", "it.obj"]


def test_companions_of_a_hidden_file_come_along(tmp_path):
    with staged(tmp_path / ".it.obj") as file:
        file.write_text("surface")
        file.with_name(".it.mtl").write_text("material")
    assert sorted(os.listdir(tmp_path)) == [".it.mtl", ".it.obj", RECORD]


def test_nothing_written_is_nothing_moved(tmp_path):
    with staged(tmp_path / "it.npz"):
        pass
    assert os.listdir(tmp_path) == []


def test_a_closed_pipe_is_not_taken_for_a_file(tmp_path):
    with pytest.raises(BrokenPipeError), staged(tmp_path / "it.npz"):
        raise BrokenPipeError
    assert os.listdir(tmp_path) == []


def test_files_written_at_once_are_all_recorded(tmp_path):
    def write(number):
        with staged(tmp_path / f"{number}.obj") as file:
            file.write_text("v")
            file.with_suffix(".mtl").write_text("newmtl")

    with ThreadPoolExecutor(8) as pool:
        list(pool.map(write, range(80)))
    assert json.loads((tmp_path / RECORD).read_text()).keys() == {f"{number}.mtl" for number in range(80)}


@pytest.mark.skipif(os.name == "nt", reason="names of files are text there")
def test_names_that_are_no_utf8(tmp_path):
    """Pages and tables of such files are written, and an OBJ finds its library and picture by the very bytes."""
    name = os.fsdecode(b"gr\xf6n")
    result = omtwarp.map_to_sphere(omtwarp.shapes.icosphere(4), until="conformal", device="cpu")
    made = tmp_path / f"{name}.obj"
    omtwarp.texture(result, pattern="checker", size=96, device="cpu").export(made)
    assert b"mtllib gr\xf6n.mtl\n" in made.read_bytes()
    assert omtwarp.texturing.read_painted_mesh(made).materials[0].picture is not None
    omtwarp.write_report(result, tmp_path / "page.html", title=name)
    assert r"<h1>gr\udcf6n</h1>" in (tmp_path / "page.html").read_text("utf-8")
    output.write_table(tmp_path / "table.csv", ["id"], [[name]])
    assert (tmp_path / "table.csv").read_text("utf-8").split() == ["id", r"gr\udcf6n"]
    table = tables.write_table([{"id": "a", "path": f"{name}.obj", "status": "ok"}], tmp_path)
    assert tables.read_table(table)[0]["path"] == r"gr\udcf6n.obj"


def test_results_in_a_folder_that_is_held_do_not_wait_for_it():
    """Directories of the package's own, as for standard output, are locked while files are recorded in them."""
    with output.scratch() as folder, output.folder_of_results(folder, "a.txt"):
        output.write_text(folder / "a.txt", "x")
        assert json.loads((folder / RECORD).read_text("utf-8")).keys() == {"a.txt"}
