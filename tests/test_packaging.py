"""What is shipped works: the wheel in clean environments, the sdist's own tests, an editable clone, names and links."""

from __future__ import annotations

import importlib.util
import os
import re
import shutil
import subprocess
import sys
import tarfile
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
VERSIONS = ("3.11", "3.12", "3.13", "3.14")
# The others need a few hundred MB and some seconds each: OMTWARP_TEST_PYTHONS=all, or a list like "3.12,3.13".
ASKED = os.environ.get("OMTWARP_TEST_PYTHONS", f"{sys.version_info.major}.{sys.version_info.minor}")
# With small pictures on the page, as large ones take most of the time.
ONE_AFTER_THE_OTHER = """
import sys
from omtwarp.commands._cli import main
from omtwarp.reporting import page
draw = page.preview
page.preview = lambda *given, **options: draw(*given, **options | {"size": (48, 36)})
for line in sys.argv[1:]:
    try:
        main(line.split())
    except SystemExit as end:
        assert not end.code, line
"""
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]


def clean(**more: str) -> dict[str, str]:
    """The environment without what would let an installed package find this checkout."""
    return {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV")} | more


def done(command: list, cwd: Path, **environment: str) -> str:
    """Standard output of a command that has to succeed."""
    words = [str(word) for word in command]
    ended = subprocess.run(words, cwd=cwd, env=clean(**environment), capture_output=True, text=True, check=False)
    assert ended.returncode == 0, f"{' '.join(words)}: {ended.stdout[-2000:]}{ended.stderr[-2000:]}"
    return ended.stdout


def python_of(environment: Path) -> Path:
    return environment / ("Scripts/python.exe" if os.name == "nt" else "bin/python")


def interpreter(version: str) -> str | None:
    """A Python of this version: this one, one on the PATH that runs, or one of pyenv's."""
    if version == f"{sys.version_info.major}.{sys.version_info.minor}":
        return sys.executable
    pyenv = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv")) / "versions"
    for found in (shutil.which(f"python{version}"), *sorted(pyenv.glob(f"{version}.*/bin/python"), reverse=True)):
        if found is None:
            continue
        asked = subprocess.run([found, "--version"], capture_output=True, text=True, check=False)
        if asked.returncode == 0 and f"Python {version}." in asked.stdout:
            return str(found)
    return None


@pytest.fixture(scope="module")
def built(tmp_path_factory) -> Path:
    """A folder with the sdist, and the wheel that is made from it."""
    for module in ("build", "hatchling"):
        pytest.importorskip(module)
    folder = tmp_path_factory.mktemp("built")
    done([sys.executable, "-m", "build", "--no-isolation", "--outdir", folder, ROOT], folder)
    return folder


@pytest.fixture(scope="module")
def unpacked(built, tmp_path_factory) -> Path:
    """The sdist's one folder."""
    folder = tmp_path_factory.mktemp("sdist")
    with tarfile.open(next(built.glob("*.tar.gz"))) as archive:
        if hasattr(tarfile, "data_filter"):
            archive.extractall(folder, filter="data")
        else:  # before Python 3.11.4
            archive.extractall(folder)
    return next(folder.iterdir())


def install_by_pip(python: str, environment: Path, wheel: Path) -> None:
    """Install a wheel as users do, or skip the test where that cannot be done."""
    made = subprocess.run([python, "-m", "venv", environment], capture_output=True, text=True, check=False)
    if made.returncode != 0:
        pytest.skip(f"this Python makes no virtual environments: {made.stdout.strip()[-200:]}")
    pip = [python_of(environment), "-m", "pip"]
    reach = [*pip, "download", "-q", "--no-deps", "--dest", environment / "reach", "threadpoolctl"]
    if subprocess.run(reach, env=clean(), capture_output=True, check=False).returncode != 0:
        pytest.skip("no package index can be reached from here")
    options = ["-q", "--disable-pip-version-check", "--no-compile", "--only-binary", ":all:"]
    done([*pip, "install", *options, wheel], environment)


def installed_by_uv(python: str, environment: Path, wheel: Path) -> bool:
    """Whether uv, which takes a tenth of pip's time, installed a wheel in a new environment."""
    if importlib.util.find_spec("uv") is None:
        return False
    uv = [sys.executable, "-m", "uv", "-q"]
    for command in (
        [*uv, "venv", "--python", python, environment],
        [*uv, "pip", "install", "--only-binary", ":all:", "--python", python_of(environment), wheel],
    ):
        if subprocess.run(command, env=clean(), capture_output=True, check=False).returncode != 0:
            shutil.rmtree(environment, ignore_errors=True)
            return False
    return True


@pytest.mark.slow
@pytest.mark.parametrize("version", VERSIONS)
def test_wheel_in_a_clean_environment_maps_textures_previews_and_reports(version, built, tmp_path):
    if ASKED != "all" and version not in ASKED.split(","):
        pytest.skip(f"Python {version} is not in OMTWARP_TEST_PYTHONS={ASKED}")
    python = interpreter(version)
    if python is None:
        pytest.skip(f"no Python {version} on this machine")
    wheel = next(built.glob("*.whl"))
    if not installed_by_uv(python, tmp_path / "env", wheel):
        install_by_pip(python, tmp_path / "env", wheel)
    inside = python_of(tmp_path / "env")
    command = inside.with_name("omtwarp.exe" if os.name == "nt" else "omtwarp")
    make = "import omtwarp; m = omtwarp.shapes.blob(seed=3, sphere=320); "
    make += "from omtwarp.mesh.write import write_mesh; write_mesh('blob.ply', m.vertices, m.faces); "
    where = done([inside, "-c", make + "print(omtwarp.__file__, omtwarp.__version__)"], tmp_path).split()
    assert Path(where[0]).is_relative_to((tmp_path / "env").resolve()) or Path(where[0]).is_relative_to(tmp_path)
    assert where[1] == PROJECT["version"]
    assert PROJECT["version"] in done([command, "--version"], tmp_path)
    lines = ["map blob.ply -o map.npz --device cpu --report map.json", "texture --map map.npz -o blob.glb --size 256"]
    if python == sys.executable:  # the others show that dependencies and syntax are there for them
        lines += ["preview blob.glb -o blob.png --size 160x120", "report --map map.npz -o blob.html"]
    done([inside, "-c", ONE_AFTER_THE_OTHER, *lines], tmp_path)  # in one process, as each takes seconds to begin
    assert (tmp_path / "blob.glb").read_bytes().startswith(b"glTF")
    assert '"bijective": true' in (tmp_path / "map.json").read_text("utf-8")
    if python == sys.executable:
        assert (tmp_path / "blob.png").read_bytes().startswith(b"\x89PNG")
        page = (tmp_path / "blob.html").read_text("utf-8")
        assert "<canvas" in page and len(page) > 500_000  # with three.js in it, which is package data


def test_sdist_holds_what_the_tests_need_and_they_run_from_it(unpacked):
    tracked = {p.relative_to(ROOT).parts[0] for p in ROOT.glob("*")} - {"out"}
    for name in ("omtwarp", "tests", "docs", "examples", "run.py", "README.md", "LICENSE", "CHANGELOG.md"):
        assert name in tracked and (unpacked / name).exists(), f"the sdist lacks {name}"
    for folder in ("tests", "docs", "examples", "omtwarp"):
        for file in (ROOT / folder).rglob("*.py"):
            inside = file.relative_to(ROOT)
            if not {"_build", "gallery", "generated", "__pycache__"} & set(inside.parts):
                assert (unpacked / inside).is_file(), f"the sdist lacks {inside}"
    where = done([sys.executable, "-c", "import omtwarp; print(omtwarp.__file__)"], unpacked).strip()
    assert Path(where).resolve().is_relative_to(unpacked.resolve())
    few = ["tests/test_docs.py::test_reading_of_blocks", "tests/device/test_sums.py"]
    cache = os.environ.get("WARP_CACHE_PATH", str(ROOT / ".warp"))
    said = done([sys.executable, "-m", "pytest", "-p", "no:cacheprovider", *few], unpacked, WARP_CACHE_PATH=cache)
    assert re.search(r"\d+ passed", said) and "failed" not in said


def test_a_clone_named_like_the_package_does_not_hide_an_editable_install(tmp_path):
    pytest.importorskip("hatchling")
    clone = tmp_path / "omtwarp"
    clone.mkdir()
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, clone)
    shutil.copytree(ROOT / "omtwarp", clone / "omtwarp", ignore=shutil.ignore_patterns("__pycache__"))
    done([sys.executable, "-m", "venv", "--without-pip", tmp_path / "env"], tmp_path)
    inside = python_of(tmp_path / "env")
    # The backend and the dependencies of this environment, but none of its editable installs.
    here = Path(pytest.__file__).parent.parent
    site = Path(done([inside, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))"], tmp_path).strip())
    (site / "here.pth").write_text(str(here))
    pip = [sys.executable, "-m", "pip", "--python", inside, "install", "-q", "--disable-pip-version-check"]
    done([*pip, "--no-index", "--no-deps", "--no-build-isolation", "--force-reinstall", "-e", clone], tmp_path)
    code = "import omtwarp; print(omtwarp.__file__, omtwarp.map_to_sphere.__module__)"
    where, module = done([inside, "-c", code], tmp_path).split()  # the current folder holds the clone
    assert Path(where).resolve() == (clone / "omtwarp" / "__init__.py").resolve()
    assert module.startswith("omtwarp.")


def test_readme_can_be_read_on_any_site():
    links = re.findall(r"!\[[^\]]*\]\(([^)]+)\)", (ROOT / "README.md").read_text("utf-8"))
    assert links
    name = PROJECT["urls"]["Source"].removeprefix("https://github.com/")
    base = f"https://raw.githubusercontent.com/{name}/main/"
    for link in links:
        assert link.startswith(base), f"{link} is no absolute link"
        picture = ROOT / link.removeprefix(base)
        assert picture.stat().st_size < (400_000 if picture.suffix == ".webp" else 300_000)  # a film, or a picture


def test_every_extra_that_a_message_names_exists():
    named = set()
    for file in [*(ROOT / "omtwarp").rglob("*.py"), ROOT / "README.md", *(ROOT / "docs").glob("*.md")]:
        text = file.read_text("utf-8")
        named |= {extra for group in re.findall(r"omtwarp\[([\w,]+)\]", text) for extra in group.split(",")}
        for wanted in re.findall(r"pip install ([^\s'\"].*)", text):
            assert wanted.startswith(("-", "--", "imageio-ffmpeg")), (
                f"{file.name} tells to install {wanted!r}, not an extra of ours"
            )
    assert named and named <= set(PROJECT["optional-dependencies"]), named


def test_classifiers_name_the_versions_that_are_tested():
    listed = re.findall(r"Python :: (3\.\d+)", "\n".join(PROJECT["classifiers"]))
    workflow = (ROOT / ".github" / "workflows" / "tests.yml").read_text("utf-8")
    assert tuple(listed) == VERSIONS
    assert re.findall(r'"(3\.\d+)"', workflow) == listed
