"""Every script of examples/ runs as it is, in an empty folder, and leaves the checkout alone."""

from __future__ import annotations

import ast
import inspect
import os
import runpy
import subprocess
import sys
import warnings
from pathlib import Path

import pytest

import omtwarp

ROOT = Path(__file__).parent.parent
SCRIPTS = sorted((ROOT / "examples").glob("*.py"))
# Those with arguments, so that they take seconds; without any they do the same on more.
ARGUMENTS = {
    "benchmark.py": ["--sizes", "400", "--repeats", "1", "--device", "cpu"],
    "compare_disks.py": ["--heights", "3/4"],
    "cut_by_planes.py": ["--heights", "1/2", "--exact"],
    "hard_shapes.py": ["--rounds", "2", "--frequency", "4"],
    "mixed_topology.py": ["--count", "3", "--most-faces", "1500"],
    "paper_figures.py": ["--figures", "3", "8", "9"],
    "random_handles.py": ["--count", "2", "--most-faces", "1500"],
    "random_shapes.py": ["--count", "2", "--most-vertices", "600"],
}
# Public functions without a picture, and why.
NOT_DRAWN = {
    "harmonic_points": "the points that the map of every page is measured from",
    "register": "a cortex and its template, which the page on neuroimaging shows",
    "read_mesh": "a mesh looks the same before and after it is read",
    "write_report": "a page for a browser, which the documentation shows whole",
}
SLOW = ("compare_peers.py", "paper_figures.py", "paper_tables.py")


def test_an_example_runs_by_itself(tmp_path):
    environment = {**os.environ, "MPLBACKEND": "Agg", "PYTHONPATH": str(ROOT)}
    command = [sys.executable, str(ROOT / "examples" / "plot_1_quickstart.py")]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-3000:]
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "script",
    [pytest.param(s, marks=pytest.mark.slow if s.name in SLOW else ()) for s in SCRIPTS],
    ids=lambda script: script.stem,
)
def test_example_runs(script, tmp_path, monkeypatch, smallest_pictures):
    """In this process, as a new one takes seconds to begin, with pictures of few pixels."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(script.parent)
    monkeypatch.setattr(sys, "argv", [str(script), *ARGUMENTS.get(script.name, [])])
    pyplot = pytest.importorskip("matplotlib.pyplot")
    pyplot.switch_backend("Agg")
    with warnings.catch_warnings():
        warnings.filterwarnings("error", category=DeprecationWarning, module="__main__")
        try:
            runpy.run_path(str(script), run_name="__main__")
        except SystemExit as end:
            assert not end.code
        finally:
            pyplot.close("all")
    if script.name.startswith("plot_"):
        assert not list(tmp_path.iterdir()), "an example of the gallery writes files"


@pytest.mark.parametrize(
    "name", ["compare_disks", "compare_registrations", "convergence", "cut_by_planes", "least_area"]
)
def test_a_script_says_which_mesh_is_missing(name, tmp_path, monkeypatch):
    script = ROOT / "examples" / f"{name}.py"
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(script.parent)
    monkeypatch.setattr(sys, "argv", [str(script), "missing.ply"])
    with pytest.raises(SystemExit, match=r"missing\.ply: no such file"):
        runpy.run_path(str(script), run_name="__main__")


@pytest.mark.parametrize("script", [s for s in SCRIPTS if s.name.startswith("plot_")], ids=lambda script: script.stem)
def test_gallery_pages_have_a_title_and_a_picture(script):
    tree = ast.parse(script.read_text("utf-8"))
    title, underline, *rest = (ast.get_docstring(tree) or "").splitlines()
    assert len(underline) >= len(title) and set(underline) == {"="} and any(rest)
    shows = {node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
             for node in ast.walk(tree) if isinstance(node, ast.Call)}  # fmt: skip
    assert shows & {"show", "sheet", "preview"}


def test_gallery_shows_every_public_function():
    """Pages of the gallery call every function of the package; each page has a picture, as the test above says."""
    called = set()
    for script in SCRIPTS:
        if script.name.startswith("plot_"):
            for node in ast.walk(ast.parse(script.read_text("utf-8"))):
                if isinstance(node, ast.Call) and ast.unparse(node.func).startswith("omtwarp."):
                    called.add(ast.unparse(node.func).removeprefix("omtwarp."))
    public = {name for name in omtwarp.__all__ if inspect.isfunction(getattr(omtwarp, name))}
    assert len(public) > 25 and public - called == NOT_DRAWN.keys()
