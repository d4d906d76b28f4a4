"""The names of the package: what type checkers read is what is there."""

import ast
import importlib
from pathlib import Path
from typing import get_args

import pytest

import omtwarp
from omtwarp.colors import COLORMAPS
from omtwarp.mesh.read import MeshFile
from omtwarp.render.camera import LIGHTS
from omtwarp.render.pictures import ColormapName, LightName


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


@pytest.mark.parametrize("name", ["omtwarp", "omtwarp.render", "omtwarp.reporting", "omtwarp.texturing"])
def test_only_public_names_are_listed(name):
    package = importlib.import_module(name)
    assert dir(package) == sorted(package.__all__)


def test_shapes_alone_are_listed():
    assert {"icosphere", "demo_shape"} < set(dir(omtwarp.shapes)) and not {"np", "TINY", "_march"} & set(
        dir(omtwarp.shapes)
    )


def test_results_print_in_one_line():
    ball = omtwarp.shapes.icosphere(2)
    repaired = omtwarp.repair((ball.vertices, ball.faces[1:]))
    said = "Repaired(vertex_origin=int64[42], face_origin=int64[80], split_edges=int64[0, 2], given="
    assert repr(repaired).startswith(said) and "loss=0" in repr(repaired)
    for result in (repaired, omtwarp.untangle(ball, ball.vertices, device="cpu"), MeshFile(ball.vertices, ball.faces)):
        assert len(repr(result)) < 400 and "\n" not in repr(result), result


def test_names_of_lights_and_colour_maps_are_those_that_there_are():
    assert set(get_args(LightName)) == set(LIGHTS)
    assert set(get_args(ColormapName)) == set(COLORMAPS)
