"""Turns of maps against the optimal one: closed forms, and limbs that are turned back."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from omtwarp import OmtwarpError
from omtwarp.flips.exact import is_bijective
from omtwarp.mesh.shapes import icosphere
from omtwarp.mesh.surface import Surface
from omtwarp.optimal import turns
from omtwarp.optimal.turns import size, turned_back, turns_against

BALL = icosphere(24)


def askew(ball: Surface) -> np.ndarray:
    """The vertices of a ball turned so that none is at a pole."""
    return Rotation.from_rotvec([0.3, 0.2, 0.1]).apply(np.array(ball.vertices))


def twisted(points: np.ndarray, most: float) -> np.ndarray:
    """Points whose longitudes grow towards the north pole by up to so many radians: areas are kept."""
    height = np.clip(points[:, 2], 0.0, None)
    angle = most * height**2 * (3.0 - 2.0 * height)
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.stack(
        [cosine * points[:, 0] - sine * points[:, 1], sine * points[:, 0] + cosine * points[:, 1], points[:, 2]], axis=1
    )


def stretched(points: np.ndarray) -> np.ndarray:
    """Points moved along their meridians, as an optimal map does that is symmetric about the axis."""
    latitude = np.arcsin(np.clip(points[:, 2], -1.0, 1.0))
    moved = latitude + 0.3 * np.cos(latitude) ** 2
    flat = points[:, :2] / np.maximum(np.linalg.norm(points[:, :2], axis=1), 1e-300)[:, None]
    return np.column_stack([np.cos(moved)[:, None] * flat, np.sin(moved)])


@pytest.mark.parametrize("angle", [-0.4, 0.1])
def test_a_rotation_turns_triangles_as_they_see_it_from_outside(angle):
    """At its pole by its angle, at the other pole the other way round, on the equator not at all."""
    x = askew(BALL)
    found = turns_against(BALL, Rotation.from_rotvec([0.0, 0.0, angle]).apply(x), x, device="cpu")
    middle = x[BALL.faces].mean(axis=1)
    height = middle[:, 2] / np.linalg.norm(middle, axis=1)
    np.testing.assert_allclose(found, angle * height, atol=0.02 * abs(angle))


def test_an_optimal_map_turns_nothing():
    """Along meridians: what is left is the error of the triangles, of first order in their size."""
    sizes = []
    for ball in (icosphere(12), icosphere(24)):
        x = askew(ball)
        sizes.append(size(ball, turns_against(ball, stretched(x), x, device="cpu")))
    assert sizes[1] < 0.6 * sizes[0]
    assert sizes[0] < 0.002


@pytest.mark.parametrize("most", [0.5, -1.0, 2.0])
def test_a_limb_is_turned_back(most):
    x = BALL.vertices
    sphere = twisted(x, most)
    back = turned_back(BALL, sphere, x, device="cpu")
    assert is_bijective(back, BALL.faces)
    before, after = (size(BALL, turns_against(BALL, points, x, device="cpu")) for points in (sphere, back))
    assert before > 0.3 * abs(most)
    assert after < 0.05 * before


def test_a_map_without_turns_stays_to_the_last_bit():
    back = turned_back(BALL, BALL.vertices, BALL.vertices, device="cpu")
    np.testing.assert_array_equal(back, BALL.vertices)


def test_triangles_that_are_flipped_at_x_do_not_count():
    x = BALL.vertices.copy()
    x[5] = BALL.vertices[BALL.faces[0]].mean(axis=0)
    x[5] /= np.linalg.norm(x[5])
    found = turns_against(BALL, BALL.vertices, x, device="cpu")
    corners = x[BALL.faces]
    flipped = np.linalg.det(corners) <= 0.0
    assert flipped.any()
    assert (found[flipped] == 0.0).all()


def test_a_map_that_cannot_be_repaired_stays(monkeypatch):
    def refused(*arguments, **options):
        raise OmtwarpError("5 flipped triangles could not be repaired")

    monkeypatch.setattr(turns, "untangled", refused)
    sphere = twisted(BALL.vertices, 1.0)
    assert turned_back(BALL, sphere, BALL.vertices, device="cpu") is sphere
