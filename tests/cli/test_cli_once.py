"""``omtwarp map`` examines the mesh, certifies the map and writes the file once each."""

import sys
from collections import Counter

import numpy as np
import pytest

import omtwarp.flips.exact
import omtwarp.mapping.pipeline
import omtwarp.maps.result
import omtwarp.mesh.validate
from omtwarp import shapes
from omtwarp.commands._cli import main
from omtwarp.mesh.write import write_mesh


@pytest.fixture
def counted(monkeypatch):
    """Count the calls of the functions that examine meshes, certify maps and write archives."""
    counts = Counter()

    def count(name, *modules):
        original = getattr(modules[0], name)

        def counting(*arguments, **options):
            counts[name] += 1
            return original(*arguments, **options)

        for module in modules:
            monkeypatch.setattr(module, name, counting)

    count("check", omtwarp.mesh.validate)
    count("certify_triangles", omtwarp.mapping.pipeline, omtwarp.maps.result)
    count("savez", np)
    decide = omtwarp.flips.exact.orientation_signs

    def deciding(sphere, faces, **options):
        points = sphere if isinstance(sphere, np.ndarray) else sphere.numpy()
        counts["decided", sys._getframe(1).f_code.co_name, points.tobytes()] += 1
        return decide(sphere, faces, **options)

    monkeypatch.setattr(omtwarp.flips.exact, "orientation_signs", deciding)
    return counts


def map_file(folder, vertices, faces, *options):
    write_mesh(folder / "in.ply", vertices, faces)
    with pytest.raises(SystemExit) as ended:
        main(["map", str(folder / "in.ply"), "-o", str(folder / "out.npz"), "--device", "cpu", "--json", *options])
    assert ended.value.code == 0


def test_a_map_is_examined_certified_and_written_once(tmp_path, counted):
    """Mesh, coarse triangulation and final map are examined once each, and the file is written once.

    Whether a map is one to one is decided once, where it may need repair, and whether a triangle is flipped once,
    where a minimisation begins with it.
    """
    surface = shapes.blob(seed=2, amplitude=0.2, sphere=1280)
    map_file(tmp_path, surface.vertices, surface.faces)
    maps = {key: counted.pop(key) for key in list(counted) if isinstance(key, tuple)}
    assert counted == {"check": 2, "certify_triangles": 1, "savez": 1}
    assert len(maps) > 2 and set(maps.values()) == {1}


def test_a_map_of_a_part_of_the_sphere_is_written_once(tmp_path, counted):
    ball = shapes.icosphere(8)
    used, lower = np.unique(ball.faces[ball.vertices[ball.faces].mean(axis=1)[:, 2] < 0.1], return_inverse=True)
    map_file(tmp_path, ball.vertices[used], lower.reshape(-1, 3), "--hemisphere", "--until", "conformal")
    assert counted["savez"] == 1
