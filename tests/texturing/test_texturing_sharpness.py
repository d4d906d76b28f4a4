"""The size of a texture against stretches known in closed form and measured by steps of one texel."""

import numpy as np
import pytest
import trimesh
from texturing_shapes import ellipsoid, unit

from omtwarp.texturing import make_atlas, texture
from omtwarp.texturing.atlas import largest_stretch, picture_size, sharp_size

SCREEN, TEXEL = 1024, 1.5  # pixels across a picture that the surface fills, and those that a texel covers at most


def test_the_stretch_of_a_linear_map_is_its_largest_singular_value():
    rng = np.random.default_rng(0)
    faces = np.arange(60).reshape(-1, 3)
    flat = rng.normal(size=(60, 2))
    matrix = rng.normal(size=(2, 2))
    here = np.column_stack([flat @ matrix.T, np.zeros(60)])
    found = largest_stretch(here, faces, np.column_stack([flat, np.ones(60)]))
    np.testing.assert_allclose(found, np.linalg.svd(matrix)[1][0], rtol=1e-6)


def test_triangles_without_area_count_as_what_they_are():
    faces = np.array([[0, 1, 2]])
    point, triangle = np.zeros((3, 3)), np.eye(3)
    assert largest_stretch(triangle, faces, point)[0] == np.inf
    assert largest_stretch(point, faces, triangle)[0] == 0.0


@pytest.mark.parametrize("atlas", ["cube", "octahedral", "equirectangular"])
def test_no_texel_is_larger_than_it_should_be(atlas):
    """Steps of one texel are no longer on the surface than the chosen size promises, from points all over it."""
    vertices, faces, sphere = ellipsoid(4, seed=2)
    chosen, coarse = sharp_size(vertices, faces, sphere, atlas)
    assert coarse == 0.0
    layout = make_atlas(atlas, chosen)
    rng = np.random.default_rng(1)
    f = rng.integers(len(faces), size=3000)
    share = rng.dirichlet(np.ones(3), size=len(f))
    chord = np.einsum("kc,kcj->kj", share, sphere[faces[f]])
    uv, chart = layout.uv(unit(chord)), layout.charts(unit(chord))
    edges = np.stack([sphere[faces[f, 1]] - sphere[faces[f, 0]], sphere[faces[f, 2]] - sphere[faces[f, 0]]], axis=2)
    on_surface = np.stack([vertices[faces[f, k]] - vertices[faces[f, 0]] for k in (1, 2)], axis=2)
    pixel = np.ptp(vertices, axis=0).max() / SCREEN
    largest = 0.0
    for angle in np.arange(8) * np.pi / 4.0:
        step = 1e-3 * np.array([np.cos(angle) / layout.width, np.sin(angle) / layout.height])
        moved = 1e3 * (layout.uv_directions(uv + step, chart) - layout.uv_directions(uv, chart))
        moved *= np.linalg.norm(chord, axis=1)[:, None]  # from the sphere to the triangle's plane, nearly
        inside = np.einsum("fkj,fj->fk", np.linalg.pinv(edges), moved)
        largest = max(largest, np.linalg.norm(np.einsum("fjk,fk->fj", on_surface, inside), axis=1).max() / pixel)
    # Sizes are powers of two, or one and a half times as many texels; that of octahedral textures is for the middles of
    # octants.
    assert 0.4 * TEXEL < largest < 1.05 * TEXEL


def test_the_least_size_is_taken_that_is_enough():
    """Cells of a quarter or a third of a power of two for the cube, powers of two for the other layouts."""
    found = [picture_size(float(needed), "cube", 4096)[0] for needed in (1, 240, 385, 1536, 1537, 2040, 2041, 9999)]
    assert found == [
        (256, 128),
        (256, 256),
        (512, 512),
        (2048, 1024),
        (2048, 2048),
        (2048, 2048),
        (4096, 2048),
        (4096,) * 2,
    ]
    assert [picture_size(float(needed), "octahedral", 1024)[0] for needed in (1, 513, 1025)] == [256, 1024, 1024]
    for needed in (700.0, 1500.0, 2000.0, 3000.0):
        size, enough = picture_size(needed, "cube", 8192)
        assert enough >= needed and 3 * make_atlas("cube", size).cell == enough


def test_the_limit_holds_and_says_what_it_costs():
    vertices, faces, sphere = ellipsoid(3, seed=2)
    limited, coarse = sharp_size(vertices, faces, sphere, "cube", limit=600)
    assert limited == (512, 512) and 0.0 < coarse <= 1.0
    ball = unit(np.asarray(trimesh.creation.icosphere(subdivisions=1).vertices))
    assert texture((ball, trimesh.creation.icosphere(subdivisions=1).faces, ball), size="auto").image.shape[1] >= 1900
