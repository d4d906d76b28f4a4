"""Places that the page on architecture names exist and hold what it says: each is found in one step."""

import re
from pathlib import Path

import numpy as np
import pytest

import omtwarp
from omtwarp.device.start import wp
from omtwarp.mesh import read
from omtwarp.texturing import rasterize
from omtwarp.texturing.patterns import Pattern, srgb_colours
from omtwarp.texturing.patterns.checker import checker_colours

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "omtwarp"
PAGE = (ROOT / "docs" / "architecture.md").read_text("utf-8") if (ROOT / "docs").is_dir() else ""
pytestmark = pytest.mark.skipif(not PAGE, reason="the documentation is not beside the tests")
PATH = re.compile(r"`([a-z_]+(?:/[a-z_]+)*(?:\.py|/))`")


def rows(heading: str) -> dict[str, str]:
    """The rows of the table below a heading: the second cell by the first."""
    table = PAGE.split(f"## {heading}\n")[1].split("\n## ")[0]
    cells = [line.strip("|").split("|") for line in table.splitlines() if line.startswith("| ")]
    return {first.strip(): second.strip() for first, second, *_ in cells[2:]}


def answer(question: str) -> tuple[str, list[Path]]:
    """The row of either table that answers a question, and the places that it names."""
    both = rows("Sub-packages") | rows("Where to find")
    found = [(first, second) for first, second in both.items() if question in first or question in second]
    assert found, f"nothing on the page says: {question}"
    first, second = found[0]
    return second, [PACKAGE / path for path in PATH.findall(first + " " + second)]


def texts(places: list[Path]) -> str:
    files = [file for place in places for file in ([place] if place.is_file() else sorted(place.glob("*.py")))]
    return "\n".join(file.read_text("utf-8") for file in files)


def test_every_place_that_is_named_exists():
    named = [
        path
        for rows_of in ("Sub-packages", "Where to find", "Questions of a newcomer")
        for row in rows(rows_of).items()
        for path in PATH.findall(" ".join(row))
    ]
    assert len(named) > 40
    assert [path for path in named if not (PACKAGE / path).exists()] == []


@pytest.mark.parametrize(
    ("question", "holds"),
    [
        ("(4.3)", ["def optimal_transport", "4.3"]),
        ("area and angle metric", ["def distortion", "area"]),
        ("what runs on CUDA", ["def resolve_device", "cuda"]),
        ("a file format", ["def read_mesh", "def mesh_content", "def write_mesh", "def glb_bytes", "class GltfFile"]),
    ],
)
def test_a_newcomer_finds_it_in_one_step(question, holds):
    _, places = answer(question)
    text = texts(places)
    assert [words for words in holds if words not in text] == []


def test_every_sub_package_and_module_at_the_top_has_its_line():
    named = set(re.findall(r"`(\w+)/?`", " ".join(row.split("|")[0] for row in rows("Sub-packages"))))
    there = {p.stem for p in PACKAGE.iterdir() if p.suffix == ".py" or (p / "__init__.py").is_file()}
    assert there - {"__init__", "__main__", "version"} - named == set()
    assert all(len(text) > 10 for text in rows("Sub-packages").values())


def test_every_question_has_an_answer_and_an_example():
    table = PAGE.split("## Questions of a newcomer\n")[1].split("\n## ")[0]
    asked = [row.strip("|").split("|") for row in table.splitlines() if row.startswith("| ")][2:]
    words = ("4.3", "energy", "domain", "pattern", "file format", "command", "stop", "CUDA")
    assert all(word in question for word, (question, _, _) in zip(words, asked, strict=True))
    for _, _, example in asked:
        assert (ROOT / example.strip(" `")).is_file(), example


class Quarters(Pattern):
    """Four fields: a pattern needs a name, a kernel and what that is given."""

    name, title, _kernel = "quarters", "Four fields", checker_colours

    def _tables(self):
        return [2, 2, (srgb_colours("#ffffff", "#ff0000"), wp.vec3d)]


def test_a_new_pattern_is_a_class():
    directions = [[1.0, 1.0, 1.0], [1.0, -1.0, 1.0]]
    np.testing.assert_allclose(Quarters()(directions), [[1.0, 0.0, 0.0], [1.0, 1.0, 1.0]])
    picture = np.asarray(rasterize(Quarters(), 64))
    assert picture.shape[:2] == (32, 64) and set(map(tuple, picture.reshape(-1, 3))) == {(255, 255, 255), (255, 0, 0)}


def test_a_new_format_is_a_function_and_a_suffix(monkeypatch, tmp_path):
    def read_soup(data):
        corners = np.array(data.split(), dtype=np.float64).reshape(-1, 3)
        vertices, faces = np.unique(corners, axis=0, return_inverse=True)
        return vertices, faces.reshape(-1, 3), ["corners at one place were joined"]

    monkeypatch.setitem(read._OWN, "soup", read_soup)
    ball = omtwarp.shapes.icosphere(2)
    np.savetxt(tmp_path / "ball.soup", ball.vertices[ball.faces].reshape(-1, 3), fmt="%.17g")
    mesh = omtwarp.read_mesh(tmp_path / "ball.soup")
    np.testing.assert_array_equal(mesh.vertices[mesh.faces], ball.vertices[ball.faces])
    assert mesh.notes == ("corners at one place were joined",)
