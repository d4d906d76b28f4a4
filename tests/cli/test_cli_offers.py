"""Every option that ``omtwarp check`` offers for a mesh is one that ``omtwarp map`` takes for it."""

from __future__ import annotations

import itertools
import json
import re

import numpy as np
import pytest
import trimesh

from omtwarp.commands._cli import main
from omtwarp.mesh.shapes import icosphere
from omtwarp.mesh.write import write_mesh

BALL = icosphere(2).vertices, np.asarray(icosphere(2).faces)
TRIANGLE = BALL[0][:3], np.array([[0, 1, 2]])


def ring(around, across, turns, point):
    """A band of squares cut in two, closed around; and across too, where ``across`` is a number to count modulo."""
    rows = across if turns is None else across - 1
    vertices = np.array([point(2 * np.pi * i / around, j) for i in range(around) for j in range(across)])

    def at(i, j):
        if turns is None:
            return (i % around) * across + j % across
        return i * across + j if i < around else (across - 1 - j if turns else j)

    faces = []
    for i, j in itertools.product(range(around), range(rows)):
        a, b, c, d = at(i, j), at(i + 1, j), at(i + 1, j + 1), at(i, j + 1)
        faces += [[a, b, c], [a, c, d]]
    return vertices, np.array(faces)


def torus(around=12, across=8):
    def point(u, j):
        v = 2 * np.pi * j / across
        return [(1 + 0.4 * np.cos(v)) * np.cos(u), (1 + 0.4 * np.cos(v)) * np.sin(u), 0.4 * np.sin(v)]

    return ring(around, across, None, point)


def band(twisted):
    def point(u, j):
        half = u / 2 if twisted else np.pi / 2
        side = 0.3 * (j - 1)
        return [(1 + side * np.cos(half)) * np.cos(u), (1 + side * np.cos(half)) * np.sin(u), side * np.sin(half)]

    return ring(24, 3, twisted, point)


def without(mesh, *gone):
    return mesh[0], np.delete(mesh[1], gone, axis=0)


def beside(*meshes):
    """Put meshes next to each other."""
    starts = np.cumsum([0, *(len(vertices) for vertices, _ in meshes)])
    moved = [vertices + [5.0 * k, 0.0, 0.0] for k, (vertices, _) in enumerate(meshes)]
    return np.vstack(moved), np.vstack([faces + start for (_, faces), start in zip(meshes, starts, strict=False)])


KINDS = {
    "triangle": TRIANGLE,
    "strip": (np.array([[k // 2, k % 2, 0] for k in range(6)]), np.array([[0, 2, 1], [1, 2, 3], [2, 4, 3], [3, 4, 5]])),
    "ball with a hole": without(BALL, 0),
    "ball with two holes": without(BALL, 0, 40),
    "band": band(False),
    "Mobius band": band(True),
    "torus": torus(),
    "torus with a hole": without(torus(), 0),
    "torus with two holes": without(torus(), 0, 100),
    "two balls": beside(BALL, BALL),
    "ball and triangle": beside(BALL, TRIANGLE),
    "ball and torus": beside(BALL, torus()),
    "two tori": beside(torus(), torus()),
    "ball with a hole and torus": beside(without(BALL, 0), torus()),
    "torus with a hole and ball": beside(without(torus(), 0), BALL),
    "ball and Mobius band": beside(BALL, band(True)),
}  # fmt: skip


def offered(text: str) -> list[list[str]]:
    """Read the command lines that a line of offers stands for: ``--disk, --cap: ... (with --cut)`` for two of them."""
    head = text.partition(":")[0]
    more = [word for found in re.findall(r"\(with ([^)]*)\)", text) for word in re.findall(r"--[a-z-]+", found)]
    if " or " in head:
        name, *_ = head.split()
        return [[name, value, *more] for value in re.findall(r"\w+", head.removeprefix(name).replace(" or ", " "))]
    return [[name, *more] for name in head.split(", ")]


def offers_of(file: str, capsys) -> list[str]:
    """Return what check offers for a file, after map has taken every one of it."""
    with pytest.raises(SystemExit):
        main(["check", file, "--json"])
    options = json.loads(capsys.readouterr().out)["options"]
    for words in itertools.chain.from_iterable(map(offered, options)):
        # Of a sphere the first stage alone, before which an option that does not fit is refused.
        stages = [] if "--torus" in words else ["--until", "conformal"]
        with pytest.raises(SystemExit) as ended:
            main(["map", file, "-o", "map.npz", "--device", "cpu", "-q", *words, *stages])
        assert not ended.value.code, (words, capsys.readouterr().err)
    return options


@pytest.mark.parametrize("kind", KINDS)
def test_map_takes_what_check_offers(tmp_path, capsys, monkeypatch, kind):
    monkeypatch.chdir(tmp_path)
    write_mesh("mesh.ply", *KINDS[kind])
    assert bool(offers_of("mesh.ply", capsys)) == ("Mobius" not in kind)


@pytest.mark.parametrize("suffix", ["glb", "obj", "stl"])
def test_several_meshes_of_a_file_are_offered_as_parts(tmp_path, capsys, monkeypatch, suffix):
    """Two objects of an OBJ, meshes of a GLB, and solids of an STL alike."""
    monkeypatch.chdir(tmp_path)
    two = trimesh.Scene()
    for place in (0.0, 5.0):
        two.add_geometry(trimesh.Trimesh(BALL[0] + [place, 0.0, 0.0], BALL[1], process=False))
    if suffix == "stl":
        texts = [trimesh.exchange.stl.export_stl_ascii(one) for one in two.geometry.values()]
        (tmp_path / "two.stl").write_text("\n".join(texts), "ascii")
    else:
        two.export(f"two.{suffix}")
    assert [line.split(":")[0] for line in offers_of(f"two.{suffix}", capsys)] == ["--components", "--together"]
