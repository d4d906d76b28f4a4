"""Maps that begin at points or at a map of the user's."""

import numpy as np
import pytest

import omtwarp
from omtwarp.errors import OmtwarpError
from omtwarp.mesh.shapes import blob, icosphere


@pytest.fixture(scope="module")
def mapped():
    surface = blob(seed=3, amplitude=0.25, degree=4, sphere=1280)
    return surface, omtwarp.map_to_sphere(surface, device="cpu")


def turn():
    return np.linalg.qr(np.random.default_rng(5).normal(size=(3, 3)))[0] * [[1.0], [1.0], [-1.0]]


def rms(one, other):
    return float(np.sqrt(((one - other) ** 2).sum(axis=1).mean()))


def test_points_are_taken_as_they_are(mapped):
    """From its own conformal points, turned, the map is the default one, turned alike; the points keep their bits."""
    surface, result = mapped
    rotation = turn()
    rotation *= np.sign(np.linalg.det(rotation))
    points = result.conformal @ rotation
    points /= np.linalg.norm(points, axis=1)[:, None]
    found = omtwarp.map_to_sphere(surface, start=points, device="cpu")
    np.testing.assert_array_equal(found.conformal, points)
    assert found.report["start"]["route"] == "given" and found.bijective
    assert rms(found.sphere, result.sphere @ rotation) < 1e-3


def test_the_cost_is_that_from_the_points(mapped):
    """Points of another map give another optimal map: cost is measured from them, and its bound holds."""
    surface, result = mapped
    haker = omtwarp.map_to_sphere(surface, method="haker", device="cpu").sphere
    found = omtwarp.map_to_sphere(surface, start=haker, device="cpu")
    cost = omtwarp.transport_cost(surface, found.sphere, start=haker, device="cpu")
    assert found.report["optimality"]["cost"] == pytest.approx(cost, rel=1e-9)
    assert found.report["optimality"]["lower_bound"] <= cost * (1.0 + 1e-9)
    assert cost < omtwarp.transport_cost(surface, result.sphere, start=haker, device="cpu")


def test_points_that_cover_nothing_are_refused(mapped):
    pole = np.array([0.0, 0.0, 1.0])
    for height in (mapped[1].sphere[:, 2:] > 0.0, np.ones((len(mapped[1].sphere), 1), dtype=bool)):
        with pytest.raises(OmtwarpError, match="give points that cover the sphere"):
            omtwarp.map_to_sphere(mapped[0], start=np.where(height, pole, -pole), device="cpu")


def test_flipped_points_are_repaired_and_still_measured_from(mapped):
    surface, result = mapped
    points = result.conformal.copy()
    face = surface.faces[0]
    points[face[0]] = 3.0 * points[face[1]] + 3.0 * points[face[2]] - points[face[0]]
    points[face[0]] /= np.linalg.norm(points[face[0]])
    assert not omtwarp.certify(surface, points, device="cpu").bijective
    found = omtwarp.map_to_sphere(surface, start=points, device="cpu")
    assert found.bijective and found.report["start"]["route"] == "given, repaired"
    np.testing.assert_array_equal(found.source, points)


def test_a_map_is_gone_on_from(mapped):
    """From the optimal map itself there is next to nothing left to do, and another map leads to the same optimum."""
    surface, result = mapped
    again = omtwarp.map_to_sphere(surface, start=result, device="cpu")
    assert rms(again.sphere, result.sphere) < 2e-3
    assert len(again.history) <= len(result.history)
    moser = omtwarp.map_to_sphere(surface, until="moser", device="cpu")
    other = omtwarp.map_to_sphere(surface, start=moser, device="cpu")
    assert rms(other.sphere, result.sphere) < 0.01


def test_what_cannot_be_begun_at_is_refused(mapped):
    surface, result = mapped
    for start, what in (
        (result.conformal[1:], "start"),
        (2.0 * result.conformal, "start"),
        (np.full_like(result.conformal, np.nan), "start"),
        (omtwarp.map_to_sphere(icosphere(9), device="cpu"), "another mesh"),
    ):
        with pytest.raises(OmtwarpError, match=what):
            omtwarp.map_to_sphere(surface, start=start, device="cpu")
    with pytest.raises(OmtwarpError, match="barycentric"):
        omtwarp.map_to_sphere(surface, start=result, method="tutte", device="cpu")
