"""The average subject fsaverage5 through map, align and resample, against Connectome Workbench on the same spheres."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from scipy import sparse

import omtwarp
from omtwarp.mesh.data import VertexData, read_data, write_data
from omtwarp.mesh.read import read_mesh
from omtwarp.mesh.write import write_mesh
from omtwarp.resampling import Resampling, as_points

REGIONS = 60
SINGLE_ROUNDOFF = 2.0**-24  # of numbers near 1 in single precision, in which Workbench keeps points and distances


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
    """At every vertex, but for triangles that are equally near in single precision, of which Workbench takes another.

    Which those are is found by trimesh in double precision; where there is no doubt, it is where we interpolate.
    """
    ends = ["lh.map.surf.gii", "lh.own.surf.gii"]
    source, target = (subject / name for name in (ends if there else ends[::-1]))
    found = omtwarp.resample(source, target, device="cpu")
    points, triangles, distances, weights = triangles_around(found)
    least = np.full(len(found.target.grid.points), np.inf)
    np.minimum.at(least, points, distances)
    for name in ("thick", "sulc"):
        data, out = subject / f"lh.{name}.shape.gii", subject / "out.shape.gii"
        workbench("-metric-resample", data, source, target, "BARYCENTRIC", out)
        given, theirs = read_data(data).values[:, 0], read_data(out).values[:, 0]
        ours = found.apply(given)
        candidates = np.einsum("ck,ck->c", weights, given[found.source.grid.faces[triangles]])
        nearest = distances == least[points]
        assert np.abs(candidates - ours[points])[nearest].max() < 1e-12
        assert np.mean(np.abs(ours - theirs) < 1e-5) > 0.999
        apart = np.full(len(least), np.inf)
        close = distances <= least[points] + SINGLE_ROUNDOFF
        np.minimum.at(apart, points[close], np.abs(candidates - theirs[points])[close])
        assert apart.max() < 1e-5, (name, np.sort(apart)[-8:])


def triangles_around(found: Resampling):
    """Triangles at the corners of that which holds each point: the pairs, distances, and weights of the nearest place.

    Returns:
        Points [C], triangles [C], distances [C], barycentric coordinates [C, 3].
    """
    faces, ends = found.source.grid.faces, (found.source.grid.points, found.target.grid.points)
    entries = (np.ones(3 * len(faces)), (faces.ravel(), np.repeat(np.arange(len(faces)), 3)))
    pairs = ((found.matrix != 0) @ sparse.csr_matrix(entries, shape=(len(ends[0]), len(faces)))).tocoo()
    corners = ends[0][faces[pairs.col]]
    places = trimesh.triangles.closest_point(corners, ends[1][pairs.row])
    distances = np.linalg.norm(places - ends[1][pairs.row], axis=1)
    return pairs.row, pairs.col, distances, trimesh.triangles.points_to_barycentric(corners, places)


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
    # A weight of 0 or next to 0, which single precision does not tell apart, decides which of two ways a vertex goes.
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
