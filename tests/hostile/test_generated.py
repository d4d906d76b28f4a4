"""Generated hostile files and options: a good result, or one clear line and exit status 1 or 2; nothing lost."""

from __future__ import annotations

import functools
import io
import signal
import time
import warnings
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from generator import CASES, Case, cases

import omtwarp.commands._cli

LONGEST = 60  # seconds that a case may take
ON_A_DEVICE = ("map", "texture", "report", "preview", "spharm", "distance", "group", "resample")


class TooLong(BaseException):
    """Raised where a case takes longer than its limit."""


@contextmanager
def limited(seconds: int):
    """Raise TooLong in a block that takes longer than the limit."""
    if not hasattr(signal, "SIGALRM"):
        yield
        return

    def stop(*_):
        raise TooLong

    before = signal.signal(signal.SIGALRM, stop)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


@pytest.fixture
def quick(monkeypatch):
    """Replace slow functions that are not tested here: the demo's map, drawing with OpenGL, large textures unasked."""
    monkeypatch.setattr("omtwarp.reporting.page._stills", lambda *a: dict.fromkeys(_keys(a[1]), "data:,"))

    def drawn(job, *args):
        return [np.zeros((job.height, job.width, 4), np.uint8) for _ in job.shots], "nothing"

    monkeypatch.setattr("omtwarp.render.pictures.render", drawn)
    monkeypatch.setattr("omtwarp.render.gl_client.prepare", lambda: None)
    monkeypatch.setattr("omtwarp.render.films.PROBE_WIDTH", 16)  # of pictures on which motion is measured
    # A command is put together anew for every command line, which takes longer than most cases.
    monkeypatch.setattr("omtwarp.commands._cli.as_command", functools.cache(omtwarp.commands._cli.as_command))
    monkeypatch.setattr("omtwarp.reporting.scene.cube_faces", lambda *a, **k: [])
    monkeypatch.setattr("omtwarp.texturing.atlas.picture_size", lambda *a: (256, 256.0))


def _keys(stages):
    return [key for stage in stages for key in (stage.key, f"sphere {stage.key}")]


def complaint(case: Case, folder: Path, capsys) -> str:
    """Describe what is wrong with the way a case ended; empty where nothing is."""
    if case.file:
        (folder / case.file).write_bytes(case.content)
    before = {path.name: path.stat() for path in folder.iterdir() if path.is_file()}
    status: object = 0
    try:
        with limited(LONGEST), warnings.catch_warnings(record=True) as warned:
            warnings.simplefilter("always")
            omtwarp.commands._cli.main(
                [*case.arguments, "--device", "cpu"] if needs_device(case) else list(case.arguments)
            )
    except SystemExit as end:
        status = end.code or 0
    except TooLong:
        return f"no end after {LONGEST} s"
    except BaseException as error:
        return f"{type(error).__name__}: {error}"
    _, err = capsys.readouterr()
    words = [f"warning: {warning.message}" for warning in warned]
    if status not in (0, 1, 2):
        words.append(f"status {status}")
    if "internal error" in err or "Traceback" in err or "Warning" in err:
        words.append(err[-300:])
    errors = [line for line in err.splitlines() if line.startswith("omtwarp: error: ")]
    if status == 1 and (len(errors) != 1 or err.splitlines()[-1] != errors[0]):
        words.append(f"not one line: {err[-300:]!r}")
    if any(not (character.isprintable() or character == "\n") for character in err):
        words.append(f"control characters: {err[-300:]!r}")
    for name, status_before in before.items():
        status_after = (folder / name).stat() if (folder / name).exists() else None
        if status_after is None or changed(status_before, status_after):
            words.append(f"{name} was changed")
    for path in folder.iterdir():
        if path.name.startswith(".omtwarp-"):
            words.append(f"{path.name} was left")
        elif path.name not in before and path.name != "folder":
            if status != 0 and "saved as" not in err:
                words.append(f"{path.name} was written by what failed")
            remove(path)
    if case.file:
        (folder / case.file).unlink()
    return "; ".join(words)


def changed(before, after) -> bool:
    """Return whether a file was written or replaced."""
    return (before.st_ino, before.st_size, before.st_mtime_ns) != (after.st_ino, after.st_size, after.st_mtime_ns)


def remove(path: Path) -> None:
    """Remove a file, or a folder with files."""
    if path.is_dir():
        for inner in path.iterdir():
            inner.unlink()
        path.rmdir()
    else:
        path.unlink()


def needs_device(case: Case) -> bool:
    return case.arguments[0] in ON_A_DEVICE and "--device" not in case.arguments


def test_generated_cases_end_well(tmp_path, monkeypatch, capsys, quick):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.stdin", io.TextIOWrapper(io.BytesIO(b"")))
    (tmp_path / "folder").mkdir()
    found, times = [], []
    for case in cases(tmp_path):
        start = time.process_time()
        words = complaint(case, tmp_path, capsys)
        times.append((time.process_time() - start, case.name))
        if words:
            found.append(f"{case.name}: omtwarp {' '.join(map(repr, case.arguments))}\n    {words}")
    print(f"{len(times)} cases, {sum(t for t, _ in times):.0f} CPU s; longest: {sorted(times)[-5:]}")
    assert len(times) == CASES
    assert not found, f"{len(found)} of {CASES} cases:\n" + "\n".join(found[:40])
