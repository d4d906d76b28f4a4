"""The match of places that a warp may begin with: all rotations are candidates, and holes and landmarks count."""

from __future__ import annotations

import numpy as np
import pytest
from made_cortices import BALL, flowed, folded
from sphere_truths import random_rotation

from omtwarp.location import Locator
from omtwarp.mesh import shapes
from omtwarp.registration.feature_term import FeatureField
from omtwarp.registration.folding import folding_features
from omtwarp.registration.landmarks import Pairs
from omtwarp.registration.matching import Matching

GRID = shapes.icosphere(32)
POINTS = shapes.icosphere(3)
MATCHING = Matching(POINTS, shapes.icosphere(8), GRID)
WEIGHTS = np.array([1.0, 0.5])
ALL = np.ones(GRID.vertex_count)


def features(sphere, seed=0):
    """Depth and curvature of a made cortex at the vertices of GRID, of its map to a sphere, each of variance 1."""
    columns = np.column_stack(list(folding_features(folded(BALL, seed), BALL.faces).values()))
    found = Locator(sphere, BALL.faces, device="cpu").find(GRID.vertices)
    values = np.einsum("pk,pkc->pc", found.coordinates, columns[BALL.faces[found.faces]])
    return (values - values.mean(axis=0)) / values.std(axis=0)


def degrees(one, other):
    return np.degrees(np.arccos(np.clip((one * other).sum(axis=1), -1.0, 1.0)))


def taken(sphere):
    """Where a map of BALL takes the points that are matched."""
    return Locator(BALL.vertices, BALL.faces, device="cpu").find(POINTS.vertices).on_sphere(BALL.faces, sphere)


@pytest.mark.parametrize("seed", range(4))
def test_a_rotation_is_found_whatever_it_is(seed):
    """Places are 8 degrees from one another, and turns 15 degrees."""
    rotation = random_rotation(seed)
    here, there = features(BALL.vertices), features(BALL.vertices @ rotation.T)
    found = MATCHING.match(here, ALL, there, WEIGHTS, None)
    assert degrees(found, POINTS.vertices @ rotation.T).max() < 8.0


@pytest.mark.parametrize("seed", [0, 3, 4])
def test_a_warp_of_40_degrees_is_found_after_any_rotation(seed):
    truth = flowed(BALL.vertices, 40.0, seed + 1) @ random_rotation(seed).T
    found = MATCHING.match(features(BALL.vertices, seed), ALL, features(truth, seed), WEIGHTS, None)
    apart = degrees(found, taken(truth))
    assert np.median(apart) < 6.0 and np.quantile(apart, 0.95) < 16.0


def test_what_lies_in_a_hole_does_not_count():
    """Numbers in the hole change nothing, and around it the rotation is found as elsewhere."""
    rotation = random_rotation(1)
    here, there = features(BALL.vertices), features(BALL.vertices @ rotation.T)
    hole = GRID.vertices[:, 2] > 0.7
    known = np.where(hole, 0.0, 1.0)
    found = [
        MATCHING.match(np.where(hole[:, None], filling, here), known, there, WEIGHTS, None) for filling in (0.0, 50.0)
    ]
    np.testing.assert_array_equal(*found)
    outside = POINTS.vertices[:, 2] < 0.6
    assert degrees(found[0], POINTS.vertices @ rotation.T)[outside].max() < 8.0


@pytest.mark.parametrize("weight", [3.0, np.inf])
def test_landmarks_decide_where_features_cannot(weight):
    """Of a surface of revolution, about whose axis all rotations fit, four landmarks tell which it is."""
    angle = np.radians(100.0)
    turn = np.array([[np.cos(angle), -np.sin(angle), 0.0], [np.sin(angle), np.cos(angle), 0.0], [0.0, 0.0, 1.0]])
    height = np.cos(5.0 * np.arccos(GRID.vertices[:, 2]))[:, None] + np.zeros(2) + 0.2 * GRID.vertices[:, 2:]
    points = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    pairs = Pairs(tuple("abcd"), np.arange(4), points, points @ turn.T, np.full(4, weight))
    found = MATCHING.match(height, ALL, height, WEIGHTS, pairs)
    near = np.abs(POINTS.vertices[:, 2]) < 0.3
    assert np.median(degrees(found, POINTS.vertices @ turn.T)[near]) < 12.0


def test_the_samples_around_a_point_are_a_function_of_it():
    """Of a function that is turned about a point, the best turn of the point's own place is that turn."""
    point = POINTS.vertices[5]
    field = FeatureField(GRID, features(BALL.vertices))
    for seed in range(3):
        angle = np.random.default_rng(seed).uniform(0.0, 2.0 * np.pi)
        cross = np.cross(np.eye(3), -point)
        turn = np.cos(angle) * np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * np.outer(point, point)
        found = MATCHING.match(features(BALL.vertices), ALL, field.at(GRID.vertices @ turn)[0], WEIGHTS, None)
        assert degrees(found, POINTS.vertices @ turn.T).max() < 8.0
