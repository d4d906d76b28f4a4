"""Every command and every piece of Python in the README and the documentation runs, in the order of its page."""

from __future__ import annotations

import contextlib
import io
import json
import os
import re
import runpy
import shlex
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from omtwarp.commands._cli import main
from omtwarp.mesh import shapes
from omtwarp.mesh.data import VertexData, write_data
from omtwarp.mesh.write import write_mesh

ROOT = Path(__file__).parent.parent
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
COMMANDS, CODE = ("console", "bash", "sh", "shell"), ("python", "py")
# What sets a machine up, or runs all of this from outside; run.py has tests of its own.
SET_UP = ("apt", "apt-get", "sudo", "git", "pip", "cd", "uv", "source", "export", ".venv/bin/pip")
SET_UP_BY_PYTHON = ("run.py", "-m venv", "-m pip", "-m sphinx", "docs/versions.py")
# An extension of Sphinx for what need not be whole to be sound. It leaves the list of all pages at the side to the
# first page: to make it anew for each of two hundred takes a third of the time of a build, and its links are those of
# the tables of contents. It makes no index of words for the search, pages of source code have no colours, and pictures
# have few pixels, those of notebooks too: IPython runs the files of a folder first.
LESS_WORK = """
import html, os, sys
from pathlib import Path
from small_pictures import shrink_all

os.environ["IPYTHONDIR"] = str(Path(__file__).parent / "ipython")
first = Path(os.environ["IPYTHONDIR"], "profile_default", "startup", "first.py")
first.parent.mkdir(parents=True)
first.write_text("from small_pictures import shrink_all; shrink_all()")

def drop(app, page, template, context, tree):
    if page != "index":
        context.pop("toctree", None)

def draw_less(app):
    app.builder.search = False
    shrink_all()

def no_colours(app):  # what follows are the pages of source code
    app.builder.highlighter.highlight_block = lambda code, *_, **__: f"<div><pre>{html.escape(code)}</pre></div>"
    return []

def setup(app):
    app.connect("builder-inited", draw_less)
    app.connect("html-page-context", drop, 1)
    app.connect("html-collect-pages", no_colours, 1)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
"""


@dataclass(frozen=True)
class Block:
    """A fenced block of a page: its language, its text, and the line that it starts on."""

    language: str
    text: str
    line: int


def blocks_of(text: str) -> list[Block]:
    """The fenced blocks of a page in Markdown."""
    found = []
    for match in re.finditer(r"^(```+|~~~+)[ \t]*([\w{}-]*)[^\n]*\n(.*?)^\1[ \t]*$", text, re.M | re.S):
        found.append(Block(match[2].lower(), match[3], text.count("\n", 0, match.start()) + 2))
    return found


def commands_of(block: Block) -> list[list[str]]:
    """The commands of a block as words: prompts, comments and, in a session with prompts, output left out."""
    lines = block.text.replace("\\\n", " ").splitlines()
    if any(line.lstrip().startswith("$ ") for line in lines):
        lines = [line.lstrip()[2:] for line in lines if line.lstrip().startswith("$ ")]
    return [words for line in lines if (words := shlex.split(line, comments=True))]


def is_set_up(words: list[str]) -> bool:
    rest = " ".join(words[1:])
    by_python = Path(words[0]).name.startswith("python") and rest.startswith(SET_UP_BY_PYTHON)
    return by_python or words[0] in SET_UP or words[0] == "./run.py"


@pytest.fixture(scope="module")
def files(tmp_path_factory) -> Path:
    """A folder with the files that the documentation speaks of, on small shapes."""
    folder = tmp_path_factory.mktemp("files")
    surface = shapes.limbs(length=0.5, sharpness=4.0, sphere=720)
    for name in ("bunny.ply", "mesh.ply", "bunny.obj"):
        write_mesh(folder / name, surface.vertices, surface.faces)
    kept = surface.faces[(surface.vertices[surface.faces, 2] > -0.4).all(axis=1)]
    used, kept = np.unique(kept, return_inverse=True)
    part, kept = surface.vertices[used], kept.reshape(-1, 3)
    write_mesh(folder / "face.ply", part, kept)
    both = np.concatenate([surface.faces, kept + len(surface.vertices)])
    write_mesh(folder / "parts.ply", np.concatenate([surface.vertices, part + 4.0]), both)
    double = shapes.rings(2, cell=0.3)
    ring = shapes.rings(1, cell=0.35)
    write_mesh(folder / "ring.ply", ring.vertices, ring.faces)
    write_mesh(folder / "pretzel.ply", double.vertices, double.faces)
    turned = surface.faces.copy()
    turned[::7] = turned[::7, ::-1]  # some triangles face inwards
    write_mesh(folder / "broken.ply", surface.vertices, turned)
    y, x = np.mgrid[0:64, 0:128]
    picture = np.stack([x * 2, y * 4, 128 + 0 * x], axis=2).astype(np.uint8)
    Image.fromarray(picture).save(folder / "earth.png")
    (folder / "shapes").mkdir()
    for name in ("a", "b"):
        write_mesh(folder / "shapes" / f"{name}.ply", surface.vertices, surface.faces)
    (folder / "cohort.csv").write_text("path,group\nshapes/a.ply,control\nshapes/b.ply,patient\n")
    members = [f"{k},{'ab'[k % 2]}.npz,{'abc'[k % 3]},{50 + k * k},{'north' if k < 4 else 'south'}" for k in range(9)]
    (folder / "subjects.csv").write_text(
        "\n".join(["id,path,group,age,site", *members, ""]).replace("b.npz", "bunny.npz")
    )
    (folder / "face.txt").write_text("\n".join(str(1 + k % 3) for k in range(surface.vertex_count)))
    white = shapes.blob(seed=3, sphere=shapes.icosphere(8))
    write_mesh(folder / "lh.white", white.vertices, white.faces)
    write_data(folder / "lh.thickness", VertexData(2.5 + white.vertices[:, :1], ("thickness",)))
    return folder


@pytest.fixture
def desk(files, tmp_path, monkeypatch) -> Path:
    """The page's own copy of the files, in which its commands run."""
    shutil.copytree(files, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def quietly(command: list[str], **options) -> subprocess.CompletedProcess:
    return subprocess.run(command, capture_output=True, text=True, check=False, **options)


def run_command(words: list[str]) -> None:
    """Run a command of the package in this process, and a script of the checkout in one of its own."""
    if words[0] == "omtwarp":
        output = io.StringIO()
        with contextlib.redirect_stdout(output), contextlib.redirect_stderr(output):
            try:
                main(words[1:])
                status = 0
            except SystemExit as end:
                status = end.code or 0
        assert status == 0, f"{' '.join(words)}: status {status}\n{output.getvalue()}"
    elif Path(words[0]).name.startswith("python"):
        script = ROOT / words[1]
        assert script.is_file(), f"{' '.join(words)}: there is no such script"
        environment = {**os.environ, "MPLBACKEND": "Agg", "PYTHONPATH": str(ROOT)}
        done = quietly([sys.executable, str(script), *words[2:]], env=environment)
        assert done.returncode == 0, done.stderr[-2000:]
    else:
        raise AssertionError(f"this test does not know how to run: {' '.join(words)}")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_commands_of_page_run(page, desk, smallest_pictures, short_warps, items_here):
    """As they are, but warps take few steps on a coarse grid, and pictures are small."""
    commands = [
        c for block in blocks_of(page.read_text("utf-8")) if block.language in COMMANDS for c in commands_of(block)
    ]
    for words in commands:
        if not is_set_up(words):
            run_command(words)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_python_of_page_runs(page, desk, smallest_pictures):
    code = [block for block in blocks_of(page.read_text("utf-8")) if block.language in CODE]
    if not code:
        return
    # Blank lines keep the page's line numbers in what a failure reports.
    lines: list[str] = []
    for block in code:
        lines += [""] * (block.line - 1 - len(lines)) + block.text.splitlines()
    script = desk / f"{page.stem}_code.py"
    script.write_text("\n".join(lines), "utf-8")
    with contextlib.redirect_stdout(io.StringIO()):
        runpy.run_path(str(script))


def test_readme_shows_commands_and_code():
    languages = {block.language for block in blocks_of((ROOT / "README.md").read_text("utf-8"))}
    assert languages & set(COMMANDS) and languages & set(CODE)


def test_reading_of_blocks():
    text = "a\n```console\n$ omtwarp map a.ply -o b.npz  # words\nits output\n```\n```python\nx = 1\n```\n"
    console, python = blocks_of(text)
    assert commands_of(console) == [["omtwarp", "map", "a.ply", "-o", "b.npz"]]
    assert (console.line, python.line, python.text) == (3, 7, "x = 1\n")
    assert commands_of(Block("sh", "omtwarp check \\\n  'a b.ply'\n# none\n", 1)) == [["omtwarp", "check", "a b.ply"]]
    assert is_set_up(["python3", "run.py", "demo"]) and is_set_up(["apt-get", "install"])
    assert not is_set_up(["python", "examples/x.py"]) and not is_set_up(["omtwarp", "demo"])


def test_every_command_and_public_name_is_documented():
    import omtwarp
    from omtwarp.commands._cli import SUMMARIES

    listed = (ROOT / "docs" / "api.rst").read_text("utf-8")
    for name in set(omtwarp.__all__) - {"__version__", "shapes"}:
        assert re.search(rf"^   {name}$", listed, re.M), f"docs/api.rst does not list {name}"
    told = "".join(page.read_text("utf-8") for page in PAGES)
    for name in SUMMARIES:
        assert f"omtwarp {name}" in told


def dead_links(site: Path) -> list[str]:
    """Links of a built site to pages or anchors that it does not have."""
    texts = {page.resolve(): page.read_text("utf-8") for page in site.rglob("*.html")}
    anchors = {page: set(re.findall(r'\b(?:id|name)="([^"]+)"', text)) for page, text in texts.items()}
    dead = []
    for page, text in texts.items():
        for link in re.findall(r'<a\b[^>]*\bhref="([^"]+)"', text):
            if re.match(r"(?:https?|mailto|data):", link):
                continue
            name, _, anchor = link.partition("#")
            target = (page.parent / name).resolve() if name else page
            if not target.exists() or (anchor and target in anchors and anchor not in anchors[target]):
                dead.append(f"{page.name}: {link}")
    return dead


def wider_than_a_phone(site: Path, profile: Path, width: int = 390) -> list[str]:
    """Pages written by hand that have to be moved sideways on a screen of that many pixels."""
    from reporting import browser  # not on Windows

    if browser.PROGRAM is None:
        return []
    shown = browser.Browser(profile)
    try:
        shown.ask("Emulation.setDeviceMetricsOverride", width=width, height=2 * width, deviceScaleFactor=1, mobile=True)
        wide = []
        for page in sorted((ROOT / "docs").glob("*.md")):
            file = site / f"{page.stem}.html"
            if file.is_file():
                shown.ask("Page.navigate", url=file.as_uri())
                shown.wait_for(f"location.href === {file.as_uri()!r} && document.readyState === 'complete'")
                if shown.run("document.documentElement.scrollWidth") > width:
                    wide.append(page.name)
        return wide
    finally:
        shown.close()


@pytest.mark.slow
def test_site_builds_without_a_warning(tmp_path):
    """All but the gallery's pictures, which tests/test_examples.py runs."""
    for module in ("sphinx", "sphinx_gallery", "myst_nb", "furo", "latex2mathml"):
        pytest.importorskip(module)
    source = tmp_path / "docs"
    ignored = shutil.ignore_patterns("_build", "gallery", "generated", "__pycache__")
    shutil.copytree(ROOT / "docs", source, ignore=ignored)
    for name in ("examples", "omtwarp", "pyproject.toml"):
        (tmp_path / name).symlink_to(ROOT / name)
    (source / "_ext" / "less_work.py").write_text(LESS_WORK, "utf-8")
    with (source / "conf.py").open("a", encoding="utf-8") as settings:
        settings.write('\nextensions.append("less_work")\n')
    paths = os.pathsep.join(filter(None, [str(ROOT / "tests"), os.environ.get("PYTHONPATH")]))
    command = [sys.executable, "-m", "sphinx", "-W", "-q", "-b", "html", "-D", "plot_gallery=0"]
    done = quietly([*command, str(source), str(tmp_path / "html")], env=os.environ | {"PYTHONPATH": paths})
    assert done.returncode == 0, done.stderr[-4000:]
    index = (tmp_path / "html" / "index.html").read_text("utf-8")
    assert "example_report.html" in index and (tmp_path / "html" / "example_report.html").stat().st_size > 500_000
    method = (tmp_path / "html" / "method.html").read_text("utf-8")
    assert method.count("<math") > 60 and "merror" not in method
    architecture = (tmp_path / "html" / "architecture.html").read_text("utf-8")
    assert '<svg class="data-flow"' in architecture and "transport/" in architecture
    assert dead_links(tmp_path / "html") == []
    for page in (tmp_path / "html").rglob("*.html"):
        fetched = re.findall(r'<(?:script|link|img|iframe)[^>]+(?:src|href)="(https?:[^"]+)"', page.read_text("utf-8"))
        assert not fetched, f"{page.name} fetches {fetched[0]}"
    assert 'class="versions"' not in index  # one version has none to choose from, and asks for no versions.json
    choosing = (tmp_path / "html" / "choosing.html").read_text("utf-8")
    assert choosing.count("_images/") >= 2 and "ScalarField" not in choosing  # pictures, without what draws them
    notebook = (tmp_path / "html" / "notebooks.html").read_text("utf-8")
    assert "srcdoc=" in notebook and "MapResult(" in notebook and "data:image/" in notebook  # its cells were run
    if sys.platform != "win32":
        assert wider_than_a_phone(tmp_path / "html", tmp_path / "profile") == []


def test_only_a_site_of_several_versions_has_a_list_of_them(tmp_path, monkeypatch):
    jinja2 = pytest.importorskip("jinja2")
    text = (ROOT / "docs" / "_templates" / "versions.html").read_text("utf-8")
    alone, beside = (
        jinja2.Template(text).render(pathto=lambda _: "index.html", root_doc="index", **known)
        for known in ({}, {"versions": "1"})
    )
    assert 'class="versions"' in beside
    assert not alone.strip()
    commands = []

    def ran(command, **_):
        commands.append(command)
        (tmp_path / "site" / "html").mkdir(parents=True)

    monkeypatch.setattr(subprocess, "run", ran)
    runpy.run_path(str(ROOT / "docs" / "versions.py"))["build"](tmp_path, tmp_path / "built")
    assert "versions=1" in commands[0]


def test_versions_are_listed_with_the_newest_first(tmp_path):
    versions = runpy.run_path(str(ROOT / "docs" / "versions.py"))
    for name in ("v0.1.0", "v0.10.0", "main", "v0.2.0"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "index.html").write_text("")
    (tmp_path / "not-a-version").mkdir()
    versions["write_list"](tmp_path, "v0.10.0")
    listed = json.loads((tmp_path / "versions.json").read_text("utf-8"))
    assert [entry["folder"] for entry in listed] == ["main", "v0.10.0", "v0.2.0", "v0.1.0"]
    assert "url=v0.10.0/" in (tmp_path / "index.html").read_text("utf-8")


def test_figures_of_the_page_on_performance_are_written_by_its_command():
    command = runpy.run_path(str(ROOT / "docs" / "performance.py"))
    page = (ROOT / "docs" / "performance.md").read_text("utf-8")
    table = command["measured"]([], sizes=(400,))
    changed = command["with_figures"](page, table)
    assert "| blob_" in table.splitlines()[-1]
    assert table in changed and command["with_figures"](changed, "none").count("| blob_") == 0
    heads = [line for line in page.splitlines() if line.startswith("| mesh |")]
    assert heads == [line for line in table.splitlines() if line.startswith("| mesh |")]


def test_modules_named_with_the_package_need_no_import_of_their_own():
    code = "import omtwarp; assert callable(omtwarp.shapes.blob)"
    done = quietly([sys.executable, "-c", code])
    assert done.returncode == 0, done.stderr
