"""The names of the package: what type checkers read is what is there."""

import ast
import importlib
from pathlib import Path

import pytest

import omtwarp


def names_for_type_checkers() -> dict[str, str]:
    """Every name of the block under TYPE_CHECKING, and the module that it is imported from."""
    tree = ast.parse(Path(omtwarp.__file__).read_text("utf-8"))
    block = next(node for node in tree.body if isinstance(node, ast.If))
    return {
        alias.asname: str(node.module)
        for node in block.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
        if alias.asname is not None
    }


def test_type_checkers_see_every_public_name():
    assert {*names_for_type_checkers(), "__version__"} == set(omtwarp.__all__)
    assert len(omtwarp.__all__) == len(set(omtwarp.__all__))


@pytest.mark.parametrize("name", sorted(omtwarp.__all__))
def test_names_are_what_type_checkers_think(name):
    value = getattr(omtwarp, name)
    if name != "__version__":
        assert getattr(importlib.import_module(names_for_type_checkers()[name]), name) is value


def test_only_public_names_are_listed():
    assert dir(omtwarp) == sorted(omtwarp.__all__)
