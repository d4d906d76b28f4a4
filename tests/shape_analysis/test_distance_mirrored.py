"""Shapes and their mirror images: their distances, groups with both, and their maps."""

from __future__ import annotations

import json
import warnings

import numpy as np
import pytest

import omtwarp
from omtwarp import shapes
from omtwarp.commands._cli import main
from omtwarp.shape_analysis import shape_distance, study_group

MIRROR = np.array([-1.0, 1.0, 1.0])


def one_sided(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """A shape that is far from its mirror image, with noise of its own."""
    noisy = shapes.noisy(shapes.blob(seed=7, sphere=500), 0.02, seed=seed)
    return noisy.vertices, noisy.faces


def mirrored(mesh: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    return mesh[0] * MIRROR, mesh[1][:, ::-1]


def mapped(mesh: tuple[np.ndarray, np.ndarray]) -> omtwarp.MapResult:
    return omtwarp.map_to_sphere(mesh, until="moser", device="cpu")


def test_a_mirror_image_is_apart_until_it_is_mirrored_back():
    """Rotations do not take a shape without planes of symmetry to its mirror image; mirroring it does."""
    ball = shapes.icosphere(6)
    vertices = ball.vertices * [1.0, 1.3, 0.8]
    vertices = vertices + 0.2 * vertices[:, [1, 2, 0]] * abs(vertices) + 0.15 * vertices[:, [2, 0, 1]] * vertices
    mirror, back = [-1.0, 1.0, 1.0], slice(None, None, -1)
    image = (vertices * mirror, ball.faces[:, back])
    restored = (image[0] * mirror, image[1][:, back])
    maps = [
        omtwarp.map_to_sphere(mesh, until="moser", device="cpu") for mesh in ((vertices, ball.faces), image, restored)
    ]
    distances = [shape_distance(maps[0], other, degree=5, device="cpu").coefficients for other in maps[1:]]
    assert distances[1] < 1e-6 < 0.02 < distances[0]


def test_maps_that_keep_other_things_are_warned_of():
    """Points of a conformal map and of an area-preserving one do not correspond, even of one shape."""
    shape = shapes.blob(3, amplitude=0.3, degree=4, sphere=720)
    maps = [omtwarp.map_to_sphere(shape, until=until, device="cpu") for until in ("conformal", "moser")]
    with pytest.warns(omtwarp.OmtwarpWarning, match="one map preserves areas and the other does not"):
        assert shape_distance(*maps, degree=5, device="cpu").coefficients > 0.01


def test_a_group_of_left_and_right_sides_names_the_mirrored_ones(tmp_path, monkeypatch, capsys):
    """The command and Python warn and compare all the same; mirrored by ``align`` there is nothing to warn of."""
    monkeypatch.chdir(tmp_path)
    meshes = {"left_1": one_sided(1), "right_1": mirrored(one_sided(2)), "left_2": one_sided(3)}
    maps = {name: mapped(mesh) for name, mesh in meshes.items()}
    for name, found in maps.items():
        found.save(f"{name}.npz")
    with pytest.warns(omtwarp.OmtwarpWarning, match="^shape 1 fits shape 0 better as mirror image, "):
        study = study_group(list(maps.values()), grid="ico2", degree=4, device="cpu")
    assert study.alignment.mirrored.tolist() == [False, True, False]

    def grouped(*names: str) -> tuple[dict, str]:
        with pytest.raises(SystemExit) as end:
            main(
                ["group", *(f"{name}.npz" for name in names), "-o", "out", "--grid", "ico2", "--degree", "4", "--json"]
            )
        out, err = capsys.readouterr()
        assert not end.value.code
        return json.loads(out), err

    record, said = grouped(*maps)
    assert record["mirrored"] == ["right_1"] and said.count("\n") == 1
    assert said.startswith("omtwarp: warning: right_1 fits left_1 better as mirror image")
    assert "right_1 fits left_1" in (tmp_path / "out" / "report.html").read_text("utf-8")
    with pytest.raises(SystemExit):
        main(["align", "right_1.npz", "--to", "left_1.npz", "--mirror", "-o", "turned.npz", "--quiet"])
    capsys.readouterr()
    record, said = grouped("left_1", "turned", "left_2")
    assert record["mirrored"] == [] and said == ""


def test_shapes_with_a_plane_of_symmetry_are_not_named():
    maps = [mapped(shapes.hippocampus(seed, face_count=500, variation=0.05)) for seed in range(3)]
    maps += [mapped(mirrored((one.vertices, one.faces))) for one in maps[:2]]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        study_group(maps, grid="ico2", degree=4, device="cpu")


def test_the_map_of_a_mirror_image_is_the_mirror_image_of_the_map():
    """Up to a rotation, which the third moments fix in another way, and as far as 1e-4 of the cost can move vertices.

    That much may be left when the minimisation ends: of four such shapes maps and mirrored maps differ by up to 4e-3.
    """
    left, right = (
        omtwarp.map_to_sphere(mesh, device="cpu", optimality=False) for mesh in (one_sided(1), mirrored(one_sided(1)))
    )
    for name in ("area", "angle"):
        ours, theirs = (getattr(found.distortion(), name)["surface"] for found in (left, right))
        assert theirs == pytest.approx(ours, abs=1e-3)
    one, _, other = np.linalg.svd((left.sphere * MIRROR).T @ right.sphere)
    assert np.linalg.det(one @ other) > 0
    np.testing.assert_allclose(left.sphere * MIRROR @ one @ other, right.sphere, atol=1e-2)


@pytest.mark.parametrize("exponent", [-300, 160, 300])
def test_any_unit_gives_the_same_distance_of_scaled_shapes(exponent):
    vertices, faces = one_sided(1)
    other, plain, far = map(mapped, (one_sided(2), (vertices, faces), (vertices * 10.0**exponent, faces)))
    one, two = (shape_distance(each, other, degree=4, scale=True, device="cpu") for each in (plain, far))
    assert two.coefficients == pytest.approx(one.coefficients, rel=1e-6)
