"""Maps of surfaces with filled holes, and cut open: aligned, resampled, expanded and compared as closed ones are."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import omtwarp
from omtwarp import OmtwarpError, align, resample, shapes
from omtwarp.mesh.surface import triangle_areas
from omtwarp.render import comparison
from omtwarp.resampling import SpherePoints, as_points
from omtwarp.resampling.resample import overlap_areas
from omtwarp.shape_analysis import shape_distance, study_group

TURN = Rotation.from_rotvec([0.3, -0.8, 1.1]).as_matrix()
METHODS = ("barycentric", "nearest", "adaptive", "conservative")


@pytest.fixture(scope="module")
def holed():
    """Vertices and faces of a shape with two holes, one of 23 edges and one of 17."""
    blob = shapes.blob(seed=3, sphere=1280)
    away = blob.vertices / np.linalg.norm(blob.vertices, axis=1)[:, None]
    kept = (away[blob.faces, 2] < 0.92).all(axis=1) & (away[blob.faces, 0] < 0.95).all(axis=1)
    used, faces = np.unique(blob.faces[kept], return_inverse=True)
    return blob.vertices[used], faces.reshape(-1, 3)


@pytest.fixture(scope="module", params=["natural", "small"])
def filled(request, holed):
    return omtwarp.map_surface(holed, domain="sphere", fill_area=request.param, device="cpu")


@pytest.fixture(scope="module")
def cut():
    surface = shapes.rings(2, cell=0.45)
    return surface.vertex_count, omtwarp.map_surface((surface.vertices, surface.faces), device="cpu")


def test_closed_map_covers_the_sphere_and_begins_with_the_open_one(filled):
    closed = filled.closed()
    assert closed.certificate.bijective and closed.distortion("conformal").degree == pytest.approx(1.0)
    assert np.array_equal(closed.vertices[: len(filled.vertices)], filled.vertices)
    assert np.array_equal(closed.conformal[: len(filled.vertices)], filled.conformal)
    assert np.array_equal(closed.faces[: len(filled.faces)], filled.faces)
    mass = triangle_areas(closed.conformal, closed.faces) @ closed.density[closed.faces].mean(axis=1)
    assert mass == pytest.approx(4.0 * np.pi, rel=0.05)
    assert closed.closed() is closed


def test_maps_to_a_part_of_the_sphere_are_not_closed(holed):
    whole = shapes.icosphere(6)
    bowl = whole.faces[(whole.vertices[whole.faces, 2] < 0.5).all(axis=1)]
    used, faces = np.unique(bowl, return_inverse=True)
    result = omtwarp.map_surface((whole.vertices[used], faces.reshape(-1, 3)), device="cpu")
    uses = [result.closed, lambda: align(result), lambda: resample(result, "ico2"), lambda: resample("ico2", result)]
    for use in uses:
        with pytest.raises(OmtwarpError, match=r"a map to a hemisphere .* domain='sphere'"):
            use()
    with pytest.raises(OmtwarpError, match="map the mesh again"):
        made = omtwarp.map_surface(holed, domain="sphere", until="conformal", device="cpu")
        replace(made, filled_conformal=None).closed()
    with pytest.raises(OmtwarpError, match="begin with the map's faces"):
        replace(made, filled_faces=made.filled_faces[::-1]).closed()


@pytest.mark.parametrize("by", ["auto", "features"])
def test_rotation_of_the_map_comes_back(filled, by):
    turned = replace(align(filled), rotation=TURN).turned(filled)
    assert np.allclose(turned.filled_sphere, filled.filled_sphere @ TURN.T)
    found = align(turned, filled, by=by)
    assert found.sphere.shape == filled.sphere.shape and found.score == pytest.approx(1.0)
    # At its maximum the score is flat: it does not change within an angle of some 1e-8.
    assert np.abs(found.rotation @ TURN - np.eye(3)).max() < 1e-7
    assert np.abs(found.sphere - filled.sphere).max() < 1e-7


def test_rotation_of_the_surface_changes_nothing(holed, filled):
    kind = "small" if filled.distortion().degree > 0.95 else "natural"
    other = omtwarp.map_surface((holed[0] @ TURN.T, holed[1]), domain="sphere", fill_area=kind, device="cpu")
    found = align(filled, other, by="features")
    assert found.score == pytest.approx(1.0, abs=1e-9)
    assert np.abs(found.sphere - other.sphere).max() < 1e-6
    assert align(align(filled).turned(filled)).rotation == pytest.approx(np.eye(3), abs=1e-9)
    assert shape_distance(filled, other, device="cpu").coefficients < 1e-6


def test_filling_has_no_weight_in_features(filled):
    points = as_points(filled)
    moved = points.vertices.copy()
    moved[len(filled.vertices) :] *= 3.0
    target = as_points("ico3").grid
    for one in (points, SpherePoints(points.grid, moved)):
        turned = SpherePoints(replace(one.grid, points=one.grid.points @ TURN.T), one.vertices)
        found = align(turned, points, by="features")
        assert np.abs(found.rotation @ TURN - np.eye(3)).max() < 1e-6
    assert points.surface_areas()[len(filled.vertices) :].max() == 0.0
    assert np.abs(resample(SpherePoints(points.grid, moved), target).surface()).max() > 3.0  # but the surface has it


def test_given_features_are_those_of_the_surface(filled):
    heights = filled.vertices[:, 2] - filled.vertices[:, 0] ** 2
    turned = replace(align(filled), rotation=TURN).turned(filled)
    found = align(turned, filled, features={"height": heights}, to_features={"height": heights})
    # Within an angle of 1e-8 of its maximum the score is the same to rounding.
    assert np.abs(found.rotation @ TURN - np.eye(3)).max() < 3e-8
    with pytest.raises(OmtwarpError, match="feature 'height'"):
        align(turned, filled, features={"height": heights[1:]}, to_features={"height": heights})


def test_mirror_image_is_found(filled, holed):
    kind = "small" if filled.distortion().degree > 0.95 else "natural"
    image = omtwarp.map_surface(
        (holed[0] * [-1, 1, 1], holed[1][:, ::-1].copy()), domain="sphere", fill_area=kind, device="cpu"
    )
    found = align(image, filled, mirror=True)
    assert found.mirrored
    turned = found.turned(image)
    assert turned.certificate.bijective and turned.closed().certificate.bijective
    assert np.allclose(turned.vertices, filled.vertices)


@pytest.mark.parametrize("method", METHODS)
def test_resampling_to_itself_changes_nothing(filled, method):
    same = resample(filled, filled, method=method, device="cpu")
    assert same.matrix.shape == (len(filled.vertices),) * 2 and not same.empty.any()
    assert np.abs(same.apply(filled.vertices) - filled.vertices).max() < 1e-9
    assert np.abs(same.surface() - filled.vertices).max() < 1e-9


@pytest.mark.parametrize("method", METHODS)
def test_points_in_the_filling_get_no_data(filled, method):
    found = resample(filled, "ico4", method=method, device="cpu")
    ones = found.apply(np.ones(len(filled.vertices)))
    assert ones == pytest.approx(np.where(found.empty, 0.0, 1.0))
    share = 1.0 - filled.distortion().degree  # of the sphere that the filling has
    cells = 0.02 if method == "conservative" else 0.01  # cells that reach over the rim have data
    assert found.empty.mean() == pytest.approx(share, abs=cells) and found.empty.any()
    keys = found.labels(np.where(filled.vertices[:, 2] > 0.0, 7, 3))
    assert np.array_equal(keys == 0, found.empty) and set(keys) == {0, 3, 7}
    surface = found.surface()
    closed = resample(filled.closed(), "ico4", method=method, device="cpu")
    assert np.array_equal(surface, closed.surface()) and np.linalg.norm(surface, axis=1).min() > 0.1


def test_conservative_resampling_keeps_integrals_over_the_surface(filled):
    found = resample(filled, "ico3", method="conservative", device="cpu")
    values = np.sin(3.0 * filled.vertices[:, 0]) + 2.0
    covered = np.asarray(overlap_areas(found.target.grid, found.source.grid, device="cpu").sum(axis=1)).ravel()
    own = found.source.grid.areas
    assert own.sum() == pytest.approx(4.0 * np.pi * filled.distortion().degree)
    assert covered @ found.apply(values) == pytest.approx(own[: len(values)] @ values, rel=1e-10)
    assert covered.sum() < 4.0 * np.pi * 0.999


@pytest.mark.parametrize("method", METHODS)
def test_data_come_to_the_surface_alone(filled, method):
    found = resample("ico4", filled, method=method, device="cpu")
    assert found.matrix.shape == (len(filled.vertices), 2562) and not found.empty.any()
    places = found.apply(found.source.grid.points)
    assert np.abs(places - filled.sphere).max() < 0.15  # two sides of the icosphere


def test_filled_ball_keeps_its_coordinates():
    """Of a ball with a small hole, aligned to one without, each point of the grid gets its own place."""
    ball = shapes.icosphere(12)
    kept = (ball.vertices[ball.faces, 2] < 0.98).all(axis=1)
    used, faces = np.unique(ball.faces[kept], return_inverse=True)
    result = omtwarp.map_surface((ball.vertices[used], faces.reshape(-1, 3)), domain="sphere", device="cpu")
    turned = align(result, omtwarp.map_to_sphere(ball, device="cpu"), by="features").turned(result)
    to_grid = resample(turned, "ico4", device="cpu")
    places = to_grid.target.grid.points
    apart = np.linalg.norm(to_grid.apply(turned.vertices) - places, axis=1)[~to_grid.empty]
    # At most 0.048 to 0.051, by where the filling begins; the sides of the ball's triangles are 0.1.
    assert apart.max() < 0.06 and np.sqrt((apart**2).mean()) < 0.015
    assert (places[to_grid.empty, 2] > 0.95).all() and to_grid.empty.any()


def test_distance_of_a_filled_shape_from_itself_is_zero(filled):
    found = shape_distance(filled, filled, degree=8, device="cpu")
    assert found.coefficients < 1e-12 and found.transport < 0.03
    turned = replace(align(filled), rotation=TURN).turned(filled)
    assert shape_distance(filled, turned, degree=8, device="cpu").coefficients < 1e-10


def test_group_of_filled_shapes(filled):
    turned = replace(align(filled), rotation=TURN).turned(filled)
    study = study_group([filled, turned], grid="ico3", degree=6, device="cpu")
    assert study.distances.max() < 1e-6 and study.from_mean.max() < 1e-3


def test_file_of_a_filled_map_gives_the_same(filled, tmp_path):
    filled.save(tmp_path / "m.npz")
    read = resample(tmp_path / "m.npz", "ico2", device="cpu")
    assert np.array_equal(read.matrix.toarray(), resample(filled, "ico2", device="cpu").matrix.toarray())


def test_maps_to_a_torus_are_named():
    ring = shapes.rings(1, cell=0.45)
    result = omtwarp.map_surface((ring.vertices, ring.faces))
    for use in (lambda: align(result), lambda: resample("ico2", result), lambda: shape_distance(result, result)):
        with pytest.raises(OmtwarpError, match="a map to a torus, where one to the sphere is needed"):
            use()
    ball = shapes.icosphere(2)
    sphere = omtwarp.MapResult(ball.vertices, ball.faces, ball.vertices, ball.vertices, np.ones(ball.vertex_count))
    painted = omtwarp.unwrap_uv(sphere)
    for use in (
        lambda: result.sphere,
        lambda: result.turned(TURN),
        lambda: align(sphere).turned(result),
        lambda: omtwarp.transfer_texture(painted, sphere, result),
        lambda: comparison(result),
    ):
        with pytest.raises(OmtwarpError, match="the domain of this map is 'torus': it has no 'sphere'"):
            use()
    with pytest.raises(OmtwarpError, match=r"see report\['optimality'\]"):
        omtwarp.map_optimality(result)
    assert result.report["optimality"]["gap"] < 0.01


def test_optimality_of_a_filled_map_is_in_its_report(filled):
    with pytest.raises(OmtwarpError, match=r"see report\['optimality'\]"):
        omtwarp.map_optimality(filled)
    assert filled.report["optimality"]["gap"] < 0.01


def test_cut_surface(cut):
    """Data of the input's vertices count at both copies along the cuts."""
    count, result = cut
    assert len(result.vertices) > count
    assert align(replace(align(result), rotation=TURN).turned(result), result).rotation @ TURN == pytest.approx(
        np.eye(3), abs=1e-9
    )
    data = np.cos(np.arange(count))
    for method in METHODS:
        found = resample(result, "ico3", method=method, device="cpu")
        assert np.array_equal(found.apply(data), found.apply(data[result.vertex_origin]))
    with pytest.raises(OmtwarpError, match=f"the data have {count - 1} where"):
        found.apply(data[1:])
    assert shape_distance(result, result, degree=6, device="cpu").coefficients < 1e-12
