"""Texture coordinates: no triangle across a chart, the map kept to a fraction of a texel, nothing lost on the way."""

import numpy as np
import pytest
import trimesh
from hypothesis import given, strategies as st
from texturing_shapes import ellipsoid, rotation, unit

from omtwarp.errors import OmtwarpError
from omtwarp.texturing.atlas import ATLASES, CUBE_FRAMES, make_atlas
from omtwarp.texturing.bakes import least_visible_meridian
from omtwarp.texturing.seams import CutMesh, unwrap


def uv_error(cut, atlas, sphere, seed=0, turn=None):
    """Largest angle between linear texture coordinates and the map at random points of every face."""
    bary = np.random.default_rng(seed).dirichlet((1, 1, 1), size=len(cut.faces))
    uv = np.einsum("fk,fkj->fj", bary, cut.uv)
    chords = (cut.weights @ sphere)[cut.faces]
    expected = unit(np.einsum("fk,fkj->fj", bary, chords)) @ (np.eye(3) if turn is None else turn)
    return np.linalg.norm(atlas.uv_directions(uv, cut.chart) - expected, axis=1)


@pytest.mark.parametrize("name", ATLASES)
@pytest.mark.parametrize("subdivisions", [0, 1, 3])
@pytest.mark.parametrize("seed", [None, 4])
def test_texture_coordinates_invert_to_the_map(name, subdivisions, seed):
    """On meshes down to a plain icosahedron, with and without vertices on the poles, seams and corners."""
    _, faces, sphere = ellipsoid(subdivisions, seed)
    atlas = make_atlas(name, 1024)
    cut = unwrap(sphere, faces, atlas)
    assert uv_error(cut, atlas, sphere).max() < 0.75 * atlas.texel_angle


@pytest.mark.parametrize("name", ATLASES)
def test_no_face_straddles_two_charts(name):
    _, faces, sphere = ellipsoid(2, seed=2)
    atlas = make_atlas(name, 512)
    cut = unwrap(sphere, faces, atlas)
    corners = cut.sphere[cut.faces]
    if name == "equirectangular":
        u = cut.uv[..., 0]
        assert np.ptp(u, axis=1).max() <= 0.5
        assert corners[..., 1][(u > 0) & (u < 0.5)].max() < 1e-9
        assert corners[..., 1][(u > 0.5) & (u < 1)].min() > -1e-9
    elif name == "cube":
        local = np.einsum("fkj,fij->fki", corners, CUBE_FRAMES[cut.chart])
        assert np.all(np.abs(local[..., 1:]) <= local[..., :1] + 1e-9)
    else:
        signs = np.stack([1 - 2 * (cut.chart & 1), 1 - (cut.chart & 2), 1 - (cut.chart & 4) // 2], axis=1)
        assert np.all(corners * signs[:, None, :] >= -1e-9)
    assert cut.uv.min() >= 0 and cut.uv.max() <= 1
    assert set(cut.chart) == set(range(atlas.chart_count))
    # No mirrored triangles: the map keeps its orientation, and so does the picture.
    a, b, c = np.moveaxis(cut.uv, 1, 0)
    area = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    # (Within a few texels of a pole of the equirectangular picture direction says little about longitude.)
    near_pole = (name == "equirectangular") & (np.abs(corners[..., 2]).max(axis=1) > np.cos(8 * atlas.texel_angle))
    assert area[~near_pole].min() > 0


@pytest.mark.parametrize("name", ATLASES)
def test_texture_area_fills_the_charts_once(name):
    """The triangles tile the charts: areas in the picture sum to the charts' own."""
    _, faces, sphere = ellipsoid(2, seed=6)
    atlas = make_atlas(name, 768)
    cut = unwrap(sphere, faces, atlas)
    a, b, c = np.moveaxis(cut.uv, 1, 0)
    area = 0.5 * ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]).sum()
    if name == "equirectangular":  # linear triangles at a pole leave half of their last, tiny strip out
        assert area == pytest.approx(1.0, abs=4e-3)
    elif name == "cube":
        assert area == pytest.approx(((atlas.cell - 2 * atlas.gutter) / atlas.cell) ** 2, rel=1e-9)
    else:
        assert area == pytest.approx(((atlas.width - 2 * atlas.gutter) / atlas.width) ** 2, rel=1e-9)


@given(st.integers(0, 10_000), st.sampled_from(ATLASES), st.floats(-180, 180))
def test_cutting_keeps_surface_order_and_closedness(seed, name, seam):
    """The original vertices come first, unmoved; the mesh is closed and as large as before."""
    vertices, faces, sphere = ellipsoid(1, seed=seed)
    cut = unwrap(sphere, faces, make_atlas(name, 256, seam=np.deg2rad(seam)), rotation=rotation(seed + 1))
    count = len(vertices)
    positions = cut.weights @ vertices
    np.testing.assert_array_equal(positions[:count], vertices)
    np.testing.assert_allclose(cut.sphere[:count], sphere, atol=1e-12)
    weld = trimesh.Trimesh(positions, cut.faces, process=False)
    assert weld.is_watertight and weld.is_winding_consistent and weld.euler_number == 2
    whole = trimesh.Trimesh(vertices, faces, process=False)
    assert weld.area == pytest.approx(whole.area, rel=1e-12) and weld.volume == pytest.approx(whole.volume, rel=1e-12)
    parts = np.bincount(cut.source_face, weld.area_faces, minlength=len(faces))
    np.testing.assert_allclose(parts, whole.area_faces, rtol=1e-9)
    assert np.all(np.diff(cut.source_face) >= 0)


@pytest.mark.parametrize("at", ["vertex", "edge", "face"])
def test_pole_triangles(at):
    """The pole on a vertex, on an edge or inside a face: it is a vertex afterwards and its triangles are narrow."""
    _, faces, sphere = ellipsoid(2, strength=0.0)
    target = sphere[faces[11]]
    pole = {"vertex": target[0], "edge": target[0] + target[1], "face": target.sum(axis=0)}[at]
    pole = unit(pole)
    side = unit(np.cross(pole, [0.3, 0.5, 0.2]))
    turn = np.stack([side, np.cross(pole, side), pole], axis=1)
    atlas = make_atlas("equirectangular", 1024)
    cut = unwrap(sphere, faces, atlas, rotation=turn)
    assert uv_error(cut, atlas, sphere, turn=turn).max() < 0.75 * atlas.texel_angle
    top = cut.uv[..., 1] > 1 - 1e-12
    assert top.any(), "the pole is a vertex"
    np.testing.assert_allclose(cut.sphere[cut.faces][top], np.repeat(pole[None], top.sum(), axis=0), atol=1e-9)
    touching = np.flatnonzero(top.any(axis=1))
    spread = np.linalg.norm(cut.sphere[cut.faces[touching]] - pole, axis=2).max(axis=1)
    assert spread.max() < 12 * atlas.texel_angle, "what a pole triangle cannot show is a few texels wide"
    assert len(np.unique(cut.uv[top][:, 0])) == top.sum() == len(touching), "each has its own longitude"


def test_a_coarse_mesh_costs_little_and_a_fine_one_next_to_nothing():
    for subdivisions, most in ((3, 12_000), (6, 90_000)):
        _, faces, sphere = ellipsoid(subdivisions, seed=1)
        cut = unwrap(sphere, faces, make_atlas("equirectangular", 2048))
        assert len(faces) < len(cut.faces) < most


def test_the_seam_can_be_anywhere():
    _, faces, sphere = ellipsoid(2, seed=5)
    for degrees in (-180.0, -91.5, 0.0, 33.0, 179.0):
        atlas = make_atlas("equirectangular", 512, seam=np.deg2rad(degrees))
        cut = unwrap(sphere, faces, atlas)
        assert uv_error(cut, atlas, sphere).max() < 0.75 * atlas.texel_angle
        left = np.unique(cut.faces[cut.uv[..., 0] == 0.0])
        assert len(left) > 3
        lon = np.arctan2(cut.sphere[left, 1], cut.sphere[left, 0])
        flat = np.abs(cut.sphere[left, 2]) < 1 - 1e-9
        assert np.abs(np.angle(np.exp(1j * (lon[flat] - np.deg2rad(degrees))))).max() < 1e-8


def test_folded_and_collapsed_maps_do_no_harm():
    """A map that is not one still gets finite coordinates inside the picture."""
    _, faces, sphere = ellipsoid(2, seed=8)
    rng = np.random.default_rng(0)
    folded = unit(sphere + 0.4 * rng.normal(size=sphere.shape))
    collapsed = sphere.copy()
    collapsed[:40] = [0, 0, 1]
    for bad in (folded, collapsed):
        for name in ATLASES:
            cut = unwrap(bad, faces, make_atlas(name, 64))
            assert np.isfinite(cut.uv).all() and cut.uv.min() >= -1e-12 and cut.uv.max() <= 1 + 1e-12


def test_same_answer_twice():
    _, faces, sphere = ellipsoid(2, seed=3)
    one, two = (unwrap(sphere, faces, make_atlas("cube", 256)) for _ in range(2))
    assert one.uv.tobytes() == two.uv.tobytes() and one.faces.tobytes() == two.faces.tobytes()


def test_insert_makes_a_vertex_once():
    _, faces, sphere = ellipsoid(1)
    mesh = CutMesh(sphere, faces)
    for _ in range(2):
        mesh.insert(sphere[5])
        mesh.insert(unit(sphere[faces[3, 0]] + sphere[faces[3, 1]]))
        mesh.insert(unit(sphere[faces[7]].sum(axis=0)))
    assert len(mesh.points) == len(sphere) + 2
    assert len(mesh.faces) == len(faces) + 2 + 2


def test_the_hidden_meridian_is_found():
    """A ball with one deep groove from pole to pole: the seam belongs at its bottom."""
    mesh = trimesh.creation.icosphere(subdivisions=4)
    sphere = unit(np.asarray(mesh.vertices))
    lon = np.arctan2(sphere[:, 1], sphere[:, 0])
    groove = np.exp(-((np.angle(np.exp(1j * (lon - 1.0))) / 0.25) ** 2)) * np.hypot(sphere[:, 0], sphere[:, 1])
    found = least_visible_meridian(sphere * (1 - 0.6 * groove)[:, None], np.asarray(mesh.faces), sphere)
    assert abs(found - 1.0) < 0.2


@pytest.mark.parametrize(
    ("size", "sides", "columns"),
    [
        (2048, (2048, 2048), 3),
        ((2048, 1024), (2048, 1024), 4),
        ((2040, 2040), (2040, 2040), 3),
        (2050, (2040, 1360), 3),
        ((2040, 1360), (2040, 1360), 3),
        (32, (32, 32), 3),
        ((32, 16), (32, 16), 4),
    ],
)
def test_a_cube_map_in_pictures_of_three_shapes(size, sides, columns):
    """Charts lie within the picture, apart from each other, and the directions of their texels come back."""
    atlas = make_atlas("cube", size)
    assert (atlas.width, atlas.height) == sides and atlas.columns == columns
    d = unit(np.random.default_rng(4).normal(size=(2000, 3)))
    uv, chart = atlas.uv(d), atlas.charts(d)
    np.testing.assert_allclose(atlas.uv_directions(uv, chart), d, atol=1e-12)
    texel = np.floor(uv * sides).astype(int)
    row = atlas.height - 1 - texel[:, 1]
    assert (texel[:, 0] < atlas.row_lengths[row]).all() and row.max() < 2 * atlas.cell
    cell = row // atlas.cell * columns + texel[:, 0] // atlas.cell
    np.testing.assert_array_equal(cell, chart)
    assert len(atlas.texels) == 6 * atlas.cell**2 and atlas.covered.all() == (6 * atlas.cell**2 == sides[0] * sides[1])


@pytest.mark.parametrize(
    ("name", "size", "message"),
    [
        ("mercator", 512, "equirectangular, cube, octahedral"),
        ("cube", 5, "16 to 32768"),
        ("octahedral", (64, 64), "width only"),
        ("cube", (64, 48), "square of at least 32"),
        ("cube", (40, 20), "multiple of 16"),
        ("cube", (16, 16), "square of at least 32"),
        ("octahedral", 70000, "16 to 32768"),
        ("equirectangular", "big", "a whole number from 16 to 32768"),
        ("cube", 128.5, "a whole number from 16 to 32768"),
    ],
)
def test_bad_atlases_are_named(name, size, message):
    with pytest.raises(OmtwarpError, match=message):
        make_atlas(name, size)
