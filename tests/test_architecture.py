"""Places that the page on architecture names exist and hold what it says: each is found in one step."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "omtwarp"
PAGE = (ROOT / "docs" / "architecture.md").read_text("utf-8") if (ROOT / "docs").is_dir() else ""
pytestmark = pytest.mark.skipif(not PAGE, reason="the documentation is not beside the tests")
PATH = re.compile(r"`([a-z_]+(?:/[a-z_]+)*(?:\.py|/))`")


def rows(heading: str) -> dict[str, str]:
    """The rows of the table below a heading: the second cell by the first."""
    table = PAGE.split(f"## {heading}\n")[1].split("\n## ")[0]
    cells = [line.strip("|").split("|") for line in table.splitlines() if line.startswith("| ")]
    return {first.strip(): second.strip() for first, second in cells[2:]}


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
        for rows_of in ("Sub-packages", "Where to find")
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
