"""A density on the sphere as the goal: monotone rearrangement in closed form, mass, and input that is no density."""

import warnings
from functools import partial

import numpy as np
import pytest
from sphere_truths import mean_edge, pushed_north, random_rotation, rms, turned, twisted

import omtwarp
from omtwarp.errors import OmtwarpError
from omtwarp.measures import TargetDensity, mass_distortion
from omtwarp.mesh.arrays import direction_from_angles
from omtwarp.mesh.shapes import blob, icosphere
from omtwarp.mesh.surface import SPHERE_AREA
from omtwarp.optimal.density import map_to_density
from omtwarp.texturing.density import as_target, image_density, vertex_density

AMOUNT = 0.5


def pushed_density(points):
    """Return the density of the uniform sphere's image under :func:`pushed_north`: 1 / (1 - a z(w)) at height w."""
    return 1.0 / np.sqrt(1.0 - 2.0 * AMOUNT * points[:, 2] + AMOUNT**2)


PUSHED = TargetDensity(pushed_density)


def test_the_total_mass_is_the_integral():
    """∫ exp(k z) dA = 4π sinh(k) / k."""
    density = TargetDensity(lambda points: 7.0 * np.exp(2.0 * points[:, 2]))
    assert density.mass == pytest.approx(7.0 * 4 * np.pi * np.sinh(2.0) / 2.0, rel=1e-3)
    sphere = icosphere(20)
    assert density.on_triangles(sphere.vertices, sphere.faces) @ sphere.face_areas == pytest.approx(4 * np.pi, rel=2e-3)


def test_moser_carries_the_uniform_sphere_to_an_axisymmetric_density(device):
    """Moser's map to an axisymmetric density is the monotone rearrangement in latitude, to second order in edges."""
    errors = []
    for frequency in (8, 16):
        surface = turned(icosphere(frequency))
        truth = pushed_north(surface.vertices, AMOUNT)
        sphere = omtwarp.moser_map(surface, surface.vertices, target=PUSHED, device=device).sphere
        errors.append(rms(np.linalg.norm(sphere - truth, axis=1)))
        assert mass_distortion(PUSHED.goal(surface, sphere), sphere)["mean"] < 2.0001
    assert errors[0] < 0.005
    assert errors[1] < 0.3 * errors[0]


def from_a_twist(surface):
    """A map that reaches the pushed density and is far from optimal: the sphere twisted about x, then pushed north."""
    about_x = np.roll(np.eye(3), 1, axis=0)
    return pushed_north(twisted(surface.vertices @ about_x.T, 0.6) @ about_x, AMOUNT)


def test_transport_to_an_axisymmetric_density_ends_at_the_monotone_rearrangement(device):
    surface = turned(icosphere(12))
    truth, initial = pushed_north(surface.vertices, AMOUNT), from_a_twist(surface)
    moved = omtwarp.optimal_transport(surface, initial, start=surface.vertices, target=PUSHED, device=device)
    before, after = (rms(np.linalg.norm(points - truth, axis=1)) for points in (initial, moved.sphere))
    assert before > 0.2
    assert after < 0.1 * before
    least = omtwarp.transport_cost(surface, truth, start=surface.vertices, device=device)
    assert moved.history[-1]["cost"] == pytest.approx(least, rel=0.01)
    kept = mass_distortion(PUSHED.goal(surface, moved.sphere), moved.sphere)["mean"]
    assert kept < 2.01
    uniform = omtwarp.optimal_transport(surface, initial, start=surface.vertices, device=device).sphere
    assert mass_distortion(PUSHED.goal(surface, uniform), uniform)["mean"] - 2.0 > 3.0 * (kept - 2.0)


def test_newton_steps_from_a_twist_end_at_the_monotone_rearrangement_too():
    surface = turned(icosphere(12))
    points, truth, initial = surface.vertices, pushed_north(surface.vertices, AMOUNT), from_a_twist(surface)
    solve = partial(omtwarp.optimal_map, start=points, device="cpu")
    found = map_to_density(surface, initial, PUSHED, solve, start=points, device="cpu")
    before, after = (rms(np.linalg.norm(there - truth, axis=1)) for there in (initial, found.sphere))
    assert found.converged
    assert before > 0.2
    assert after < 0.03 * before
    assert mass_distortion(PUSHED.goal(surface, found.sphere), found.sphere)["mean"] < 2.001


@pytest.mark.parametrize(("edges", "mass", "gap"), [(False, 2.001, 5e-4), (True, 2.04, 4e-3)])
def test_densities_of_high_contrast_and_with_edges_are_reached_by_optimal_maps(edges, mass, gap):
    def density(points):
        return 1.0 + 4.0 * (np.sin(4.0 * points[:, 0]) * np.sin(4.0 * points[:, 1]) > 0.0)

    target = density if edges else lambda points: np.exp(1.5 * points[:, 2])  # twenty times as much at one pole
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", omtwarp.OmtwarpWarning)  # edges cross triangles
        result = omtwarp.map_to_sphere(blob(3, amplitude=0.3, sphere=5120), target=target, device="cpu")
    assert result.bijective
    assert result.report["mass"]["mean"] < mass
    assert result.report["optimality"]["gap"] < gap


def test_the_cost_between_the_uniform_density_and_exp_z_is_that_of_the_closed_form():
    """Both ways, in area times squared radians, 4π times what plans between shares of 1 cost.

    The monotone rearrangement in height takes z to log(1/e + (z + 1) sinh(1)); the cost converges to second order.
    """
    heights = np.linspace(-1.0, 1.0, 200_001)
    images = np.clip(np.log(1.0 / np.e + (heights + 1.0) * np.sinh(1.0)), -1.0, 1.0)
    exact = 2.0 * np.pi * np.trapezoid((np.arccos(heights) - np.arccos(images)) ** 2, heights)
    assert exact == pytest.approx(1.878, abs=5e-4)
    there, back = [], []
    for frequency in (8, 16):
        surface = icosphere(frequency)
        result = omtwarp.map_to_sphere(surface, target=lambda points: np.exp(points[:, 2]), device="cpu")
        there.append(result.report["optimality"]["cost"])
        assert np.abs(result.source - surface.vertices).max() < 1e-3  # nothing but the mass moves
        weighted = omtwarp.weighted_surface(surface, np.exp(surface.vertices[:, 2]))
        points = surface.vertices
        first = omtwarp.moser_map(weighted, points, device="cpu").sphere
        found = omtwarp.optimal_map(weighted, first, start=points, device="cpu")
        back.append(omtwarp.transport_cost(weighted, found.sphere, start=points))
    for coarse, fine in (there, back):
        assert fine == pytest.approx(exact, rel=3e-3)
        assert (4.0 * fine - coarse) / 3.0 == pytest.approx(exact, rel=1e-4)
    # With weights the points that mass moves from are those of the weighted surface: their mean mass is at the centre.
    result = omtwarp.map_to_sphere(surface, weights=np.exp(points[:, 2]), device="cpu")
    assert np.abs(weighted.vertex_areas @ result.source).max() < 1e-6 * SPHERE_AREA
    assert result.report["optimality"]["cost"] < 0.01 * exact


def test_steepest_descent_keeps_a_target_too(device):
    surface = turned(icosphere(8))
    initial = from_a_twist(surface)
    moved = omtwarp.optimal_transport(
        surface, initial, start=surface.vertices, target=PUSHED, scheme="plain", iterations=40, device=device
    )
    costs = [record["cost"] for record in moved.history]
    assert costs[-1] < 0.97 * costs[0]
    assert mass_distortion(PUSHED.goal(surface, moved.sphere), moved.sphere)["mean"] < 2.01


def test_the_whole_pipeline_reaches_a_target_and_weights(device):
    """The final map of a sphere to a target, with weights, agrees with the optimal motion along meridians."""
    surface = turned(icosphere(10))
    edge = mean_edge(surface, surface.vertices)
    result = omtwarp.map_to_sphere(surface, target=pushed_density, refine="area", device=device)
    truth = pushed_north(result.conformal, AMOUNT)
    assert rms(np.linalg.norm(result.transported - truth, axis=1)) < 0.15 * edge
    assert result.report["mass"]["mean"] < 2.0001
    assert result.bijective
    np.testing.assert_allclose(result.target, PUSHED.at(result.sphere), rtol=1e-12)
    # The other way round: mass at w as the density says, and the uniform sphere as the goal.
    weighted = omtwarp.map_to_sphere(surface, weights=pushed_density(surface.vertices), refine="area", device=device)
    heights = (1.0 - np.sqrt(1.0 - 2.0 * AMOUNT * surface.vertices[:, 2] + AMOUNT**2)) / AMOUNT
    axis = np.linalg.lstsq(weighted.sphere, heights, rcond=None)[0]  # heights are linear in the image, up to a rotation
    assert np.linalg.norm(axis) == pytest.approx(1.0, abs=0.002)
    assert rms(weighted.sphere @ axis - heights) < 0.002
    assert weighted.report["mass"]["mean"] < 2.0001
    assert weighted.measure.sum() == pytest.approx(4 * np.pi, rel=1e-12)


def test_a_part_of_thrice_the_weight_covers_thrice_as_much():
    surface = blob(3, sphere=1500)
    chosen = surface.vertices[surface.faces].mean(axis=1)[:, 0] > np.quantile(surface.vertices[:, 0], 0.8)
    result = omtwarp.map_to_sphere(surface, weights=np.where(chosen, 3.0, 1.0), refine="area", device="cpu")
    image = omtwarp.mesh.surface.triangle_areas(result.sphere, result.faces)
    own = omtwarp.Surface(surface.vertices, surface.faces).face_areas
    gain = (image[chosen].sum() / own[chosen].sum()) / (image[~chosen].sum() / own[~chosen].sum())
    # Areas are kept around vertices, so that the edge of the part is spread over the triangles next to it.
    assert gain == pytest.approx(3.0, rel=0.03)


def test_a_picture_is_a_density(device):
    y, x = np.mgrid[0:90, 0:180]
    longitude, latitude = (x + 0.5) * np.pi / 90 - np.pi, np.pi / 2 - (y + 0.5) * np.pi / 90
    smooth = 0.5 + 0.4 * np.cos(latitude) * np.cos(longitude)
    points = direction_from_angles(longitude.ravel()[::37], latitude.ravel()[::37])
    density = image_density(smooth)
    np.testing.assert_allclose(density.at(points) * density.mass / (4 * np.pi), 0.5 + 0.4 * points[:, 0], atol=2e-3)
    seam = direction_from_angles([np.pi - 1e-9, -np.pi + 1e-9], [0.3, 0.3])
    assert np.ptp(density.at(seam)) < 1e-6
    surface = blob(3, sphere=1500)
    result = omtwarp.map_to_sphere(surface, target=smooth, until="moser", device=device)
    assert result.report["mass"]["mean"] < 2.02


def test_data_on_the_vertices_of_a_sphere_is_a_density():
    sphere = icosphere(12)
    values = 2.0 + sphere.vertices[:, 1]
    density = vertex_density(100.0 * sphere.vertices, sphere.faces, values, device="cpu")
    points = icosphere(5).vertices @ random_rotation(1).T
    np.testing.assert_allclose(density.at(points), 1.0 + points[:, 1] / 2.0, atol=0.01)
    assert as_target((sphere.vertices, sphere.faces, values), device="cpu").mass == pytest.approx(8 * np.pi, rel=0.01)


def test_a_floor_raises_the_dark_parts():
    black = np.zeros((8, 16))
    black[:, :4] = 1.0
    with pytest.raises(OmtwarpError, match="96 texels of the target image are black, the first in row 0, column 4"):
        image_density(black)
    density = image_density(black, floor=0.1)
    ratio = density.at(direction_from_angles([0.5], [0.0])) / density.at(direction_from_angles([-2.5], [0.0]))
    assert ratio[0] == pytest.approx(0.1 * 0.25, rel=0.02)


@pytest.mark.parametrize(
    ("target", "message"),
    [
        (lambda p: p[:, 2], "it must be positive and finite everywhere"),
        (lambda p: np.full(len(p), np.nan), "nan at"),
        (lambda p: p, r"gave shape \[.*, 3\]"),
        (lambda p: ["a"] * len(p), "cannot be evaluated"),
        ((icosphere(2).vertices, icosphere(2).faces), "2 arrays"),
        ((icosphere(2).vertices, icosphere(2).faces, np.ones(3)), r"values: shape \[3\], not \[42\]"),
        (5, "type int"),
        ("missing.png", r"missing\.png"),
    ],
)
def test_what_is_no_density_is_refused_in_one_line(target, message):
    with pytest.raises(OmtwarpError, match=message):
        omtwarp.map_to_sphere(icosphere(3), target=target, device="cpu")


def test_a_density_may_change_the_points_it_is_given():
    def tripled(points):
        z = points[:, 2].copy()
        points *= 3.0
        return 2.0 + z

    points = np.eye(3)
    found = TargetDensity(tripled).at(points)
    np.testing.assert_array_equal(points, np.eye(3))
    np.testing.assert_array_equal(found, TargetDensity(lambda points: 2.0 + points[:, 2]).at(points))


@pytest.mark.parametrize("option", [{"method": "tutte"}, {"scheme": "paper"}, {"method": "haker"}])
def test_methods_that_know_the_uniform_sphere_alone_say_so(option):
    with pytest.raises(OmtwarpError, match="a target density needs"):
        omtwarp.map_to_sphere(icosphere(3), target=pushed_density, device="cpu", **option)


@pytest.mark.parametrize("floor", [0.0, 0.1])
def test_a_picture_that_is_black_everywhere_is_no_target(floor):
    with pytest.raises(OmtwarpError, match="the target image is black everywhere"):
        image_density(np.zeros((8, 16, 3), dtype=np.uint8), floor=floor)


def test_floors_that_there_are_not():
    with pytest.raises(OmtwarpError, match="floor"):
        TargetDensity(pushed_density, floor=1.0)


def test_a_function_is_taken_for_a_target_density_and_what_is_none_is_refused():
    """Both stages take a function as maps do, and refuse what it is not, or gives wrongly, in one line."""
    ball = icosphere(4)
    points = ball.vertices
    stages = partial(omtwarp.moser_map, ball, points), partial(omtwarp.optimal_transport, ball, points, start=points)
    for stage in stages:
        with pytest.raises(OmtwarpError, match="the target density"):
            stage(target=3, device="cpu")
        with pytest.raises(OmtwarpError, match="the target density gave shape"):
            stage(target=lambda points: np.ones(3), device="cpu")
        found = [stage(target=target, device="cpu").sphere for target in (pushed_density, PUSHED)]
        np.testing.assert_allclose(*found, atol=1e-12)


@pytest.mark.parametrize("floor", [None, "0.1", 1.0, -0.1, np.nan, [0.1], 10**400])
def test_floors_that_are_no_shares_are_refused(floor):
    with pytest.raises(OmtwarpError, match="the floor of the target density"):
        TargetDensity(pushed_density, floor)
