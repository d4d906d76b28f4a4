"""Averages that packages install: found by name, in one frame, with one line on what is missing."""

from __future__ import annotations

import numpy as np
import pytest
from sphere_truths import random_rotation

import omtwarp
from omtwarp.commands._cli import main
from omtwarp.errors import OmtwarpError
from omtwarp.maps.result import MapResult
from omtwarp.mesh import shapes
from omtwarp.mesh.data import VertexData, read_data, write_data
from omtwarp.mesh.write import write_mesh
from omtwarp.registration.sides import target_points
from omtwarp.resampling.averages import average_sphere, with_side
from omtwarp.spheres import named_grid

OWN = shapes.icosphere(20)  # in place of the 32,492 vertices of fs_LR
ROTATION = random_rotation(3)


def smooth(points):
    x, y, z = points.T
    return x * y + 0.5 * z**2 - 0.3 * x + y * z * x


def bent(points):
    """A smooth map of the sphere to itself: what fs_LR's frame is to fsaverage's."""
    moved = points @ ROTATION.T + 0.15 * np.column_stack([points[:, 1] ** 2, points[:, 2], points[:, 0] * points[:, 1]])
    return moved / np.linalg.norm(moved, axis=1, keepdims=True)


def run(line):
    with pytest.raises(SystemExit) as ended:
        main(line.split())
    return ended.value.code


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder of templates, and no other place where some may be."""
    for name in ("SUBJECTS_DIR", "NILEARN_SHARED_DATA", "NILEARN_DATA", "TEMPLATEFLOW_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("OMTWARP_TEMPLATES", str(tmp_path))
    monkeypatch.setattr("omtwarp.resampling.averages.PACKAGES", {})
    return tmp_path


def write_deformed(folder, points):
    name = "fs_LR-deformed_to-fsaverage.L.sphere.32k_fs_LR.surf.gii"
    write_mesh(folder / name, 100.0 * points, OWN.faces, spherical=True)


def test_data_come_back_from_fs_lr(folder):
    """Smooth data of fsaverage to fs_LR and back differ by what interpolation on the coarse mesh loses."""
    write_deformed(folder, bent(OWN.vertices))
    there, back = omtwarp.resample("fsaverage5", "fsLR32k-left"), omtwarp.resample("fsLR32k-left", "fsaverage5")
    given = smooth(named_grid("fsaverage5").points)
    moved = there.apply(given)
    np.testing.assert_allclose(moved, smooth(bent(OWN.vertices)), atol=1e-3)
    assert np.abs(back.apply(moved) - given).max() < 0.01 * np.ptp(given)


def test_the_pair_of_spheres_gives_the_same_places(folder):
    """Where only fsaverage's places on fs_LR's sphere are known, fs_LR's on fsaverage's are read from them."""
    fine = named_grid("fsaverage")
    (folder / "fs_L").mkdir()
    pair = folder / "fs_L" / "fs_L-to-fs_LR_fsaverage.L_LR.spherical_std.164k_fs_L.surf.gii"
    write_mesh(pair, bent(fine.points), fine.faces, spherical=True)
    write_mesh(folder / "S1200.L.sphere.32k_fs_LR.surf.gii", 100.0 * OWN.vertices, OWN.faces, spherical=True)
    places = average_sphere("fsLR32k-left").points
    np.testing.assert_allclose(bent(places), OWN.vertices, atol=1e-4)


def test_the_places_that_packages_publish_agree_with_their_surfaces():
    """Registered averages of two meshes lie on each other: positions of the white surfaces agree within some mm."""
    try:
        there, white = target_points("fsLR32k-left")[0], target_points("fsaverage5-left")[0]
    except OmtwarpError as error:
        pytest.skip(f"not installed: {error}")
    carried = omtwarp.resample("fsLR32k-left", "fsaverage5").apply(there.vertices)
    assert np.median(np.linalg.norm(carried - white.vertices, axis=1)) < 8.0


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("fsaverage5-left", "install nilearn, .*fsaverage5/white_left.gii.gz"),
        ("fsaverage-right", "fetch_surf_fsaverage"),
        ("fsLR32k-left", "OMTWARP_TEMPLATES name the folder of 'S1200.L"),
    ],
)
def test_what_is_missing_is_one_line(folder, name, words):
    with pytest.raises(OmtwarpError, match=words) as caught:
        target_points(name)
    assert "\n" not in str(caught.value)


def test_the_hemisphere_is_the_structures():
    assert with_side("fsaverage5", "CortexRight") == with_side("fsaverage5", "right") == "fsaverage5-right"
    assert with_side("fsaverage5-left", None) == "fsaverage5-left" and with_side("a.npz", "left") == "a.npz"
    with pytest.raises(OmtwarpError, match="a left hemisphere, and 'fsaverage5-right'"):
        with_side("fsaverage5-right", "CortexLeft")
    for unknown in (None, "Cerebellum"):
        with pytest.raises(OmtwarpError, match="fsLR32k-left or fsLR32k-right"):
            with_side("fsLR32k", unknown)


def test_a_map_is_registered_to_the_average_of_its_hemisphere(folder):
    """fsaverage5 by name alone: the surface is that in the folder, and the structure in the map says which."""
    ball = named_grid("fsaverage5")
    surface = ball.points * (1.0 + 0.2 * smooth(ball.points))[:, None]
    (folder / "fsaverage5" / "surf").mkdir(parents=True)
    write_mesh(folder / "fsaverage5" / "surf" / "lh.white", surface, ball.faces)
    turned = ball.points @ ROTATION.T
    ones = np.ones(len(surface))
    result = MapResult(surface, ball.faces, turned, turned, ones, report={"structure": "CortexLeft"})
    found = omtwarp.register(result, "fsaverage5")
    assert np.abs(found.sphere - ball.points).max() < 0.01
    result.report["structure"] = "CortexRight"
    with pytest.raises(OmtwarpError, match="fsaverage5-right"):
        omtwarp.register(result, "fsaverage5")


def test_the_command_line_takes_the_names(folder, capsys):
    write_deformed(folder, bent(OWN.vertices))
    data, out = folder / "lh.height.shape.gii", folder / "lh.there.shape.gii"
    values = smooth(named_grid("fsaverage5").points)[:, None]
    write_data(data, VertexData(values, ("height",), structure="CortexLeft"))
    lines = [f"resample fsaverage5 --to fsLR32k --data {data} -o {out}"]
    back = folder / "back.shape.gii"
    lines.append(f"resample fsLR32k --to fsaverage5 --hemisphere left --data {out} -o {back}")
    assert [run(line) for line in lines] == [0, 0]
    assert read_data(out).structure == read_data(back).structure == "CortexLeft"
    assert np.abs(read_data(back).values - values).max() < 0.02
    np.save(folder / "plain.npy", values)
    assert run(f"resample fsaverage5 --to fsLR32k --data {folder / 'plain.npy'} -o {folder / 'o.npy'}")
    assert "fsLR32k-left" in capsys.readouterr().err
