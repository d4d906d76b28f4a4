"""Texture coordinates through maps to other domains than one sphere: charts lie apart, with areas in proportion."""

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

import omtwarp
from omtwarp.device.start import wp
from omtwarp.errors import OmtwarpError
from omtwarp.mesh.surface import plane_areas, triangle_areas
from omtwarp.texturing.baking import covered, overlap
from omtwarp.texturing.unwrap import MARGIN, laid_out, pack_rows, unwrap_uv


@pytest.fixture(scope="module")
def ring() -> omtwarp.MapResult:
    """A ring four times as long as it is thick, mapped to a torus."""
    mesh = trimesh.creation.torus(1.0, 0.25, major_sections=48, minor_sections=12)
    return omtwarp.map_surface(mesh, domain="torus")


@pytest.fixture(scope="module")
def blobs() -> tuple[np.ndarray, np.ndarray]:
    """Three bodies, the second of them open, of areas that differ by up to nine times."""
    vertices, faces = [], []
    for number, size in enumerate((1.0, 0.6, 0.33)):
        blob = omtwarp.shapes.blob(seed=number, sphere=1280)
        triangles = blob.faces[1:] if number == 1 else blob.faces
        faces.append(triangles + sum(map(len, vertices)))
        vertices.append(size * blob.vertices + (3.0 * number, 0.0, 0.0))
    return np.concatenate(vertices), np.concatenate(faces)


@pytest.fixture(scope="module")
def parts(blobs) -> omtwarp.MapResult:
    return omtwarp.map_surface(blobs, domain="sphere", components=True, device="cpu")


def open_blob() -> tuple[np.ndarray, np.ndarray]:
    blob = omtwarp.shapes.blob(seed=3, sphere=1280)
    used, faces = np.unique(blob.faces[(blob.vertices[blob.faces, 2] > -0.3).all(axis=1)], return_inverse=True)
    return blob.vertices[used], faces.reshape(-1, 3)


def shares(result, mesh) -> np.ndarray:
    """Each triangle's share of the charts over its share of the surface."""
    on_picture, on_surface = plane_areas(mesh.uv), triangle_areas(result.vertices, result.faces)
    return (on_picture / on_picture.sum()) / (on_surface / on_surface.sum())


def assert_apart(result, mesh, aspect: float = 1.0) -> float:
    """Assert that triangles lie in the picture, upright, and none on another; return the share that they cover."""
    assert np.array_equal(mesh.faces, result.faces) and np.array_equal(mesh.vertices, result.vertices)
    assert mesh.uv.min() > 0.0 and mesh.uv.max() < 1.0 and plane_areas(mesh.uv).min() > 0.0
    size = (1024, round(1024 / aspect))
    assert overlap(mesh.uv, *size, wp.get_device("cpu")) == 0.0
    part = float(covered(mesh.uv, size, padding=0, device=wp.get_device("cpu")).mean())
    assert part == pytest.approx(plane_areas(mesh.uv).sum(), rel=0.02)
    return part


def shape_of(mesh, aspect: float) -> np.ndarray:
    """Squares of the sides of triangles on the picture, in heights of it, shape [F, 3]."""
    places = mesh.uv * (aspect, 1.0)
    return ((np.roll(places, -1, axis=1) - places) ** 2).sum(axis=2)


@pytest.mark.parametrize("aspect", [1.0, 4.0])
def test_torus_is_cut_into_strips_that_keep_the_shape_of_its_map(ring, aspect):
    mesh, charts = laid_out(ring, aspect=aspect)
    assert assert_apart(ring, mesh, aspect) > 0.5 and charts == (2 if aspect == 1.0 else 1)
    corners = ring.corners @ ring.lattice
    flat = ((np.roll(corners, -1, axis=1) - corners) ** 2).sum(axis=2)
    scale = shape_of(mesh, aspect) / flat
    np.testing.assert_allclose(scale, scale.mean(), rtol=1e-9)  # turned and shrunk, neither sheared nor mirrored
    ratio = shares(ring, mesh)
    on_torus = plane_areas(corners) / plane_areas(corners).sum()
    own = triangle_areas(ring.vertices, ring.faces)
    np.testing.assert_allclose(ratio, on_torus / (own / own.sum()), rtol=1e-9)


def test_exact_torus_has_exact_shares():
    mesh = trimesh.creation.torus(1.0, 0.4, major_sections=16, minor_sections=8)
    result = omtwarp.map_surface(mesh, domain="torus", exact=True)
    laid = unwrap_uv(result)
    assert_apart(result, laid)
    on_picture = np.bincount(result.face_origin, plane_areas(laid.uv))
    own = np.bincount(result.face_origin, triangle_areas(result.vertices, result.faces))
    np.testing.assert_allclose(on_picture / on_picture.sum(), own / own.sum(), rtol=1e-5)


def test_parts_lie_side_by_side_in_proportion(parts):
    mesh, charts = laid_out(parts)
    assert assert_apart(parts, mesh) > 0.45 and charts == 18
    on_picture = np.bincount(parts.part, plane_areas(mesh.uv))
    own = np.bincount(parts.part, triangle_areas(parts.vertices, parts.faces))
    np.testing.assert_allclose(on_picture / on_picture.sum(), own / own.sum(), rtol=0.01)
    ratio = shares(parts, mesh)
    assert ratio.max() / ratio.min() < 3.0  # 1.6 of the cube, and what a map of 1,280 faces leaves


def test_disk_is_one_chart():
    result = omtwarp.map_surface(open_blob(), domain="disk", device="cpu")
    mesh, charts = laid_out(result)
    assert charts == 1 and assert_apart(result, mesh) > 0.7
    at = np.empty((len(result.vertices), 2))
    at[result.faces] = mesh.uv
    assert np.array_equal(at[result.faces], mesh.uv)  # no vertex is in two places
    scaled = (at - at.mean(axis=0)) / np.ptp(at, axis=0)
    disk = (result.disk - result.disk.mean(axis=0)) / np.ptp(result.disk, axis=0)
    np.testing.assert_allclose(scaled, disk, atol=1e-12)


def test_hemisphere_fills_more_than_its_cells():
    result = omtwarp.map_surface(open_blob(), domain="hemisphere", device="cpu")
    mesh, charts = laid_out(result)
    assert charts == 5 and assert_apart(result, mesh) > 0.35  # 0.25 in three by two cells


def test_margins_that_leave_no_room_are_refused(parts):
    with pytest.raises(OmtwarpError, match=r"a margin of 0\.1 leaves no room for 18 charts"):
        unwrap_uv(parts, margin=0.1)


def test_boxes_on_shelves_lie_apart():
    rng = np.random.default_rng(3)
    for count in (1, 7, 60):
        sizes = rng.uniform(0.1, 1.0, (count, 2))
        for width in (1.0, 2.5):
            corner, scale = pack_rows(sizes, width, MARGIN)
            low, high = corner - 0.999 * MARGIN, corner + scale * sizes + 0.999 * MARGIN
            assert low.min() > 0.0 and (high < (width, 1.0)).all()
            apart = (low[:, None] >= high[None]).any(axis=2) | (high[:, None] <= low[None]).any(axis=2)
            assert (apart | np.eye(count, dtype=bool)).all()
            assert (scale * sizes).prod(axis=1).sum() > (0.4 if count > 1 else 0.1) * width


def test_a_picture_on_a_torus_has_the_size_asked_for(ring):
    picture = np.zeros((40, 100, 3), dtype=np.uint8)
    assert omtwarp.texture(ring, picture).materials[0].picture.shape == (40, 100, 3)
    assert omtwarp.texture(ring, picture, size=50).materials[0].picture.shape == (20, 50, 3)
    for size in (-5, 0, True, 51.5):
        with pytest.raises(OmtwarpError, match="texture size"):
            omtwarp.texture(ring, picture, size=size)


def test_parts_on_one_sphere_have_charts_of_their_own(blobs):
    together = omtwarp.map_surface(blobs, together=True, device="cpu", until="conformal")
    mesh, _ = laid_out(together, aspect=1.5, margin=0.02)
    assert_apart(together, mesh, 1.5)
    corners = mesh.uv * (1.5, 1.0)
    points = [corners[together.part == k].reshape(-1, 2) for k in range(3)]
    for k in range(3):
        others = cKDTree(np.concatenate([points[n] for n in range(3) if n != k]))
        assert others.query(points[k])[0].min() > 0.999 * 2 * 0.02


@pytest.mark.parametrize("exponent", [-300, -160, 100, 300])
def test_any_unit_gives_the_same_charts(exponent):
    """Areas of coordinates of 1e±160 are beyond float64; charts of equal density are not."""
    ball = omtwarp.shapes.icosphere(8)
    plain, scaled = (unwrap_uv((ball.vertices * unit, ball.faces, ball.vertices)) for unit in (1.0, 10.0**exponent))
    np.testing.assert_allclose(scaled.uv, plain.uv, atol=1e-9)
