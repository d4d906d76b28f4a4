"""The command ``film``: a file and facts about it, or one line."""

from __future__ import annotations

import json

import numpy as np
import pytest
from PIL import Image

from omtwarp.commands._cli import main
from omtwarp.maps.result import MapResult
from omtwarp.mesh import shapes
from omtwarp.render import films

DRAWING = ["--size", "64x36", "--seconds", "1", "--fps", "4", "--backend", "warp", "--device", "cpu"]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder with a map whose first and last stage differ."""
    ball = shapes.icosphere(4)
    first = ball.vertices * (1.0, 1.0, 1.4)
    first /= np.linalg.norm(first, axis=1)[:, None]
    MapResult(ball.vertices * (1.0, 1.3, 0.8), ball.faces, ball.vertices, first, np.ones(len(first))).save(
        tmp_path / "map.npz"
    )
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(films, "PROBE_WIDTH", 24)  # motion is measured on few pixels
    return tmp_path


def run(capsys, *arguments) -> tuple[int, str, str]:
    with pytest.raises(SystemExit) as ended:
        main([str(argument) for argument in arguments])
    out, err = capsys.readouterr()
    return int(ended.value.code or 0), out, err


def test_film_of_a_map(folder, capsys):
    status, out, err = run(capsys, "film", "--map", "map.npz", "-o", "flow.webp", *DRAWING, "--json")
    facts = json.loads(out)
    assert (status, err) == (0, "") and facts["output"] == "flow.webp" and 4 <= facts["frames"] <= 6
    assert facts["bytes"] == (folder / "flow.webp").stat().st_size
    with Image.open(folder / "flow.webp") as shown:
        assert shown.size == (64, 36) and shown.n_frames > 1
    status, out, _ = run(capsys, "film", "map.npz", "-o", "flow.gif", *DRAWING, "--no-captions", "--quiet")
    assert (status, out) == (0, "") and (folder / "flow.gif").read_bytes().startswith(b"GIF")


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["--map", "map.npz", "-o", "flow.png"], "unknown suffix '.png'"),
        (["--map", "none.npz", "-o", "flow.gif"], "no such file"),
        (["-o", "flow.gif"], "nothing to work on"),
        (["--map", "map.npz", "-o", "flow.gif", "--fps", "0"], "frames per second"),
        (["--map", "map.npz", "-o", "flow.gif", "--view", "nowhere"], "unknown view"),
    ],
)
def test_mistakes_are_one_line(folder, capsys, words, line):
    status, out, err = run(capsys, "film", *words)
    assert (status, out) == (1, "") and err.startswith("omtwarp: error: ") and line in err and err.count("\n") == 1
    assert not list(folder.glob("flow.*"))
