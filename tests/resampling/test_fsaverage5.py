"""The average subject fsaverage5 through map, align and resample, beside Connectome Workbench on the same spheres."""

from __future__ import annotations

import numpy as np
import pytest

import omtwarp
from omtwarp.mesh.data import VertexData, read_data, write_data
from omtwarp.mesh.read import read_mesh
from omtwarp.mesh.write import write_mesh
from omtwarp.resampling import as_points

REGIONS = 60


@pytest.fixture(scope="module")
def subject(nilearn_fsaverage5, tmp_path_factory):
    """Files of the subject: its own sphere, that of a map aligned to it, data and labels; single precision, as read."""
    folder = tmp_path_factory.mktemp("fsaverage5")
    white, faces = nilearn_fsaverage5("white_left")
    own, _ = nilearn_fsaverage5("sphere_left")
    result = omtwarp.map_to_sphere((white, faces), until="moser", device="cpu")
    aligned = omtwarp.align(result, (own, faces))
    assert aligned.method == "vertices" and aligned.score > 0.9
    write_mesh(folder / "lh.map.surf.gii", 100 * aligned.sphere, faces, spherical=True)
    write_mesh(folder / "lh.own.surf.gii", own, faces, spherical=True)
    for name in ("thick", "sulc"):
        data = VertexData(nilearn_fsaverage5(f"{name}_left")[:, None], (name,), structure="CortexLeft")
        write_data(folder / f"lh.{name}.shape.gii", data)
    centres = np.random.default_rng(0).normal(size=(REGIONS, 3))
    keys = (own @ (centres / np.linalg.norm(centres, axis=1)[:, None]).T).argmax(axis=1) + 1
    colors = np.random.default_rng(1).uniform(size=(REGIONS + 1, 3)).tolist()
    table = {key: (f"region {key}", (*color, 1.0)) for key, color in enumerate(colors)}
    write_data(folder / "lh.regions.label.gii", VertexData(keys[:, None], ("regions",), table, "CortexLeft"))
    return folder


@pytest.mark.parametrize("there", [True, False], ids=["to its own sphere", "and back"])
def test_barycentric_is_workbenchs(subject, workbench, there):
    ends = ["lh.map.surf.gii", "lh.own.surf.gii"]
    source, target = (subject / name for name in (ends if there else ends[::-1]))
    found = omtwarp.resample(source, target, device="cpu")
    for name in ("thick", "sulc"):
        data, out = subject / f"lh.{name}.shape.gii", subject / "out.shape.gii"
        workbench("-metric-resample", data, source, target, "BARYCENTRIC", out)
        apart = np.abs(found.apply(read_data(data).values) - read_data(out).values)
        # Workbench computes in single precision at radius 100, which in narrow triangles costs digits.
        assert np.mean(apart < 1e-5) > 0.9995 and apart.max() < 1e-4, (name, np.sort(apart.ravel())[-8:])


def test_adaptive_and_labels_are_workbenchs(subject, workbench, nilearn_fsaverage5):
    source, target = subject / "lh.map.surf.gii", subject / "lh.own.surf.gii"
    white, faces = nilearn_fsaverage5("white_left")
    plain = omtwarp.resample(source, target, device="cpu")
    for name, points in (("source", white), ("target", plain.apply(white))):
        write_mesh(subject / f"lh.{name}.surf.gii", points, faces)
    areas = [as_points((100 * as_points(source).grid.points, faces)), as_points(target)]
    areas = [
        type(end)(end.grid, read_mesh(subject / f"lh.{name}.surf.gii").vertices).surface_areas()
        for end, name in zip(areas, ("source", "target"), strict=True)
    ]
    found = omtwarp.resample(
        source, target, method="adaptive", source_areas=areas[0], target_areas=areas[1], device="cpu"
    )
    data, out = subject / "lh.thick.shape.gii", subject / "adaptive.shape.gii"
    surfaces = ["-area-surfs", subject / "lh.source.surf.gii", subject / "lh.target.surf.gii"]
    workbench("-metric-resample", data, source, target, "ADAP_BARY_AREA", out, *surfaces)
    apart = np.abs(found.apply(read_data(data).values) - read_data(out).values)
    # Whether a point lies on an edge decides which of two ways a vertex goes, and single precision may say otherwise.
    assert np.mean(apart < 1e-5) > 0.999, np.mean(apart < 1e-5)
    data = subject / "lh.regions.label.gii"
    for method, ours, options in (("ADAP_BARY_AREA", found, surfaces), ("BARYCENTRIC", plain, [])):
        out = subject / f"{method}.label.gii"
        workbench("-label-resample", data, source, target, method, out, *options)
        same = ours.labels(read_data(data).values[:, 0]) == read_data(out).values[:, 0]
        assert np.mean(same) >= 0.999, (method, np.mean(same))


def test_conservative_keeps_integrals_and_signs(subject):
    ends = [subject / "lh.map.surf.gii", subject / "lh.own.surf.gii"]
    thickness = np.maximum(read_data(subject / "lh.thick.shape.gii").values[:, 0], 0.0)
    there = omtwarp.resample(*ends, method="conservative", device="cpu")
    back = omtwarp.resample(*ends[::-1], method="conservative", device="cpu")
    moved = there.apply(thickness)
    returned = back.apply(moved)
    before = thickness @ there.source.grid.areas
    assert abs(moved @ there.target.grid.areas / before - 1.0) < 1e-12
    assert abs(returned @ there.source.grid.areas / before - 1.0) < 1e-12
    assert min(moved.min(), returned.min()) >= 0.0
    spread = np.std(thickness)
    assert np.sqrt(np.mean((returned - thickness) ** 2)) < spread
