"""Warnings of ``omtwarp map``, ``--strict``, and those of ``omtwarp check``."""

from __future__ import annotations

import json

import numpy as np
import pytest

from omtwarp.commands._cli import main
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
