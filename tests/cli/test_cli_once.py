"""``omtwarp map`` examines the mesh, certifies the map and writes the file once each."""

from collections import Counter

import numpy as np
import pytest

import omtwarp.mesh.validate
import omtwarp.pipeline
import omtwarp.result
from omtwarp import shapes
from omtwarp.cli import main
from omtwarp.mesh.write import write_mesh


@pytest.fixture
def counted(monkeypatch):
    """Count the calls of what examines meshes, certifies maps and writes archives."""
    counts = Counter()

    def count(name, *modules):
        original = getattr(modules[0], name)

        def counting(*arguments, **options):
            counts[name] += 1
            return original(*arguments, **options)

        for module in modules:
            monkeypatch.setattr(module, name, counting)

    count("check", omtwarp.mesh.validate)
    count("certify_triangles", omtwarp.pipeline, omtwarp.result)
    count("savez", np)
    return counts


def test_a_map_is_examined_certified_and_written_once(tmp_path, counted):
    surface = shapes.blob(seed=2, amplitude=0.2, sphere=1280)
    write_mesh(tmp_path / "blob.ply", surface.vertices, surface.faces)
    with pytest.raises(SystemExit) as ended:
        main(["map", str(tmp_path / "blob.ply"), "-o", str(tmp_path / "blob.npz"), "--device", "cpu", "--json"])
    assert ended.value.code == 0
    assert counted == {"check": 1, "certify_triangles": 1, "savez": 1}
