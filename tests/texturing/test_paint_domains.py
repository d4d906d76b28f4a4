"""Pictures and bakes through maps to a torus and of several parts, looked up again at points of the surface."""

import numpy as np
import pytest
import trimesh

import omtwarp
from omtwarp.colors import colormap_table
from omtwarp.errors import OmtwarpError
from omtwarp.mesh.surface import plane_areas
from omtwarp.texturing import Material, paint, read_painted_mesh, unwrap_uv
from omtwarp.texturing.bakes import area_ratio
from omtwarp.texturing.patterns.checker import Checker


@pytest.fixture(scope="module")
def ring() -> omtwarp.MapResult:
    mesh = trimesh.creation.torus(1.0, 0.4, major_sections=32, minor_sections=16)
    return omtwarp.map_surface(mesh, domain="torus")


@pytest.fixture(scope="module")
def parts() -> omtwarp.MapResult:
    """Two balls, one within the other's reach, the second of a quarter of the area."""
    ball = omtwarp.shapes.icosphere(16)
    points = np.concatenate([ball.vertices, 0.5 * ball.vertices + (1.8, 0.0, 0.0)])
    faces = np.concatenate([ball.faces, ball.faces + len(ball.vertices)])
    return omtwarp.map_surface((points, faces), domain="sphere", components=True, device="cpu", until="conformal")


def draw(mesh, count: int = 4000):
    """Random points of a mesh: their triangles, and their shares of the corners."""
    rng = np.random.default_rng(0)
    return rng.integers(len(mesh.faces), size=count), rng.dirichlet((2, 2, 2), count)


def looked_up(mesh, count: int = 4000):
    """Random points of a painted mesh in space, and the colours that its first material has there."""
    chosen, weights = draw(mesh, count)
    points = np.einsum("fk,fkj->fj", weights, mesh.vertices[mesh.faces[chosen]])
    uv = np.einsum("fk,fkj->fj", weights, mesh.uv[chosen])
    picture = mesh.materials[0].picture
    height, width = picture.shape[:2]
    column = np.floor((uv[:, 0] % 1.0) * width).astype(int) % width
    row = np.floor((-uv[:, 1] % 1.0) * height).astype(int) % height
    return points, picture[row, column].astype(float)


def corner_colours(mesh):
    """Colours of the picture at the corners of all triangles, a fiftieth of the way to the middle, [F, 3, 3]."""
    inwards = 0.98 * mesh.uv + 0.02 * mesh.uv.mean(axis=1, keepdims=True)
    picture = mesh.materials[0].picture
    height, width = picture.shape[:2]
    column = np.floor((inwards[..., 0] % 1.0) * width).astype(int) % width
    row = np.floor((-inwards[..., 1] % 1.0) * height).astype(int) % height
    return picture[row, column].astype(float)


@pytest.mark.parametrize(
    ("kind", "options"),
    [
        ("ring", {"uv": "own"}),
        ("ring", {"uv": "atlas"}),
        ("parts", {"uv": "own"}),
        ("parts", {"uv": "atlas"}),
        ("parts", {"uv": "atlas", "atlas": "octahedral"}),
        ("parts", {"uv": "atlas", "atlas": "equirectangular"}),
    ],
)
def test_data_baked_are_found_at_the_vertices(request, tmp_path, kind, options):
    """The picture has the colour of a vertex at the vertex, and between vertices that of the value there."""
    result = request.getfixturevalue(kind)
    height = result.vertices @ (0.3, 0.5, 0.8)
    np.save(tmp_path / "height.npy", height)
    mesh = unwrap_uv(result) if options["uv"] == "own" else None
    made = paint(result, mesh, bake=[tmp_path / "height.npy"], size=1024, device="cpu", **options)
    table = colormap_table("viridis").astype(float)
    low, high = height.min(), height.max()

    def expected(points):
        return table[np.rint((points @ (0.3, 0.5, 0.8) - low) / (high - low) * 255).astype(int)]

    points, found = looked_up(made)
    assert np.percentile(np.abs(found - expected(points)), 99.5) < 8
    assert np.percentile(np.abs(corner_colours(made) - expected(made.vertices)[made.faces]), 99.5) < 12
    made.export(tmp_path / "made.glb")
    again = read_painted_mesh(tmp_path / "made.glb")
    points, found = looked_up(again)
    assert np.percentile(np.abs(found - expected(points)), 99.5) < 8


@pytest.mark.parametrize("uv", ["own", "atlas"])
def test_checker_on_a_torus_is_that_of_its_texture(ring, uv):
    mesh = unwrap_uv(ring) if uv == "own" else None
    made = paint(ring, mesh, pattern="checker", uv=uv, size=1024, device="cpu")
    _, found = looked_up(made)
    shown = omtwarp.texture(ring, pattern="checker")
    face, share = draw(made)
    at = np.einsum("fk,fkj->fj", share, ring.corners[face]) % 1.0
    high, wide = shown.image.shape[:2]
    wanted = shown.image[((1.0 - at[:, 1]) * high).astype(int) % high, (at[:, 0] * wide).astype(int) % wide]
    wrong = np.abs(found[:, :3] - wanted).max(axis=1) > 60
    assert wrong.mean() < 0.03, "only next to the borders of fields"
    if uv == "atlas":  # the coordinates that texture() writes, with triangles that reach over the border
        assert made.uv.max() > 1.0 and made.uv.min() >= 0.0
        np.testing.assert_allclose(made.uv, shown.uv, atol=1e-12)


@pytest.mark.parametrize("atlas", ["cube", "octahedral", "equirectangular"])
def test_pattern_lies_on_every_part(parts, atlas):
    """With a bake, both balls have the whole pattern, each on its own tile, the smaller one's in proportion."""
    made = paint(parts, pattern=Checker(8, 4), bake=["ao"], uv="atlas", atlas=atlas, size=1024, device="cpu")
    points, found = looked_up(made, 8000)
    small = points[:, 0] > 1.2
    directions = np.where(small[:, None], (points - (1.8, 0.0, 0.0)) / 0.5, points)
    turn, *_ = np.linalg.lstsq(parts.vertices[:100], parts.sphere[:100], rcond=None)
    around = [Checker(8, 4)(directions @ turn + shift) for shift in 0.05 * np.concatenate([np.eye(3), -np.eye(3)])]
    inside = (np.ptp(around, axis=0) == 0).all(axis=1)  # not next to the border of a field
    wrong = np.abs(found[:, :3] - 255 * around[0]).max(axis=1) > 60
    assert inside[small].mean() > 0.5 and wrong[small & inside].mean() < 0.002 and wrong[~small & inside].mean() < 0.002
    of_small = (made.vertices[made.faces].mean(axis=1)[:, 0] > 1.2).astype(int)
    covered = np.bincount(of_small, plane_areas(made.uv))
    assert covered[1] / covered[0] == pytest.approx(0.25, abs=0.04)  # the sides of tiles are multiples of 48 texels
    low, high = ([reach(made.uv[of_small == k].reshape(-1, 2), axis=0) for k in (0, 1)] for reach in (np.min, np.max))
    assert (high[0] < low[1]).any() or (high[1] < low[0]).any()  # the tiles lie apart
    occlusion = made.materials[0].occlusion_picture
    assert occlusion.min() < 160 < 240 < np.median(occlusion)  # the balls darken each other


def test_area_of_parts_is_compared_within_each(parts):
    own = area_ratio(parts.vertices, parts.faces, np.ones(len(parts.faces)), parts.part)
    both = area_ratio(parts.vertices, parts.faces, np.ones(len(parts.faces)))
    first, second = (np.unique(parts.faces[parts.part == k]) for k in (0, 1))
    np.testing.assert_allclose(own[first], own[second], rtol=1e-9)
    np.testing.assert_allclose(both[second] / both[first], 4.0, rtol=1e-9)


def test_materials_are_kept_under_a_pattern_on_a_torus(ring):
    mesh = unwrap_uv(ring)
    red = Material("red", (1.0, 0.0, 0.0, 1.0))
    own = omtwarp.PaintedMesh(mesh.vertices, mesh.faces, mesh.uv, (red,))
    made = paint(ring, own, pattern="checker", keep="over", opacity=0.0, uv="atlas", size=64, device="cpu")
    assert made.materials[0].name == "red" and (made.materials[0].picture[..., :3] == (255, 0, 0)).all()
    made = paint(ring, own, pattern="checker", keep="over", opacity=1.0, uv="atlas", size=64, device="cpu")
    assert np.abs(made.materials[0].picture.astype(int)[..., :3] - (255, 0, 0)).max(axis=2).mean() > 60


def test_normals_of_the_same_mesh_are_straight_up(ring):
    detail = (ring.vertices, ring.faces)
    made = paint(ring, bake=["normal"], detail=detail, uv="atlas", size=128, device="cpu")
    off = np.abs(made.materials[0].normal_picture.astype(int) - (128, 128, 255)).max(axis=2)
    assert np.percentile(off, 99) < 12 and made.materials[0].own_tangents


@pytest.mark.parametrize(
    ("kind", "options", "message"),
    [
        ("ring", {"atlas": "octahedral"}, "projection, atlas, rotation and seam are for textures on the sphere"),
        ("ring", {"rotate": [10.0]}, "projection, atlas, rotation and seam are for textures on the sphere"),
        ("ring", {"pattern": Checker(4, 2)}, "a Pattern is for the sphere"),
        ("ring", {"pattern": "globe"}, "is for the sphere"),
        ("parts", {"size": 96}, "a picture of 96 x 96 texels has no room for 2 parts"),
        ("parts", {"atlas": "square"}, "unknown atlas 'square'"),
    ],
)
def test_mistakes_are_one_line(request, kind, options, message):
    with pytest.raises(OmtwarpError, match=message):
        paint(request.getfixturevalue(kind), uv="atlas", bake=["ao"], device="cpu", **options)
