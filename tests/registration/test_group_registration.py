"""Templates of groups: unbiased, the same for every order of maps, kept where interrupted, and targets themselves."""

from __future__ import annotations

import csv
import json
import shutil
import tracemalloc

import numpy as np
import pytest
from made_cortices import BALL, EDGE, flowed, folded, rms, unit
from sphere_truths import random_rotation

import omtwarp
from omtwarp.commands._cli import main
from omtwarp.errors import OmtwarpError
from omtwarp.location import Locator
from omtwarp.maps.result import MapResult
from omtwarp.mesh import shapes
from omtwarp.registration import Template, group, register_group
from omtwarp.registration.sides import Side, folds
from omtwarp.registration.warp import feature_grid
from omtwarp.resampling import SpherePoints
from omtwarp.spheres import mesh_grid

COUNT, ROUNDS = 3, 1
FIRM = {"stiffness": 0.3, "max_strain": 2.0}


def write_maps(folder, count: int = COUNT, ball=BALL):
    """Maps of one surface whose spheres differ by known smooth warps and positions."""
    files = []
    for k in range(count):
        sphere = flowed(ball.vertices, 12.0, seed=k + 1) @ random_rotation(k).T
        files.append(folder / f"s{k}.npz")
        MapResult(folded(ball), ball.faces, sphere, sphere, np.ones(ball.vertex_count)).save(files[-1])
    return files


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    return write_maps(tmp_path_factory.mktemp("maps"))


@pytest.fixture(scope="module")
def done(files, tmp_path_factory):
    """The folder of a group's registration, and what was returned."""
    folder = tmp_path_factory.mktemp("done")
    return folder, register_group(files, folder, rounds=ROUNDS, **FIRM)


def mean_way(spheres, before, faces) -> float:
    """How far the mean of the ways from points of a target to spheres before their warps leads, rms, in radians."""
    grid = feature_grid().vertices
    ways = [
        Locator(s, faces, device="cpu").find(grid).on_sphere(faces, b) for s, b in zip(spheres, before, strict=True)
    ]
    return rms(unit(np.mean(ways, axis=0)), grid)


def test_the_same_place_of_all_maps_is_at_one_point_and_the_template_favours_none(files, done):
    folder, found = done
    maps = [MapResult.load(folder / f"s{k}.npz") for k in range(COUNT)]
    apart = [rms(maps[0].sphere, other.sphere) for other in maps[1:]]
    assert max(apart) < EDGE < min(rms(maps[0].conformal, other.conformal) for other in maps[1:])
    # The conformal maps were turned as at the start of each warp.
    template = mean_way([one.sphere for one in maps], [one.conformal for one in maps], BALL.faces)
    to_one = [omtwarp.register(file, files[0], **FIRM) for file in files]
    biased = mean_way([one.sphere for one in to_one], [one.start.sphere for one in to_one], BALL.faces)
    assert template < 0.1 * biased
    assert all(row["registration_flips"] == 0.0 and row["registration_sulc"] > 0.98 for row in found.table.values())


def test_the_order_does_not_count_and_what_was_done_is_kept(files, done, tmp_path, monkeypatch):
    folder, found = done

    def interrupted(stage, step, steps, info):
        assert (stage, steps) == ("group", (ROUNDS + 1) * COUNT)
        if step == 4:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        register_group(files[::-1], tmp_path, rounds=ROUNDS, progress=interrupted, **FIRM)
    calls = []
    monkeypatch.setattr(group, "register", lambda *a, **k: calls.append(1) or omtwarp.register(*a, **k))
    again = register_group(files[::-1], tmp_path, rounds=ROUNDS, **FIRM)
    assert len(calls) == (ROUNDS + 1) * COUNT - 4
    np.testing.assert_allclose(again.template.features, found.template.features, atol=1e-9)
    for name in found.table:
        one, other = (MapResult.load(place / f"{name}.npz").sphere for place in (folder, tmp_path))
        np.testing.assert_allclose(one, other, atol=1e-3)
    assert not (tmp_path / ".steps").exists()
    listed = list(csv.DictReader((tmp_path / "table.csv").open()))
    assert [row["id"] for row in listed] == [f"s{k}" for k in range(COUNT)]
    assert float(listed[1]["registration_sulc"]) == pytest.approx(found.table["s1"]["registration_sulc"], abs=1e-6)


def test_own_features_take_the_place_of_folds(files, tmp_path, capsys):
    """One file of data for every map, in the order of the maps."""
    data = []
    for k in range(2):
        data.append(tmp_path / f"d{k}.npy")
        np.save(data[-1], np.linalg.norm(folded(BALL), axis=1))
    words = [str(path) for path in (*files[:2], "--group", "--rounds", 1, "-o", tmp_path / "out")]
    given = [word for path in data for word in ("--feature", str(path))]
    with pytest.raises(SystemExit) as ended:
        main(["register", *words, *given, "--stiffness", "0.3", "--max-strain", "2"])
    assert not ended.value.code and "2 maps; feature 1 0.9" in capsys.readouterr().out
    template = Template.load(tmp_path / "out" / "template.npz")
    assert template.names == ("feature 1",)
    spheres = [MapResult.load(tmp_path / "out" / f"s{k}.npz").sphere for k in range(2)]
    assert rms(*spheres) < EDGE
    with pytest.raises(SystemExit) as ended:
        main(["register", *words, *given[:2]])
    assert ended.value.code and "give it once for each" in capsys.readouterr().err
    with pytest.raises(OmtwarpError, match="feature 'depth' has 1 files for 2 maps"):
        register_group(files[:2], tmp_path / "other", features={"depth": data[:1]})


def test_a_map_with_a_filled_hole_has_features_of_its_own_points_only():
    own = (BALL.vertex_count - 1, int((BALL.faces < BALL.vertex_count - 1).all(axis=1).sum()))
    faces = BALL.faces[np.argsort((BALL.faces == BALL.vertex_count - 1).any(axis=1), kind="stable")]
    points = SpherePoints(mesh_grid(BALL.vertices, faces, own=own), folded(BALL))
    side = Side(points, folds(points, "a map"))
    assert all(len(values) == own[0] for values in side.own.values())
    target = SpherePoints(mesh_grid(BALL.vertices, BALL.faces), folded(BALL))
    found = omtwarp.register(points, target, features=side.own, to_features=folds(target, "a map"))
    assert rms(found.sphere, BALL.vertices[: own[0]]) < EDGE


def test_a_template_is_a_target(files, done, tmp_path, capsys):
    folder, found = done
    loaded = Template.load(folder / "template.npz")
    np.testing.assert_array_equal(loaded.features, found.template.features)
    assert loaded.names == ("sulc", "curv")
    with pytest.raises(SystemExit) as ended:
        options = ["--stiffness", "0.3", "--max-strain", "2", "--json"]
        main(["register", str(files[1]), "--to", str(folder / "template.npz"), "-o", str(tmp_path / "r.npz"), *options])
    assert not ended.value.code and json.loads(capsys.readouterr().out)["correlations"]["sulc"]["after"] > 0.98
    own = MapResult.load(folder / "s1.npz").sphere
    np.testing.assert_allclose(MapResult.load(tmp_path / "r.npz").sphere, own, atol=1e-6)
    given = {"sulc": np.arange(BALL.vertex_count), "depth": np.arange(BALL.vertex_count)}
    with pytest.raises(OmtwarpError, match="with the same names"):
        omtwarp.register(files[1], loaded, features=given)


def test_memory_does_not_grow_with_the_maps(tmp_path, short_warps):
    ball = shapes.icosphere(4)
    files, peaks = write_maps(tmp_path, 4, ball), []
    register_group(files[:2], tmp_path / "warm", rounds=1)
    for count in (2, 4):
        tracemalloc.start()
        register_group(files[:count], tmp_path / f"of{count}", rounds=1)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.01 * peaks[0]


@pytest.mark.parametrize("features", [3, "abc", ["a.csv"], np.ones(3)])
def test_features_are_given_by_name(files, tmp_path, features):
    with pytest.raises(OmtwarpError, match="features: must be a dictionary"):
        register_group(files[:2], tmp_path / "out", features=features)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["s0.npz", "--group", "-o", "out"], "at least two"),
        (["s0.npz", "s0.npz", "--group", "-o", "out"], "rename some"),
        (["s0.npz", "ball.ply", "--group", "-o", "out"], "ball.ply"),
        (["s0.npz", "s1.npz", "--group", "-o", "s0.npz"], "cannot write"),
        (["s0.npz", "s1.npz", "--group", "--to", "s0.npz", "-o", "out"], "--to is of one map"),
        (["s0.npz", "s1.npz", "--group", "--radius", "100", "-o", "out"], "--radius is of one map"),
        (["s0.npz", "s1.npz", "--to", "s0.npz", "-o", "out.npz"], "give one map and --to"),
        (["s0.npz", "-o", "out.npz"], "give one map and --to"),
        (["s0.npz", "--to", "torn.npz", "-o", "out.npz"], "is not a template"),
        (["s0.npz", "s1.npz", "--group", "-o", "taken"], "did not write"),
    ],
)
def test_requests_that_cannot_be_met_are_one_line(files, tmp_path, monkeypatch, capsys, words, message):
    monkeypatch.chdir(tmp_path)
    for file in files[:2]:
        shutil.copy(file, tmp_path)
    omtwarp.mesh.write.write_mesh(tmp_path / "ball.ply", BALL.vertices, BALL.faces)
    np.savez(tmp_path / "torn.npz", template_points=BALL.vertices)
    (tmp_path / "taken").mkdir()
    (tmp_path / "taken" / "template.npz").write_text("mine")
    with pytest.raises(SystemExit) as ended:
        main(["register", *words])
    told = capsys.readouterr().err
    assert ended.value.code and message in told and told.count("\n") == 1, told
    assert not (tmp_path / "out").exists()
