"""Cohorts: bad cases are rows, killed processes do no harm, nothing is computed twice, and there is one table."""

from __future__ import annotations

import contextlib
import ctypes
import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

import omtwarp
from omtwarp.cohort import read_manifest, run, run_cohort
from omtwarp.cohort.executors import Host, make_folders
from omtwarp.cohort.host import run_item
from omtwarp.cohort.item import Job, complete_journal, forget_failure, key_of, read_journal, read_record, settle
from omtwarp.cohort.page import outliers
from omtwarp.cohort.tables import map_of, read_table
from omtwarp.commands._cli import main
from omtwarp.errors import OmtwarpError
from omtwarp.files.output import locked
from omtwarp.maps.result import MapResult
from omtwarp.mesh.shapes import blob, demo_shape
from omtwarp.mesh.write import write_mesh
from omtwarp.registration import warp

PATIENCE = 240.0  # seconds; only a machine that does nothing for us makes a test wait so long
PR_SET_CHILD_SUBREAPER = 36  # of Linux's prctl
linux = pytest.mark.skipif(sys.platform != "linux", reason="looks for processes in /proc")


def write_shapes(folder: Path, count: int, faces: int = 80) -> list[Path]:
    folder.mkdir(exist_ok=True)
    paths = [folder / f"sub-{k:03d}_hemi-L.ply" for k in range(count)]
    for k, path in enumerate(paths):
        surface = blob(k, amplitude=0.2, degree=3, sphere=faces)
        write_mesh(path, surface.vertices, surface.faces)
    return paths


def spoil(paths: list[Path]) -> None:
    """Damage files in ten ways, so that none holds a surface that can be mapped."""
    surface = blob(0, sphere=80)
    vertices, faces = surface.vertices, surface.faces
    nan = vertices.copy()
    nan[3] = np.nan
    paths[0].unlink()
    paths[1].write_bytes(b"")
    paths[2].write_text("nonsense")
    paths[3].write_bytes(paths[3].read_bytes()[:300])
    write_mesh(paths[4], nan, faces)
    write_mesh(paths[5], vertices, faces[1:])
    write_mesh(paths[6], vertices, np.vstack([faces, faces[:1]]))
    write_mesh(paths[7], np.vstack([vertices, vertices + 5]), np.vstack([faces, faces + len(vertices)]))
    write_mesh(paths[8], np.zeros_like(vertices), faces)
    paths[9].unlink()
    paths[9].mkdir()


def journal(folder: Path) -> list[tuple[str, str]]:
    return [(entry["id"], entry["key"]) for entry in read_journal(folder)]


def wait_for(condition, what: str, patience: float = PATIENCE):
    end = time.monotonic() + patience
    while time.monotonic() < end:
        if value := condition():
            return value
        time.sleep(0.01)
    raise AssertionError(f"{what} did not come about")


def children(process: int) -> list[int]:
    found = []
    for task in Path(f"/proc/{process}/task").glob("*/children"):
        found += [int(word) for word in task.read_text().split()]
    return found


def manifest_of(paths: list[Path], file: Path) -> Path:
    rows = [f"{path},{'patient' if k % 2 else 'control'}" for k, path in enumerate(paths)]
    file.write_text("path,group\n" + "\n".join(rows) + "\n")
    return file


def holding(out: Path, name: str) -> int:
    """Hold an item's lock, as a process that works on it does, so that others wait."""
    import fcntl  # there is none on Windows

    lock = os.open(out / "locks" / name, os.O_RDWR | os.O_CREAT)
    fcntl.flock(lock, fcntl.LOCK_EX)
    return lock


@contextlib.contextmanager
def adopting_orphans():
    """Become the parent of processes whose parent is killed, so that their CPU time is counted here."""
    system = ctypes.CDLL(None)
    system.prctl(PR_SET_CHILD_SUBREAPER, 1)
    try:
        yield
    finally:
        system.prctl(PR_SET_CHILD_SUBREAPER, 0)


def cpu_seconds_of_children(others: set[int]) -> float:
    """Return the CPU time of all descendants that have ended, after those of a killed driver have.

    Args:
        others: children that other tests left, such as the process that draws, which ends when it has idled for long.
    """
    while left := set(children(os.getpid())) - others:
        for child in left:
            os.waitpid(child, 0)
    used = resource_usage()
    return used.ru_utime + used.ru_stime


def resource_usage():
    import resource  # there is none on Windows

    return resource.getrusage(resource.RUSAGE_CHILDREN)


def resident_mib(process: int) -> float:
    return int(Path(f"/proc/{process}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20


@linux
def test_bad_surfaces_and_deaths_of_drivers_and_a_worker(tmp_path):
    """Nothing is lost, nothing computed twice; the driver's memory stays, and a thousand maps cost little more.

    ``OMTWARP_COHORT=1000 pytest -s -k deaths tests/cohort`` takes 1,000 whole maps and prints its figures.
    """
    count = int(os.environ.get("OMTWARP_COHORT", "40"))
    large = count >= 1000
    spoilt = 20 if large else 10  # in ten ways
    stride, workers = count // spoilt, 2 if large else 1
    paths = write_shapes(tmp_path / "in", count, 320 if large else 80)
    for ways in range(0, spoilt, 10):
        spoil(paths[::stride][ways : ways + 10])
    manifest, out = manifest_of(paths, tmp_path / "cohort.csv"), tmp_path / "out"
    make_folders(out)
    command = [sys.executable, "-m", "omtwarp", "cohort", str(manifest), "-o", str(out), "--device", "cpu"]
    command += ["--workers", str(workers), *([] if large else ["--until", "moser"])]
    before, others, memory = resource_usage(), set(children(os.getpid())), []

    def watched(driver: subprocess.Popen, done: int) -> None:
        def reached() -> bool:
            now = len(read_journal(out))
            if driver.poll() is None:
                memory.append((driver.pid, now, resident_mib(driver.pid)))
            time.sleep(0.5 if large else 0.02)
            return now >= done or driver.poll() is not None

        wait_for(reached, "progress", 3600.0 if large else PATIENCE)

    with adopting_orphans():
        for k in (1, 2, 3) if large else (1, 3):
            done = k * count // 4 + 1  # the worker's next item, a good one, waits for its lock
            held = [holding(out, paths[done + i].stem) for i in range(2 * workers)]
            driver = subprocess.Popen([*command, "-q"])
            watched(driver, done)
            for lock in held[:workers]:  # these begin, and may end before or after the driver's death is noticed
                os.close(lock)
            driver.send_signal(signal.SIGKILL)
            assert driver.wait() == -signal.SIGKILL
            for lock in held[workers:]:
                os.close(lock)
            assert not (out / "table.parquet").exists()
        done = count - count // 10 + 1
        held = [holding(out, paths[done + i].stem) for i in range(workers)]
        with (tmp_path / "said").open("w") as said_to, (tmp_path / "errors").open("w") as errors:
            driver = subprocess.Popen([*command, "--json"], stdout=said_to, stderr=errors)
            watched(driver, done)
            os.kill(children(driver.pid)[0], signal.SIGKILL)
            for lock in held:
                os.close(lock)
            watched(driver, count)
            assert driver.wait() == 0
        used = cpu_seconds_of_children(others) - before.ru_utime - before.ru_stime
    said = json.loads((tmp_path / "said").read_text())
    assert said["counts"] == {"ok": count - spoilt, "error": spoilt}
    assert f"of {count} done" in (tmp_path / "errors").read_text()
    assert said["computed"] <= count - 3 * count // 4
    entries = journal(out)
    assert len(entries) == len(set(entries)) == count  # nothing lost, nothing twice
    rows = {row["id"]: row for row in read_table(Path(said["table"]))}
    assert len(rows) == count
    assert [rows[path.stem]["status"] == "ok" for path in paths] == [k % stride != 0 for k in range(count)]
    assert all(row["message"] and "\n" not in row["message"] for row in rows.values() if row["status"] == "error")
    assert not any("internal error" in row["message"] for row in rows.values())
    good = rows["sub-001_hemi-L"]
    assert (good["group"], good["sub"], good["flips"]) == ("patient", "001", 0)
    assert MapResult.load(out / "maps" / "sub-001_hemi-L.npz").bijective
    page = (out / "report.html").read_text()
    assert page.count("<figure>") == 6
    assert page.count("data:image/webp") == 6
    last = [(now, held_mib) for pid, now, held_mib in memory if pid == driver.pid and now < count]
    at_work = [(now, held_mib) for now, held_mib in last if now > 3 * count // 4 + 1]
    maps = sum(row["cpu_seconds"] for row in rows.values())
    print(f"{count} surfaces, {maps:.1f} CPU s of maps, {used:.1f} in all: {100 * (used / maps - 1):.1f} % more")
    print("driver, MiB at so many done:", [(now, round(mib)) for _, now, mib in memory][:: max(1, len(memory) // 40)])
    if at_work:
        assert max(mib for _, mib in at_work) - at_work[0][1] < 16.0
    if large:
        assert used < 1.1 * maps
    again = run_cohort(read_manifest(manifest), out, collect=True, device="cpu")
    assert again.computed == 0


def test_a_driver_does_not_load_warp():
    code = "import sys, omtwarp.cohort; print('warp' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "False\n"


def test_a_table_without_pyarrow_says_the_same(tmp_path, monkeypatch, items_here):
    write_shapes(tmp_path / "in", 3)
    (tmp_path / "in" / "bad.ply").write_text("no mesh, with a comma")
    items = read_manifest(tmp_path / "in")
    options = {"workers": 1, "until": "conformal", "device": "cpu"}
    first = run_cohort(items, tmp_path / "out", shard=(1, 2), **options)
    assert first.counts == {"ok": 1, "error": 1, "waiting": 2}
    both = run_cohort(items, tmp_path / "out", shard=(2, 2), **options)
    assert both.counts == {"ok": 3, "error": 1}
    assert both.computed == 2
    pytest.importorskip("pyarrow")
    assert both.table.suffix == ".parquet"
    rows = read_table(both.table)
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    plain = run_cohort(items, tmp_path / "out", collect=True, **options)
    assert plain.table.name == "table.csv"
    assert not both.table.exists()
    assert read_table(plain.table) == [{k: v or None if v == "" else v for k, v in row.items()} for row in rows]
    assert run_cohort(items, tmp_path / "out", retry=True, **options).computed == 1  # failures alone


def test_shards_that_end_together_write_the_table_one_after_the_other(tmp_path, monkeypatch, items_here):
    items, write = read_manifest(write_shapes(tmp_path / "in", 2)[0].parent), run.write_table

    def write_alone(rows, folder):
        with pytest.raises(OmtwarpError, match="taken"), locked(folder / "locks" / ".results", "taken"):
            pass
        return write(rows, folder)

    monkeypatch.setattr(run, "write_table", write_alone)
    for number in (1, 2):
        run_cohort(items, tmp_path / "out", shard=(number, 2), workers=1, until="conformal", device="cpu")


def job_for(folder: Path, faces: int, **limits) -> Job:
    surface = demo_shape(faces) if faces > 2000 else blob(0, sphere=faces)
    write_mesh(folder / "mesh.ply", surface.vertices, surface.faces)
    options = {"device": "cpu", "repair": False}
    make_folders(folder)
    path = str(folder / "mesh.ply")
    return Job("mesh", path, str(folder), key_of(path, options), options, **{"time_limit": PATIENCE} | limits)


@pytest.fixture(scope="module")
def host():
    made = Host()
    yield made
    made.close()


def test_an_item_that_takes_too_long_is_ended(tmp_path, host):
    job = job_for(tmp_path, 12000, time_limit=0.05)
    record = host.run(job)
    assert record["status"] == "timeout"
    assert "longer than 0.05 s" in record["message"]
    assert not job.map_file.exists()
    assert [file.name for file in (tmp_path / "maps").iterdir()] == []


@linux
def test_an_item_that_takes_too_much_memory_is_ended(tmp_path, host):
    record = host.run(job_for(tmp_path, 12000, memory_limit=2**23))
    assert record["status"] == "memory"
    assert "0.00781 GiB" in record["message"]


@linux
def test_an_item_whose_process_is_killed_is_tried_again(tmp_path):
    job, host = job_for(tmp_path, 6000), Host()
    found: list[dict] = []
    thread = threading.Thread(target=lambda: found.append(host.run(job)))
    thread.start()
    try:
        process = wait_for(lambda: host._process, "the host").pid
        os.kill(wait_for(lambda: children(process), "the item")[0], signal.SIGKILL)
        thread.join(PATIENCE)
        assert found[0]["status"] == "ok"
        assert len(journal(tmp_path)) == 1
    finally:
        host.close()


@linux
def test_nothing_is_left_running_when_the_driver_has_gone(tmp_path):
    job, host = job_for(tmp_path, 12000), Host()
    thread = threading.Thread(target=lambda: host.run(job), daemon=True)
    thread.start()
    process = wait_for(lambda: host._process, "the host")
    item = wait_for(lambda: children(process.pid), "the item")[0]
    process.stdin.close()  # as the system does for a driver that dies
    wait_for(lambda: not Path(f"/proc/{item}").exists(), "the end of the item")
    thread.join(PATIENCE)


def test_what_a_process_wrote_at_its_end_is_kept_and_entered_in_the_journal(tmp_path):
    job = job_for(tmp_path, 320)
    run_item(job)
    before, record = journal(tmp_path), read_record(job)
    assert record["status"] == "ok"
    assert settle(job, "crashed", "its process was killed") == record  # it had come to its end before
    forget_failure(job)
    assert read_record(job) == record
    (tmp_path / "journal.jsonl").write_text('{"id": "mesh", "ke')  # the machine stopped in the middle of a line
    for _ in range(2):
        complete_journal([job], tmp_path)
        assert journal(tmp_path) == before


def test_a_map_that_is_cut_short_gone_or_changed_is_not_done(tmp_path, items_here):
    """What is left of a map is computed again; a whole one that the record does not have stops the run."""
    write_shapes(tmp_path / "in", 2)
    items, out = read_manifest(tmp_path / "in"), tmp_path / "out"
    options = {"workers": 1, "until": "conformal", "device": "cpu"}
    assert run_cohort(items, out, **options).computed == 2
    first, second = (out / "maps" / f"{item.id}.npz" for item in items)
    for kept in (0.5, -1, 0, None):
        whole = first.read_bytes()  # of another length every time, as it has times in it
        first.unlink()
        if kept is not None:
            first.write_bytes(whole[: int(kept * len(whole)) if kept >= 0 else kept])
        assert run_cohort(items, out, collect=True, **options).counts == {"ok": 1, "waiting": 1}
        again = run_cohort(items, out, **options)
        assert (again.computed, again.counts) == (1, {"ok": 2})
        assert MapResult.load(first).bijective
    whole = first.read_bytes()
    for changed in (second.read_bytes(), whole[:40] + bytes([whole[40] ^ 1]) + whole[41:]):
        first.write_bytes(changed)
        assert run_cohort(items, out, collect=True, **options).counts == {"ok": 1, "waiting": 1}
        with pytest.raises(OmtwarpError, match="did not write what is there, or it was changed"):
            run_cohort(items, out, **options)
        assert first.read_bytes() == changed


def test_a_map_of_other_options_is_replaced_and_goes_with_a_failure(tmp_path, items_here):
    paths = write_shapes(tmp_path / "in", 1)
    items, out = read_manifest(tmp_path / "in"), tmp_path / "out"
    options = {"workers": 1, "device": "cpu"}
    for until in ("conformal", "moser"):
        assert run_cohort(items, out, until=until, **options).counts == {"ok": 1}
    paths[0].write_text("no mesh")
    assert run_cohort(items, out, until="moser", **options).counts == {"error": 1}
    assert not list((out / "maps").iterdir())
    write_shapes(tmp_path / "in", 1)
    assert run_cohort(items, out, until="moser", **options).counts == {"ok": 1}


def test_keys_follow_input_options_and_version(tmp_path, monkeypatch):
    file = tmp_path / "a.ply"
    file.write_text("1")
    first = key_of(file, {"refine": "area"})
    assert key_of(file, {"refine": "area"}) == first
    assert key_of(file, {"refine": "angle"}) != first
    monkeypatch.setattr("omtwarp.cohort.item.package_version", lambda: "9.9")
    assert key_of(file, {"refine": "area"}) != first
    monkeypatch.undo()
    file.write_text("2")
    assert key_of(file, {"refine": "area"}) != first
    assert key_of(tmp_path / "missing", {}) != first


def test_what_lies_furthest_out_is_found():
    rows = [{"id": str(k), "area": 2.0 + 0.001 * (k % 5), "angle": 3.0, "seconds": None} for k in range(20)]
    rows[7]["area"] = 2.5
    assert outliers(rows)[0][0]["id"] == "7"
    assert "area distortion 2.5" in outliers(rows)[0][1]


class TestManifest:
    def test_patterns_and_folders_name_items_after_files_and_folders(self, tmp_path):
        for name in ("sub-01/surf/lh.white", "sub-02/surf/lh.white"):
            (tmp_path / name).parent.mkdir(parents=True)
            (tmp_path / name).write_text("x")
        items = read_manifest(str(tmp_path / "sub-*" / "surf" / "*"))
        assert [item.id for item in items] == ["sub-01_surf_lh.white", "sub-02_surf_lh.white"]
        with pytest.raises(OmtwarpError, match="names no surface"):
            read_manifest(tmp_path)

    def test_files_of_a_folder_that_are_left_out_are_named(self, tmp_path, capsys):
        write_shapes(tmp_path / "in", 1)
        names = ["lh.inflated", "lh.sphere", "notes.txt", "scan"]
        for name in [*names, "b.obj.gz", "lh.pial", ".hidden"]:
            (tmp_path / "in" / name).write_text("x")
        (tmp_path / "in" / "deeper").mkdir()
        with pytest.raises(SystemExit):
            main(["cohort", str(tmp_path / "in"), "-o", str(tmp_path / "out"), "--collect", "--json"])
        told = capsys.readouterr()
        assert json.loads(told.out)["counts"] == {"waiting": 3}
        assert told.err.startswith("omtwarp: warning: ") and told.err.count("\n") == 1
        assert f"left out 4 files, which are no meshes by their names: {', '.join(names)};" in told.err

    @pytest.mark.parametrize(
        ("text", "message"),
        [
            ("file\na.ply\n", "no column 'path'"),
            ("path,group\na.ply\n", "line 2: not 2 columns"),
            ("path\n\n \n", "line 3: the path is empty"),
            ("path\nb5\0.ply\n", "line 2: the path .* has a null byte"),
            ("path,group,group\na.ply,1,2\n", "several columns called 'group'"),
            ("id,path\nA,a.ply\na,b.ply\n", "1 items .* have the name of another, the first is 'a'"),
            ("id,path\n../..,a.ply\n", "has no letter or digit"),
            ("path\n", "names no surface"),
        ],
    )
    def test_tables_that_cannot_be_used(self, tmp_path, text, message):
        (tmp_path / "m.csv").write_text(text)
        with pytest.raises(OmtwarpError, match=message):
            read_manifest(tmp_path / "m.csv")

    def test_no_name_leaves_the_folder_of_results(self, tmp_path):
        (tmp_path / "m.tsv").write_text("id\tpath\n../../etc/x y\ta.ply\n")
        (item,) = read_manifest(tmp_path / "m.tsv")
        assert item.id == "etc_x_y"
        assert item.path == tmp_path / "a.ply"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--shard", "3/2"], "unknown shard '3/2'"),
        (["--executor", "cloud"], "unknown executor 'cloud'"),
        (["--time-limit", "0"], "time limit must be above 0"),
        (["--executor", "dask:tcp://127.0.0.1:1"], "no Dask scheduler answers"),
    ],
)
def test_requests_that_cannot_be_met(tmp_path, capsys, monkeypatch, words, message):
    write_shapes(tmp_path / "in", 1)
    if "dask" in words[1]:
        distributed = pytest.importorskip("distributed")

        def refuse(*_, **__):
            raise OSError("refused")

        monkeypatch.setattr(distributed, "Client", refuse)
    with pytest.raises(SystemExit) as ended:
        main(["cohort", str(tmp_path / "in"), "-o", str(tmp_path / "out"), *words])
    assert ended.value.code == 1
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


def test_holes_are_filled_where_asked_for(tmp_path, capsys, items_here):
    """Closed and open surfaces are mapped alike, and a group takes them; surfaces of two parts are failures."""
    paths = write_shapes(tmp_path / "in", 4, faces=320)
    for k, path in enumerate(paths[1:3], 1):
        surface = blob(k, amplitude=0.2, degree=3, sphere=320)
        kept = surface.faces[(surface.vertices[surface.faces, 2] < 0.8).all(axis=1)]
        used, faces = np.unique(kept, return_inverse=True)
        write_mesh(path, surface.vertices[used], faces.reshape(-1, 3))
    surface = blob(0, sphere=80)
    twice = np.vstack([surface.vertices, surface.vertices + 5]), np.vstack([surface.faces, surface.faces + 42])
    write_mesh(paths[3], *twice)
    words = [str(tmp_path / "in"), "-o", str(tmp_path / "out"), "--workers", "1", "--device", "cpu", "--json"]
    with pytest.raises(SystemExit) as ended:
        main(["cohort", *words, "--fill-area", "small", "--quiet"])
    assert not ended.value.code
    assert json.loads(capsys.readouterr().out)["counts"] == {"ok": 3, "error": 1}
    maps = [tmp_path / "out" / "maps" / f"{path.stem}.npz" for path in paths[:3]]
    closed, *filled = [MapResult.load(file) for file in maps]
    assert closed.domain == "sphere" and all(one.closed().certificate.bijective for one in filled)
    plain = run_cohort(read_manifest(tmp_path / "in"), tmp_path / "plain", workers=1, device="cpu")
    assert plain.counts == {"ok": 1, "error": 3}
    with pytest.raises(SystemExit) as ended:
        main(["group", *map(str, maps), "-o", str(tmp_path / "study"), "--grid", "ico1", "--degree", "3", "--quiet"])
    assert not ended.value.code and (tmp_path / "study" / "distances.csv").exists()
    with pytest.raises(OmtwarpError, match="natural"):
        run_cohort(read_manifest(tmp_path / "in"), tmp_path / "plain", fill_area="large")


@pytest.mark.parametrize("to", ["group", "target.npz"])
def test_maps_are_registered_after_they_are_made(tmp_path, monkeypatch, capsys, items_here, short_warps, to):
    """The table has the facts, `group` takes the registered maps, and a second run repeats nothing."""
    monkeypatch.chdir(tmp_path)
    # Steps enough for folds to meet.
    monkeypatch.setattr(warp, "ITERATIONS", 8)
    monkeypatch.setattr(sys.modules[omtwarp.register.__module__], "COARSE", warp.COARSE[1:3])
    for k in range(3):
        surface = blob(k % 2, amplitude=0.3, degree=6, sphere=720)
        write_mesh(tmp_path / f"s{k}.ply", surface.vertices, surface.faces)
    target = omtwarp.map_to_sphere(blob(0, amplitude=0.3, degree=6, sphere=720), until="moser", device="cpu")
    target.save("target.npz")
    (tmp_path / "list.csv").write_text("path\ns0.ply\ns1.ply\ns2.ply\n")
    line = "cohort list.csv -o out --until moser --device cpu --workers 1 --register".split()
    times = []
    for computed, more in ((3, []), (0, []), (0, ["--collect"])):
        with pytest.raises(SystemExit) as ended:
            main([*line, to, "--json", *more])
        said = json.loads(capsys.readouterr().out)
        assert not ended.value.code and said["computed"] == computed and said["counts"] == {"ok": 3}
        rows = read_table(Path(said["table"]))
        folder = "registered" if to == "group" else "maps"
        times.append([file.stat().st_mtime_ns for file in sorted((tmp_path / "out" / folder).glob("s*.npz"))])
    assert times[0] == times[1] == times[2]
    with pytest.raises(SystemExit):  # without the options of the run, which are taken from it
        main("cohort list.csv -o out --collect --quiet".split())
    assert read_table(Path(said["table"])) == rows
    other = "target.npz" if to == "group" else "group"
    with pytest.raises(SystemExit):
        main(["cohort", "list.csv", "-o", "out", "--collect", "--quiet", "--register", other])
    assert "not of this register" in capsys.readouterr().err
    assert read_table(Path(said["table"])) == rows
    assert all(row["registered_to"].endswith(to) for row in rows)
    assert all(row["registration_flips"] == 0.0 and row["registration_strain"] < 1.2 for row in rows)
    assert rows[0]["registration_sulc"] > 0.96
    ends = [MapResult.load(tmp_path / "out" / folder / f"s{k}.npz") for k in (0, 2)]
    assert ends[0].report["registration"]["certificate"]["flips"] == 0
    np.testing.assert_allclose(ends[0].sphere, ends[1].sphere, atol=1e-6)  # of one surface
    assert map_of(Path("out"), rows[0]) == Path("out", folder, "s0.npz")


WRONG_OPTIONS = {
    "items": (3, "abc", None, ["a.ply"], [None]),
    "shard": (3, "abc", None, (1,), (1.5, 2), (1, 1, 1), np.ones((2, 2)), (np.nan, 1)),
    "workers": ("2", 0, 1.5, np.nan, [2]),
    "time_limit": ("60", None, np.nan, np.ones(2), True),
    "memory_limit": ("1", None, np.nan, np.ones(2), True),
    "executor": (None, 3, np.ones(3), "cloud"),
}


@pytest.mark.parametrize("name", WRONG_OPTIONS)
def test_options_of_no_use_are_named(tmp_path, name):
    ball = blob(sphere=80)
    write_mesh(tmp_path / "ball.ply", ball.vertices, ball.faces)
    for wrong in WRONG_OPTIONS[name]:
        with pytest.raises(OmtwarpError, match=name) as caught:
            run_cohort(**{"items": read_manifest(tmp_path / "*.ply"), "folder": tmp_path / "out"} | {name: wrong})
        assert "\n" not in str(caught.value)


def test_an_item_with_the_name_of_a_result_is_refused_before_the_work(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (path,) = write_shapes(tmp_path / "in", 1)
    (tmp_path / "list.csv").write_text(f"path,id\n{path},template\n")
    with pytest.raises(SystemExit) as ended:
        main(["cohort", "list.csv", "-o", "out", "--register", "group"])
    assert ended.value.code == 1 and "an item is called 'template'" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_memory_that_warp_does_not_get_is_told_as_memory(tmp_path, monkeypatch, items_here):
    def full(*_, **__):
        raise RuntimeError("Failed to allocate 393216 bytes on device 'cpu'")

    write_shapes(tmp_path / "in", 1)
    monkeypatch.setattr("omtwarp.cohort.host._map", full)
    found = run_cohort(read_manifest(tmp_path / "in"), tmp_path / "out", workers=1, device="cpu")
    assert found.counts == {"memory": 1}


@pytest.mark.parametrize(("to", "words"), [("none.npz", "none.npz"), ("list.csv", "list.csv"), ("ico2", "no folds")])
def test_targets_that_cannot_be_registered_to_are_one_line_before_the_work(tmp_path, monkeypatch, capsys, to, words):
    monkeypatch.chdir(tmp_path)
    manifest_of(write_shapes(tmp_path / "in", 1), tmp_path / "list.csv")
    with pytest.raises(SystemExit) as ended:
        main(["cohort", "list.csv", "-o", "out", "--register", to])
    told = capsys.readouterr().err
    assert ended.value.code == 1 and words in told and told.count("\n") == 1
    assert not (tmp_path / "out").exists()
