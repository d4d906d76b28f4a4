"""Files of the working directory are data: no interpreter that the package starts imports one."""

from __future__ import annotations

import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import omtwarp
from omtwarp.files.interruptions import interpreter
from omtwarp.mesh import shapes
from omtwarp.mesh.write import write_mesh

# What the package, Python's start and the libraries import first.
NAMES = ("omtwarp", "signal", "json", "numpy", "warp", "PIL", "runpy", "tempfile", "pickle", "trimesh", "sitecustomize")


@pytest.fixture
def trap(tmp_path):
    """A working directory with modules that write a line when they are imported, and a mesh."""
    folder = tmp_path / "work"
    folder.mkdir()
    for name in NAMES:
        words = f"open({str(tmp_path / 'imported.txt')!r}, 'a').write({name + chr(10)!r})\n"
        (folder / f"{name}.py").write_text(words, "utf-8")
    ball = shapes.icosphere(2)
    write_mesh(folder / "ball.ply", ball.vertices * [1.0, 1.2, 1.5], ball.faces)
    (folder / "table.csv").write_text("path\nball.ply\n", "utf-8")
    return folder


def run(command: list[str], folder: Path) -> subprocess.CompletedProcess[str]:
    """Run a command in a folder and return how it ended."""
    settings = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "PYTHONSAFEPATH")}
    return subprocess.run(command, cwd=folder, env=settings, capture_output=True, text=True, timeout=300, check=False)


def imported(folder: Path) -> list[str]:
    """Return the names of the traps that were imported."""
    file = folder.parent / "imported.txt"
    return file.read_text("utf-8").split() if file.exists() else []


def test_the_traps_are_imported_without_the_option(trap):
    assert run([sys.executable, "-c", "import signal, json"], trap).returncode == 0
    assert "json" in imported(trap)


def test_an_interpreter_finds_the_package_and_not_the_folder(trap):
    done = run(interpreter("import omtwarp, json, sys; print(omtwarp.__file__, *sys.argv[1:])", "a", "b"), trap)
    assert done.stdout.split() == [omtwarp.__file__, "a", "b"]
    assert imported(trap) == []


@pytest.mark.parametrize(
    "line",
    [
        "cohort table.csv -o out --until conformal --workers 1 --device cpu",
        "preview ball.ply -o ball.png --size 32 --device cpu",
    ],
)
def test_commands_start_no_module_of_the_working_folder(trap, line):
    if line.startswith("preview") and importlib.util.find_spec("pyrender") is None:
        pytest.skip("no drawing process without pyrender")
    done = run([sys.executable, "-P", "-c", "from omtwarp.commands._cli import main; main()", *line.split()], trap)
    assert done.returncode == 0, done.stderr
    assert imported(trap) == []


def test_every_interpreter_is_started_in_one_place():
    """No other module names the interpreter's path, but the one that asks whether there is any."""
    package = Path(omtwarp.__file__).parent
    named = {
        str(file.relative_to(package))
        for file in package.rglob("*.py")
        if re.search(r"sys\.executable", file.read_text("utf-8"))
    }
    assert named == {str(Path("files") / "interruptions.py"), str(Path("render") / "gl_client.py")}
