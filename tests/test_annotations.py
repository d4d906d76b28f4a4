"""Annotations say what a value is: ``Any`` stands in few modules, and in none of those that the maps come from."""

import ast
from pathlib import Path

import omtwarp

PACKAGE = Path(omtwarp.__file__).parent
WITHOUT = (
    "baselines", "conformal", "device", "flips", "geometry", "measures", "moser", "refine", "solvers", "start",
    "topology", "transport", "triangle_newton", "untangling", "wavelets",
)  # fmt: skip


def names_of_any(file: Path) -> list[int]:
    """Lines that use the name ``Any``."""
    tree = ast.parse(file.read_text("utf-8"))
    return [node.lineno for node in ast.walk(tree) if isinstance(node, ast.Name) and node.id == "Any"]


def test_the_stages_have_no_value_of_any_type():
    files = [file for name in WITHOUT for file in sorted((PACKAGE / name).rglob("*.py"))]
    assert len(files) > len(WITHOUT)
    found = [f"{file.relative_to(PACKAGE)}:{line}" for file in files for line in names_of_any(file)]
    assert found == []
