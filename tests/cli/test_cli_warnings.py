"""Warnings of ``omtwarp map``, ``--strict``, and those of ``omtwarp check``."""

from __future__ import annotations

import json
import logging
import warnings

import numpy as np
import pytest

from omtwarp.commands._cli import main
from omtwarp.commands._streams import warnings_as_lines
from omtwarp.errors import OmtwarpWarning
from omtwarp.mesh.shapes import icosphere
from omtwarp.mesh.write import write_mesh


def _spiked(path):
    sphere = icosphere(3)
    vertices = sphere.vertices.copy()
    vertices[sphere.faces[0]] *= 12.0
    write_mesh(path, vertices, np.asarray(sphere.faces))
    return path


def _run(*arguments):
    with pytest.raises(SystemExit) as ended:
        main([str(argument) for argument in arguments])
    return ended.value.code


def test_strict_refuses_in_one_line_and_writes_nothing(tmp_path, capsys):
    mesh, output = _spiked(tmp_path / "spiked.ply"), tmp_path / "spiked.npz"
    assert _run("map", mesh, "-o", output, "--strict", "--quiet", "--device", "cpu") == 1
    said = capsys.readouterr().err.strip()
    assert "\n" not in said and "--strict: " in said and not output.exists()


def test_check_foretells(tmp_path, capsys):
    assert _run("check", _spiked(tmp_path / "spiked.ply"), "--json") == 0
    found = json.loads(capsys.readouterr().out)
    assert found["mappable"] and found["warnings"] and all("at (" in each["text"] for each in found["warnings"])


@pytest.mark.parametrize(
    "words",
    [["map", "-o", "a.npz"], ["report", "-o", "a.html"]]
    + [["film", "-o", "a.gif", "--size", "16x16", "--seconds", "0.1"], ["texture", "-o", "a.glb", "--size", "16"]],
)
def test_a_warning_is_one_line_in_every_command(tmp_path, capsys, monkeypatch, words):
    """No line of source code, and each warning once, however often the map is made."""
    monkeypatch.chdir(tmp_path)
    assert _run(words[0], _spiked(tmp_path / "spiked.ply"), *words[1:], "-q", "--device", "cpu") == 0
    lines = capsys.readouterr().err.splitlines()
    assert lines and len(set(lines)) == len(lines)
    assert all(line.startswith("omtwarp: warning: ") for line in lines), lines


def test_warnings_of_libraries_are_not_shown(capsys):
    """Neither those of Python's module of warnings nor those of its logs, as nibabel and trimesh have them."""
    with warnings_as_lines():
        np.log(np.zeros(1))
        logging.getLogger("nibabel.global").warning("pixdim[1,2,3] should be positive")
        logging.warning("a log")
        for _ in range(2):
            warnings.warn("areas are off", OmtwarpWarning, stacklevel=1)
    assert capsys.readouterr().err == "omtwarp: warning: areas are off\n"
    assert logging.root.manager.disable == logging.NOTSET
