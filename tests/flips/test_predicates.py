"""Orientation signs against rational arithmetic, and where floating point alone is wrong."""

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from omtwarp.errors import OmtwarpError
from omtwarp.flips.exact import count_flips, orientation_signs, ring_turns
from omtwarp.mesh.shapes import icosphere


def rational_sign(triangle):
    """Return the sign of a 3 by 3 determinant in fractions, by the rule of Sarrus."""
    (a, b, c), (d, e, f), (g, h, i) = [[Fraction(float(x)) for x in row] for row in triangle]
    value = a * e * i + b * f * g + c * d * h - c * e * g - b * d * i - a * f * h
    return (value > 0) - (value < 0)


def signs_of(triangles, device="cpu"):
    points = np.reshape(triangles, (-1, 3))
    return orientation_signs(points, np.arange(len(points)).reshape(-1, 3), device=device)


def nearly_coplanar(rng, count):
    """Triangles whose third corner lies in the plane of the other two and the origin, up to rounding."""
    a, b = rng.normal(size=(2, count, 3))
    weights = rng.normal(size=(2, count, 1))
    return np.stack([a, b, weights[0] * a + weights[1] * b], axis=1)


def test_the_axes_are_positive_and_their_reverse_is_negative():
    """The triangle of the three axes is positive, as the identity's determinant is 1; in reverse it is negative."""
    assert orientation_signs(np.eye(3), [[0, 1, 2], [2, 1, 0]]).tolist() == [1, -1]


@pytest.mark.parametrize("scale", [1.0, 1e-150, 1e150, 1e-105])
def test_undecidable_triangles_agree_with_rational_arithmetic(device, scale):
    """Rounded coplanar triples have determinants of the order of the rounding; scales reach underflow and overflow."""
    triangles = nearly_coplanar(np.random.default_rng(1), 200) * scale
    expected = [rational_sign(t) for t in triangles]
    assert signs_of(triangles, device).tolist() == expected
    assert {1, -1} <= set(expected)


def test_floating_point_alone_is_wrong_on_some_of_them():
    """NumPy's determinant has the wrong sign on some of these triangles, so that the test above can fail."""
    triangles = nearly_coplanar(np.random.default_rng(1), 200)
    assert (np.sign(np.linalg.det(triangles)) != signs_of(triangles)).any()


@pytest.mark.parametrize(
    "triangle",
    [
        [[1, 0, 0], [1, 0, 0], [0, 1, 0]],
        [[1, 0, 0], [-1, 0, 0], [0, 1, 0]],
        [[0, 0, 0], [0, 1, 0], [0, 0, 1]],
        [[1, 2, 3], [2, 4, 6], [0.1, 0.7, 0.3]],
        [[0.1, 0.2, 0.3], [0.2, 0.4, 0.6], [0.1, 0.7, 0.3]],
    ],
    ids=["repeated", "antipodal", "origin", "collinear", "doubled"],
)
def test_exactly_degenerate_triangles_are_zero(device, triangle):
    """Repeated, antipodal and collinear corners span no volume with the origin."""
    assert signs_of(np.array([triangle], dtype=float), device).tolist() == [0]


@settings(max_examples=60, deadline=None)
@given(
    st.lists(
        st.floats(-1, 1, allow_subnormal=True) | st.sampled_from([0.0, 5e-324, 1e-200, 1.0, -1.0]),
        min_size=9,
        max_size=9,
    )
)
def test_any_triangle_agrees_with_rational_arithmetic_and_is_antisymmetric(numbers):
    """Swapping two corners changes the sign, and the sign is the rational one."""
    points = np.reshape(numbers, (3, 3))
    forward, swapped, turned = orientation_signs(points, [[0, 1, 2], [1, 0, 2], [1, 2, 0]])
    assert forward == rational_sign(points) == -swapped == turned


def test_flips_are_counted_and_a_missing_coordinate_is_a_flip(device):
    """A sphere has no flip, each reversed face counts as one, and so does every face around a vertex with NaN."""
    sphere = icosphere(4)
    assert count_flips(sphere.vertices, sphere.faces, device=device) == 0
    reversed_faces = sphere.faces.copy()
    reversed_faces[[3, 5]] = reversed_faces[[3, 5], ::-1]
    assert count_flips(sphere.vertices, reversed_faces, device=device) == 2
    broken = sphere.vertices.copy()
    broken[7] = np.nan
    assert count_flips(broken, sphere.faces, device=device) == (sphere.faces == 7).sum()


def test_points_that_coincide_after_rounding_are_degenerate_but_one_unit_apart_is_not():
    """One unit in the last place decides: a triangle that thin is still positive."""
    a, b = np.array([1.0, 0.0, 0.0]), np.array([0.6, 0.8, 0.0])
    on_plane = np.array([0.8, 0.6, 0.0])
    above = on_plane + [0.0, 0.0, 5e-324]
    assert signs_of(np.array([[a, b, on_plane], [a, b, above], [b, a, above]])).tolist() == [0, 1, -1]


@pytest.mark.parametrize("function", [orientation_signs, ring_turns, count_flips])
def test_arrays_that_are_no_triangles_on_points_are_refused(function):
    """Kernels would read beyond the end of the points; points that are not finite are degenerate, as before."""
    ball = icosphere(2)
    for faces in (ball.faces + 1, ball.faces - 1, ball.faces[:, :2], ball.faces + 0.5, np.full((80, 3), np.nan), "abc"):
        with pytest.raises(OmtwarpError, match="faces: "):
            function(ball.vertices, faces)
    for points in (ball.vertices[:, :2], "abc", ball.vertices.ravel(), [[0.0], [0.0, 1.0]]):
        with pytest.raises(OmtwarpError, match="sphere: "):
            function(points, ball.faces)
    with pytest.raises(OmtwarpError, match="faces: 41 in row"):
        function(ball.vertices[:-1], ball.faces)
    assert count_flips(np.where(ball.vertices > 0.99, np.nan, ball.vertices), ball.faces) > 0
