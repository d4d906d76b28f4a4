"""Directions, pictures and rotations."""

import numpy as np
import pytest
from hypothesis import given, strategies as st
from texturing_shapes import texel_directions

from omtwarp.errors import OmtwarpError
from omtwarp.mesh.arrays import direction_from_angles
from omtwarp.texturing.image import direction_to_image, longitude_latitude, rotation_matrix


def test_the_convention_of_the_picture():
    """+x is the middle, +y a quarter to the right, the north pole the top row, longitude 180 the border."""
    uv = direction_to_image([[1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1], [-1, 0, 0]])
    expected = [[0.5, 0.5], [0.75, 0.5], [0.25, 0.5], [0.5, 1.0], [0.5, 0.0], [1.0, 0.5]]
    np.testing.assert_allclose(uv, expected, atol=1e-15)
    first_row = texel_directions(8, 4)[0]
    assert np.all(first_row[:, 2] > 0.9)
    assert first_row[0, 0] < 0 and first_row[0, 1] < 0, "the first column is just east of longitude -180"


def image_to_direction(uv, projection: str = "equirectangular") -> np.ndarray:
    """Return the unit vectors, shape [..., 3], of image coordinates: the inverse of :func:`direction_to_image`.

    Points of a sinusoidal picture outside its two bounding curves belong to no direction and give NaN.
    """
    uv = np.asarray(uv, dtype=np.float64)
    lon, lat = (uv[..., 0] - 0.5) * 2.0 * np.pi, (uv[..., 1] - 0.5) * np.pi
    if projection == "sinusoidal":
        with np.errstate(divide="ignore", invalid="ignore"):
            stretched = lon / np.cos(lat)
        inside = np.abs(stretched) <= np.pi * (1 + 1e-12)
        lon, lat = np.where(inside, stretched, np.nan), np.where(inside, lat, np.nan)
    return direction_from_angles(lon, lat)


@given(st.floats(-np.pi, np.pi), st.floats(-1.57, 1.57), st.floats(1e-20, 1e20))
def test_both_projections_invert(lon, lat, length):
    direction = direction_from_angles(lon, lat)
    for projection in ("equirectangular", "sinusoidal"):
        back = image_to_direction(direction_to_image(direction * length, projection), projection)
        np.testing.assert_allclose(back, direction, atol=1e-11)


def test_sinusoidal_scales_longitude_by_the_cosine_of_latitude():
    """The correction of section 5, and nothing beyond the two curves that bound it."""
    lon, lat = 2.0, 1.0
    u, v = direction_to_image(direction_from_angles(lon, lat), "sinusoidal")
    assert u == pytest.approx(0.5 + lon * np.cos(lat) / (2 * np.pi))
    assert v == pytest.approx(0.5 + lat / np.pi)
    assert np.isnan(image_to_direction([0.02, 0.9], "sinusoidal")).all()


def test_latitude_is_accurate_next_to_the_pole():
    """Latitude keeps its digits next to the pole, where asin(z) would lose half of them."""
    lat = np.pi / 2 - 1e-9
    got = longitude_latitude(direction_from_angles(0.3, lat))[1]
    assert np.pi / 2 - got == pytest.approx(1e-9, rel=1e-6)


@given(st.floats(-720, 720), st.floats(-90, 90), st.floats(-180, 180))
def test_angles_give_rotations(yaw, pitch, roll):
    matrix = rotation_matrix((yaw, pitch, roll))
    np.testing.assert_allclose(matrix @ matrix.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(matrix) == pytest.approx(1.0)


def test_yaw_turns_to_the_east_and_a_matrix_is_kept():
    np.testing.assert_allclose(rotation_matrix(90) @ [1, 0, 0], [0, 1, 0], atol=1e-15)
    np.testing.assert_allclose(rotation_matrix((0, 0, 90)) @ [0, 1, 0], [0, 0, 1], atol=1e-15)
    matrix = rotation_matrix((10, 20, 30))
    np.testing.assert_allclose(rotation_matrix(matrix), matrix, atol=1e-14)
    assert np.array_equal(rotation_matrix(None), np.eye(3))


@pytest.mark.parametrize("bad", [np.diag([1, 1, -1]), 2 * np.eye(3), (1, 2), "east", [[1, 2], [3]], float("nan")])
def test_what_is_no_rotation_is_refused(bad):
    with pytest.raises(OmtwarpError, match="rotate"):
        rotation_matrix(bad)


def test_unknown_projection_lists_the_known_ones():
    with pytest.raises(OmtwarpError, match="equirectangular, sinusoidal"):
        direction_to_image([1, 0, 0], "mercator")
