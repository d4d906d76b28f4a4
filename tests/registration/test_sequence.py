"""Surfaces of one subject in the order of time: no drift beyond the mesh, growth that is known, and what is kept."""

from __future__ import annotations

import csv

import numpy as np
import pytest
from made_cortices import EDGE, flowed, folded, rms, unit
from sphere_truths import random_rotation

from omtwarp.commands._cli import main
from omtwarp.errors import OmtwarpError, OmtwarpWarning
from omtwarp.maps.result import MapResult
from omtwarp.mesh import shapes
from omtwarp.mesh.data import read_data
from omtwarp.registration import register_sequence, sequence
from omtwarp.registration.strain import octaves, strain_at_vertices

STEPS = 4
BALLS = [shapes.icosphere(16 if time % 2 == 0 else 15) for time in range(STEPS + 1)]  # of two meshes by turns


def grown(ball, time: int):
    """A folded surface that grows at one place by 5 % a step, [V, 3]."""
    middle = unit(np.array([[1.0, 0.4, 0.3]]))
    bump = np.exp(-3.0 * ((ball.vertices - middle) ** 2).sum(axis=1))
    return folded(ball) * (1.0 + 0.05 * time * bump)[:, None]


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Maps of the growing surface, whose spheres flow by 3 degrees a step and are in positions of their own."""
    folder, found = tmp_path_factory.mktemp("maps"), []
    for time, ball in enumerate(BALLS):
        sphere = flowed(ball.vertices, 3.0 * time) @ random_rotation(time).T if time else ball.vertices
        found.append(folder / f"t{10 - time}.npz")
        MapResult(grown(ball, time), ball.faces, sphere, sphere, np.ones(ball.vertex_count)).save(found[-1])
    return found


@pytest.fixture(scope="module")
def done(files, tmp_path_factory):
    folder = tmp_path_factory.mktemp("done")
    return folder, register_sequence(files, folder)


def test_correspondences_do_not_drift_by_more_than_the_mesh(files, done):
    folder, found = done
    assert found.names == tuple(file.stem for file in files)
    away = []
    for file, ball in zip(files, BALLS, strict=True):
        registered, given = MapResult.load(folder / file.name), MapResult.load(file)
        away.append(rms(registered.sphere, ball.vertices))
        np.testing.assert_array_equal(registered.vertices, given.vertices)
        row = found.table.get(file.stem)
        if row is not None:
            assert row["registration_flips"] == 0.0 and row["registration_degree"] == 1.0
            assert row["drift"] < row["edge"] == pytest.approx(np.degrees(EDGE), rel=0.25)
            # What the report says of the warp is of both that it was made by.
            strains = np.abs(octaves(registered.conformal, registered.sphere, registered.faces)[0])
            assert row["registration_area_p95"] == pytest.approx(np.percentile(strains, 95), rel=1e-6)
            assert registered.report["registration"]["area_strain"]["max"] == pytest.approx(strains.max(), rel=1e-6)
    assert away[0] == 0.0 and away[-1] < EDGE / 3.0
    worst = np.linalg.norm(MapResult.load(folder / files[-1].name).sphere - BALLS[-1].vertices, axis=1).max()
    assert worst < EDGE


def test_the_bound_of_strain_is_that_of_both_warps(files, tmp_path):
    """To the one before and on to the first each warp is within the bound, and together they are not."""
    found = register_sequence([files[0], files[-1]], tmp_path, max_strain=0.5)
    assert 0.4 < found.table[files[-1].stem]["registration_strain"] <= 0.5
    registered = MapResult.load(tmp_path / files[-1].name)
    strains = octaves(registered.conformal, registered.sphere, registered.faces)
    assert max(np.abs(strains[0]).max(), strains[1].max()) <= 0.5 + 1e-9
    assert registered.report["registration"]["certificate"]["flips"] == 0


def test_growth_is_data_at_the_first_surfaces_vertices(files, done):
    folder, found = done
    start, faces = grown(BALLS[0], 0), BALLS[0].faces
    assert not found.area[0].any() and not found.stretch[0].any()
    for time in (2, STEPS):  # on the first one's mesh, and so known at its vertices
        known = strain_at_vertices(start, faces, octaves(start, grown(BALLS[0], time), faces)[0])
        assert abs((found.area[time] - known).mean()) < 0.005 < 0.02 < known.mean()
        assert np.sqrt(((found.area[time] - known) ** 2).mean()) < 0.08
        assert np.corrcoef(found.area[time], known)[0, 1] > 0.75
    stored = np.load(folder / "strain.npz")
    np.testing.assert_array_equal(stored["area"], found.area)
    assert [str(name) for name in stored["names"]] == list(found.names)
    pytest.importorskip("nibabel")
    columns = read_data(folder / "stretch.shape.gii")
    assert columns.names == found.names
    np.testing.assert_allclose(columns.values, found.stretch.T, atol=1e-6)


def test_a_surface_that_only_grows_has_the_growth_of_its_size(tmp_path):
    ball = BALLS[0]
    for time, size in enumerate((1.0, 1.1)):
        sphere = ball.vertices @ random_rotation(time).T
        MapResult(size * folded(ball), ball.faces, sphere, sphere, np.ones(ball.vertex_count)).save(
            tmp_path / f"{time}.npz"
        )
    found = register_sequence([tmp_path / "0.npz", tmp_path / "1.npz"], tmp_path / "out")
    np.testing.assert_allclose(found.area[1], 2.0 * np.log2(1.1), atol=0.02)
    np.testing.assert_allclose(found.stretch[1], 0.0, atol=0.02)


def test_own_features_take_the_place_of_folds(files, tmp_path):
    data = []
    for time in (0, 2):
        data.append(tmp_path / f"{time}.npy")
        np.save(data[-1], np.linalg.norm(folded(BALLS[time]), axis=1))
    found = register_sequence([files[0], files[2]], tmp_path / "out", features={"height": data})
    assert found.table[files[2].stem]["registration_height"] > 0.99
    assert rms(MapResult.load(tmp_path / "out" / files[2].name).sphere, BALLS[2].vertices) < EDGE / 2.0


def test_an_interrupted_run_goes_on(files, done, tmp_path, monkeypatch):
    found = done[1]

    files = files[:3]

    def interrupted(stage, step, steps, info):
        assert (stage, steps) == ("sequence", 2)
        if step == 1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        register_sequence(files, tmp_path, progress=interrupted)
    calls, step = [], sequence._step
    monkeypatch.setattr(sequence, "_step", lambda *a: calls.append(1) or step(*a))
    again = register_sequence(files, tmp_path)
    assert len(calls) == 1
    np.testing.assert_allclose(again.area, found.area[:3], atol=1e-9)
    assert [row["id"] for row in csv.DictReader((tmp_path / "table.csv").open())] == list(found.names[1:3])
    assert not (tmp_path / ".steps").exists()


def test_a_drift_beyond_the_mesh_is_said():
    with pytest.warns(OmtwarpWarning, match="'late' drifted by 5.0 degrees, and its edges are 4.0"):
        sequence._warn_of_drift("late", {"drift": 5.0, "edge": 4.0})


def test_the_command_says_how_well_it_went(files, tmp_path, capsys):
    with pytest.raises(SystemExit) as ended:
        main(["register", *map(str, files[:2]), "--sequence", "-o", str(tmp_path / "out")])
    told = capsys.readouterr().out
    assert not ended.value.code and "2 maps; sulc 0.99" in told and "0 flips" in told and "drift at most 0." in told
    with pytest.raises(SystemExit) as ended:
        main(["register", *map(str, files[:2]), "--sequence", "--group", "-o", str(tmp_path / "out")])
    assert ended.value.code == 1 and "exclude each other" in capsys.readouterr().err
    with pytest.raises(OmtwarpError, match="would be replaced"):
        register_sequence(files, files[0].parent)
