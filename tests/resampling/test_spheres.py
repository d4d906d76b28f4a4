"""Grids on the sphere: their points, the cells that cover it once, and the files that two of them come from."""

from __future__ import annotations

import numpy as np
import pytest

from omtwarp.errors import OmtwarpError
from omtwarp.mesh import shapes
from omtwarp.spheres import healpix, mesh_grid, named_grid, polygon_areas

NAMES = [
    "ico0",
    "ico3",
    "fsaverage3",
    "healpix:1",
    "healpix:6",
    "healpix-nested:8",
    "equiangular:9x14",
    "octahedral:12",
]


@pytest.mark.parametrize("name", NAMES)
def test_cells_are_convex_and_cover_the_sphere_once(name):
    grid = named_grid(name)
    corners, owners = grid.cells
    areas = polygon_areas(corners)
    np.testing.assert_allclose(areas.sum(), 4.0 * np.pi, rtol=1e-13)
    assert areas.min() > 0 and set(owners) == set(range(len(grid.points)))
    for k in range(4):
        side = np.cross(corners[:, k], corners[:, (k + 1) % 4])
        heights = np.einsum("md,mkd->mk", side, corners)
        assert (heights > -1e-14).all()
    np.testing.assert_allclose(np.linalg.norm(grid.points, axis=1), 1.0, atol=1e-15)
    assert int(np.prod(grid.shape)) == len(grid.points)


@pytest.mark.parametrize("name", NAMES)
def test_points_lie_in_their_own_cells(name):
    grid = named_grid(name)
    corners, owners = grid.cells
    inside = np.zeros(len(grid.points), bool)
    own = np.ones(len(owners), bool)
    for k in range(4):
        side = np.cross(corners[:, k], corners[:, (k + 1) % 4])
        own &= np.einsum("md,md->m", side, grid.points[owners]) > -1e-14
    np.logical_or.at(inside, owners, own)
    assert inside.all()


def test_triangles_of_pixels_are_a_closed_sphere():
    for name in ("healpix:4", "equiangular:8x16", "octahedral:8"):
        grid = named_grid(name)
        assert len(grid.triangles) == 2 * len(grid.points) - 4
        assert (np.linalg.det(grid.points[grid.triangles]) > 0).all()


def test_healpix_is_that_of_an_independent_library():
    astropy_healpix = pytest.importorskip("astropy_healpix")
    for side in (1, 2, 4, 16):
        given = astropy_healpix.HEALPix(nside=side, order="ring")
        longitude, latitude = given.healpix_to_lonlat(np.arange(12 * side * side))
        lon, lat = longitude.to_value("rad"), latitude.to_value("rad")
        expected = np.stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)], axis=1)
        np.testing.assert_allclose(healpix(side).points, expected, atol=1e-13)
    given = astropy_healpix.HEALPix(nside=8, order="nested")
    ring = given.nested_to_ring(np.arange(768))
    np.testing.assert_allclose(healpix(8, nested=True).points, healpix(8).points[ring], atol=1e-14)


def test_healpix_rings_by_their_definition():
    """Ring i of the northern cap has 4 i pixels at z = 1 - i² / 3 NSIDE² (Górski et al., equations 4 and 5)."""
    side = 6
    points = healpix(side).points
    first = 0
    for i in range(1, side):
        ring = points[first : first + 4 * i]
        np.testing.assert_allclose(ring[:, 2], 1.0 - i * i / (3.0 * side * side), atol=1e-14)
        longitude = np.arctan2(ring[:, 1], ring[:, 0]) % (2 * np.pi)
        np.testing.assert_allclose(longitude, np.pi / (2 * i) * (np.arange(4 * i) + 0.5), atol=1e-13)
        first += 4 * i


def test_fsaverage5_is_freesurfers(nilearn_fsaverage5):
    points, faces = nilearn_fsaverage5("sphere_left")
    made = named_grid("fsaverage5")
    np.testing.assert_array_equal(made.faces, faces)
    np.testing.assert_allclose(made.points, points / 100.0, atol=5.1e-5)  # written with four digits
    for level in (3, 4):
        coarse = named_grid(f"fsaverage{level}")
        np.testing.assert_array_equal(coarse.points, made.points[: len(coarse.points)])


def test_other_spheres_are_refused():
    sphere = shapes.icosphere(4)
    with pytest.raises(OmtwarpError, match="not a sphere about the origin"):
        mesh_grid(sphere.vertices + [0.0, 0.0, 0.3], sphere.faces)
    with pytest.raises(OmtwarpError, match="clockwise"):
        mesh_grid(sphere.vertices, sphere.faces[:, ::-1])
    with pytest.raises(OmtwarpError, match="do not cover the sphere once"):
        mesh_grid(sphere.vertices, sphere.faces[1:])
    with pytest.raises(OmtwarpError, match="out of range"):
        mesh_grid(sphere.vertices, sphere.faces + 1)
    with pytest.raises(OmtwarpError, match="not finite, first in row 3"):
        mesh_grid(np.where(np.arange(162)[:, None] == 3, np.nan, sphere.vertices), sphere.faces)
    grid = mesh_grid(100.0 * sphere.vertices, sphere.faces)
    np.testing.assert_allclose(grid.points, sphere.vertices, atol=1e-15)


@pytest.mark.parametrize(
    "name", ["ico9", "fsaverage2", "healpix:0", "healpix-nested:3", "equiangular:1x4", "octahedral:7", "torus:3"]
)
def test_names_out_of_range(name):
    with pytest.raises(OmtwarpError, match=name):
        named_grid(name)


@pytest.mark.parametrize("name", NAMES)
def test_arrays_of_a_grid_are_the_callers_own(name):
    before = named_grid(name).points.copy()
    taken = named_grid(name)
    taken.points[:] *= 100.0
    if taken.faces is not None:
        taken.faces[:] = 0
    again = named_grid(name)
    np.testing.assert_array_equal(again.points, before)
    assert again.faces is None or again.faces.any()
