"""Strips that long triangles are cut in tile them."""

import numpy as np
from hypothesis import given, settings, strategies as st

from omtwarp.mesh import shapes
from omtwarp.texturing.bakes import MOST_STRIPS, without_slivers


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10_000), count=st.integers(1, 50), thin=st.floats(1e-6, 1.0))
def test_strips_tile_triangles_and_are_not_long(seed, count, thin):
    """Vector areas add up, no part is much longer than wide unless the number of parts forbids it."""
    rng = np.random.default_rng(seed)
    corners = rng.normal(size=(count, 1, 3)) + rng.normal(size=(count, 3, 3)) * [1.0, 1.0, thin] * [1.0, thin, 1.0]
    parts = without_slivers(corners)
    assert count <= len(parts) <= count + 2 * MOST_STRIPS

    def areas(triangles):
        return 0.5 * np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])

    given_areas, found = areas(corners), areas(parts)
    scale = np.linalg.norm(given_areas, axis=1).sum()
    np.testing.assert_allclose(found.sum(axis=0), given_areas.sum(axis=0), atol=1e-9 * scale)
    assert np.linalg.norm(found, axis=1).sum() <= scale * (1.0 + 1e-9)
    longest = np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2).max()
    apart = np.linalg.norm(parts - np.roll(parts, -1, axis=1), axis=2).max(axis=1)
    width = 2.0 * np.linalg.norm(found, axis=1) / apart
    shortest = np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2).min(axis=1).max()
    assert (apart <= np.maximum(6.0 * width, count * longest / MOST_STRIPS) + 2.0 * shortest).all()


def test_even_triangles_stay_whole():
    ball = shapes.blob(seed=2, sphere=shapes.icosphere(6))
    corners = ball.vertices[ball.faces]
    np.testing.assert_array_equal(np.sort(without_slivers(corners), axis=1), np.sort(corners, axis=1))
