"""Annotations give types: ``Any`` is used nowhere.

Warp's own annotations ask for the type of every array at every use, so that mypy skips that package: its arrays,
devices and kernels, written ``wp.array``, ``wp.Device`` and ``wp.Kernel``, are not checked (see ``pyproject.toml``).
"""

import ast
from pathlib import Path

import omtwarp

PACKAGE = Path(omtwarp.__file__).parent


def names_of_any(file: Path) -> list[int]:
    """Lines that use the name ``Any``, or the attribute ``typing.Any``."""
    tree = ast.parse(file.read_text("utf-8"))
    return [
        node.lineno
        for node in ast.walk(tree)
        if (isinstance(node, ast.Name) and node.id == "Any") or (isinstance(node, ast.Attribute) and node.attr == "Any")
    ]


def test_no_value_is_of_any_type():
    names = [file.relative_to(PACKAGE).as_posix() for file in sorted(PACKAGE.rglob("*.py"))]
    assert len(names) > 200
    found = [f"{name}:{line}" for name in names for line in names_of_any(PACKAGE / name)]
    assert found == []
