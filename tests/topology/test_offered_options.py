"""What ``omtwarp check`` offers for a mesh, ``omtwarp map`` does."""

import re

import numpy as np
import pytest

from omtwarp.commands._cli import main
from omtwarp.errors import OmtwarpError
from omtwarp.mesh import shapes
from omtwarp.mesh.read import read_mesh
from omtwarp.mesh.write import write_mesh


def torus(around: int = 12, across: int = 8) -> tuple[np.ndarray, np.ndarray]:
    i, j = (grid.ravel() for grid in np.meshgrid(np.arange(around), np.arange(across), indexing="ij"))
    u, v = 2 * np.pi * i / around, 2 * np.pi * j / across
    points = np.stack([(2 + np.cos(v)) * np.cos(u), (2 + np.cos(v)) * np.sin(u), np.sin(v)], axis=1)

    def at(a, b):
        return (a % around) * across + b % across

    lower = np.stack([at(i, j), at(i + 1, j), at(i + 1, j + 1)], axis=1)
    return points, np.concatenate([lower, np.stack([at(i, j), at(i + 1, j + 1), at(i, j + 1)], axis=1)])


def strip(twists: int, count: int = 24) -> tuple[np.ndarray, np.ndarray]:
    """A closed strip; with one half twist it is Möbius' band."""
    t = 2 * np.pi * np.arange(count) / count
    rows = []
    for side in (-0.3, 0.3):
        r = 1 + side * np.cos(twists * t / 2)
        rows.append(np.stack([r * np.cos(t), r * np.sin(t), side * np.sin(twists * t / 2)], axis=1))
    points = np.stack(rows, axis=1).reshape(-1, 3)
    faces = []
    for k in range(count):
        a, b, c, d = 2 * k, 2 * k + 1, 2 * k + 2, 2 * k + 3
        if k == count - 1:
            c, d = (1, 0) if twists % 2 else (0, 1)
        faces += [[a, c, b], [b, c, d]]
    return points, np.array(faces)


def ball_and_torus() -> tuple[np.ndarray, np.ndarray]:
    points, faces = torus()
    ball = shapes.icosphere(3)
    return np.concatenate([points, ball.vertices + 5]), np.concatenate([faces, ball.faces + len(points)])


MESHES = {
    "triangle": (np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]), np.array([[0, 1, 2]])),
    "torus with a hole": (torus()[0], torus()[1][1:]),
    "ball and torus": ball_and_torus(),
    "band": strip(0),
    "Möbius": strip(1),
    "torus": torus(),
}


@pytest.mark.parametrize("name", MESHES)
def test_every_option_that_check_offers_is_one_that_map_takes(tmp_path, monkeypatch, capsys, name):
    monkeypatch.chdir(tmp_path)
    write_mesh("a.ply", *MESHES[name])
    with pytest.raises(SystemExit):
        main(["check", "a.ply"])
    text = capsys.readouterr().out
    offers = re.findall(r"^  option (--.*?):.*?(?:\(with (.*?)\))?$", text, re.M)
    named = set(re.findall(r"--[a-z-]+", text.split("  option ")[0])) - {"--repair"}
    offered = {option for option, _ in offers for option in re.findall(r"--[a-z-]+", option)}
    if name == "Möbius":
        assert not offers and not named
        return
    assert ("--torus" in named | offered) == (name == "torus")
    assert offers
    for option, more in offers:
        for one in re.findall(r"--[a-z-]+", option):
            words = [one, *(["natural"] if one == "--fill-area" else []), *re.findall(r"--[a-z-]+", more)]
            until = [] if one == "--torus" else ["--until", "conformal"]
            with pytest.raises(SystemExit) as ended:
                main(["map", "a.ply", "-o", "a.npz", *words, *until, "--device", "cpu", "--quiet"])
            assert not ended.value.code, (words, capsys.readouterr().err)


def test_xml_that_is_no_gifti_is_named(tmp_path):
    pytest.importorskip("nibabel")
    (tmp_path / "a.gii").write_text("<?xml version='1.0'?><a></a>")
    with pytest.raises(OmtwarpError, match="no GIFTI file: XML of another kind"):
        read_mesh(tmp_path / "a.gii")
