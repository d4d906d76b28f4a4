"""Baking to pictures and back, against the functions themselves and against plain NumPy."""

import numpy as np
import pytest
from texturing_shapes import ellipsoid, texel_directions, unit

from omtwarp.errors import OmtwarpError
from omtwarp.texturing import VertexValues, bake, bake_to_uv, bake_vertex_values, pattern, sample, texture
from omtwarp.texturing.atlas import ATLASES, make_atlas


def smooth(d):
    """A smooth function on the sphere with two channels in about -1..1."""
    x, y, z = d.T
    return np.column_stack([0.5 * x * y + 0.4 * z, 0.5 * np.sin(2 * x + z)])


def directions(count=20_000, seed=0):
    """Evenly spread directions and the awkward ones: axes, cube corners, the date line."""
    d = unit(np.random.default_rng(seed).normal(size=(count, 3)))
    poles, sides = [[0, 0, 1], [0, 0, -1]], [[1, 0, 0], [-1, 0, 0], [0, -1, 0]]
    corners, date_line = [[1, 1, 1], [-1, 1, -1], [1, -1, 0]], [[-1, -1e-12, 0.3]]
    return np.concatenate([d, unit(np.array(poles + sides + corners + date_line, dtype=float))])


@pytest.mark.parametrize("name", ATLASES)
def test_round_trip_at_ordinary_size(name, device):
    d = directions()
    picture = bake(smooth, name, size=1024, device=device)
    assert picture.dtype == np.float32 and picture.shape[2] == 2
    assert np.abs(sample(picture, d, name, device=device) - smooth(d)).max() < 1e-2
    back = bake(lambda d: sample(picture, d, name, device=device), size=512, device=device)
    expected = smooth(texel_directions(512, 256).reshape(-1, 3)).reshape(back.shape)
    assert np.abs(back - expected).max() < 1e-2


@pytest.mark.slow
@pytest.mark.parametrize("name", ATLASES)
def test_round_trip_at_8k(name):
    """A picture 8192 texels wide gives the function back within 1e-3, supersampled or not."""
    d = directions(200_000)
    picture = bake(lambda n: 0.5 * n[:, 0] * n[:, 1] + 0.4 * n[:, 2], name, size=8192, supersample=1)
    error = np.abs(sample(picture, d, name)[:, 0] - (0.5 * d[:, 0] * d[:, 1] + 0.4 * d[:, 2])).max()
    assert error < 1e-3


@pytest.mark.parametrize("name", ATLASES)
def test_the_error_falls_with_the_size(name):
    """Second order for the equirectangular and the cube map; the folds of the octahedron leave first order."""
    d = directions()
    errors = [np.abs(sample(bake(smooth, name, size=n), d, name) - smooth(d)).max() for n in (192, 768)]
    assert errors[1] < errors[0] / (12 if name != "octahedral" else 3.5)


@pytest.mark.parametrize("name", ATLASES)
def test_kernels_agree_with_the_atlas(name):
    """Texel directions of the kernels against the atlas in NumPy, in the middle of every chart."""
    atlas = make_atlas(name, 240, seam=1.1) if name == "equirectangular" else make_atlas(name, 240)
    picture = bake(lambda n: n, atlas, supersample=1)
    d = directions(5000)
    uv = atlas.uv(d)
    column = np.clip((uv[:, 0] * atlas.width).astype(int), 0, atlas.width - 1)
    row = np.clip(((1 - uv[:, 1]) * atlas.height).astype(int), 0, atlas.height - 1)
    centre = np.column_stack([(column + 0.5) / atlas.width, 1 - (row + 0.5) / atlas.height])
    expected = atlas.uv_directions(centre, atlas.charts(d))
    inside = np.arccos(np.clip((expected * d).sum(axis=1), -1, 1)) < 3 * atlas.texel_angle
    assert inside.all()
    same = atlas.charts(expected) == atlas.charts(d)
    np.testing.assert_allclose(picture[row, column][same], expected[same], atol=1e-6)


@pytest.mark.parametrize("name", ["cube", "octahedral"])
def test_gutters_show_what_lies_beyond(name):
    """Bilinear samples next to a border see the truth on both sides: the error there is that of the inside."""
    atlas = make_atlas(name, 300)
    picture = bake(lambda n: n, atlas, supersample=1)
    uv = atlas.uv(directions(40_000))
    texels = np.column_stack([uv[:, 0] * atlas.width, (1 - uv[:, 1]) * atlas.height])
    low = np.floor(texels - 0.5).astype(int)
    d = atlas.uv_directions(uv, atlas.charts(directions(40_000)))
    for dx in (0, 1):
        for dy in (0, 1):
            corner = picture[np.clip(low[:, 1] + dy, 0, atlas.height - 1), np.clip(low[:, 0] + dx, 0, atlas.width - 1)]
            assert np.linalg.norm(corner - d, axis=1).max() < 5 * atlas.texel_angle


def test_supersampling_is_the_mean_over_the_texel():
    """A supersampled texel is NumPy's average of 8 x 8 samples."""
    fine = bake("circles", "equirectangular", size=1024, supersample=1).reshape(64, 8, 128, 8, 3).mean(axis=(1, 3))
    coarse = bake("circles", "equirectangular", size=128, supersample=8)
    assert np.abs(coarse - fine).max() < 0.04
    hard = bake("circles", "equirectangular", size=128, supersample=1)
    assert np.abs(hard - fine).max() > 0.2


def test_a_picture_is_a_source_and_goes_around_the_sphere():
    """Bilinear across the date line and over the poles, against the function the picture was made of."""
    d = texel_directions(512, 256)
    picture = (0.5 + 0.3 * d[..., :1] * d[..., 1:2] + 0.1 * d[..., 2:]).astype(np.float32).repeat(3, axis=2)
    for name in ATLASES:
        baked = bake(picture, name, size=384)
        assert baked.shape[2] == 3
        n = directions(4000)
        expected = 0.5 + 0.3 * n[:, 0] * n[:, 1] + 0.1 * n[:, 2]
        assert np.abs(sample(baked, n, name)[:, 0] - expected).max() < 4e-3


def test_sinusoidal_pictures_are_read_along_their_parallels():
    """A vertical stripe stays at u = 0.5 + longitude cos(latitude) / 2 pi."""
    ramp = np.broadcast_to((np.arange(400) + 0.5)[None, :, None] / 400, (200, 400, 3)).astype(np.float32)
    baked = bake(ramp, "equirectangular", size=256, projection="sinusoidal", supersample=2)
    lon = ((np.arange(256) + 0.5) / 256 - 0.5) * 2 * np.pi
    lat = (0.5 - (np.arange(128) + 0.5) / 128) * np.pi
    expected = 0.5 + lon[None, :] * np.cos(lat)[:, None] / (2 * np.pi)
    np.testing.assert_allclose(baked[..., 0], expected, atol=3e-3)


def two_triangle_charts(faces):
    """Own texture coordinates: every face in a small triangle of its own, as lightmappers do."""
    side = int(np.ceil(np.sqrt(len(faces))))
    k = np.arange(len(faces))
    corner = np.array([[0.1, 0.1], [0.85, 0.1], [0.1, 0.85]])
    return (np.stack([k % side, k // side], axis=1)[:, None, :] + corner) / side


def test_texels_have_one_owner_and_padding_goes_outward():
    """Coverage against an exact test of every texel centre; dilation fills rings, -1 everything."""
    faces = np.array([[0, 1, 2], [2, 1, 3]])
    uv = np.array([[0.2, 0.2], [0.8, 0.25], [0.25, 0.8], [0.82, 0.79]])
    sphere = unit(np.array([[1, 0, 0.1], [0, 1, 0.2], [0, 0, 1], [-1, 0.5, 0.3]]))
    one = bake_to_uv(lambda d: np.ones(len(d)), sphere, faces, uv, size=64, padding=0)[..., 0]
    y, x = np.mgrid[0:64, 0:64]
    px, py = (x + 0.5) / 64, 1 - (y + 0.5) / 64

    def inside(tri):
        sides = []
        for k in range(3):
            (ax, ay), (bx, by) = tri[k], tri[(k + 1) % 3]
            sides.append((bx - ax) * (py - ay) - (by - ay) * (px - ax))
        return np.all(np.array(sides) >= 0, axis=0) | np.all(np.array(sides) <= 0, axis=0)

    expected = inside(uv[faces[0]]) | inside(uv[faces[1]])
    np.testing.assert_array_equal(one > 0, expected)
    grown = bake_to_uv(lambda d: np.ones(len(d)), sphere, faces, uv, size=64, padding=2)[..., 0]
    assert np.all(grown[expected] == 1) and np.count_nonzero(grown) > np.count_nonzero(expected)
    assert bake_to_uv(lambda d: np.ones(len(d)), sphere, faces, uv, size=64, padding=-1).min() == 1


@pytest.mark.parametrize("name", ATLASES)
def test_values_at_vertices(name):
    """A function at the vertices comes back at the directions of the vertices, and linear in between."""
    _, faces, sphere = ellipsoid(4, seed=9)
    values = np.column_stack([sphere[:, 0], sphere[:, 1] * sphere[:, 2]])
    picture = bake_vertex_values(values, sphere, faces, name, size=768)
    got = sample(picture, sphere, name)
    assert np.abs(got - values).max() < 6e-3
    own = bake_to_uv(VertexValues(values), sphere, faces, two_triangle_charts(faces), size=1024)
    assert own.shape == (1024, 1024, 2) and np.isfinite(own).all()
    assert own.max() <= values.max() + 0.05


def test_bake_is_the_same_twice():
    one, two = (bake("puzzle", "cube", size=120) for _ in range(2))
    assert one.tobytes() == two.tobytes()


def test_rotating_the_texture_moves_it_as_the_matrix_says():
    """A texture that is red around +x, turned so that +x goes to +z, is red at the map's north pole."""
    vertices, faces, sphere = ellipsoid(3, strength=0.0)
    picture = np.zeros((64, 128, 3), dtype=np.uint8)
    picture[24:40, 56:72] = [255, 0, 0]
    turned = texture((vertices, faces, sphere), picture, rotate=(0, -90, 0), atlas="octahedral", size=256)
    places = turned.layout.cut.sphere
    red = sample(turned.image, places @ turned.layout.rotation, "octahedral")[:, 0]
    assert red[places[:, 2] > 0.95].min() > 0.9 and red[places[:, 0] > 0.8].max() < 0.1


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: bake("checker", "mercator"), "equirectangular, cube, octahedral"),
        (lambda: bake("checker", projection="mercator"), "equirectangular, sinusoidal"),
        (lambda: bake(lambda d: d[:5]), "directions"),
        (lambda: bake("nowhere.png"), "no such file"),
        (lambda: bake("checker", device="gpu"), "unknown device"),
        (lambda: sample(np.zeros((30, 31, 1)), [[0, 0, 1]], "cube"), "a cube map is"),
        (lambda: bake_vertex_values([1.0, np.nan], np.eye(3), [[0, 1, 2]]), "finite"),
        (lambda: bake_vertex_values([1.0, 2.0], np.eye(3), [[0, 1, 2]]), "2 given"),
        (lambda: bake_to_uv("checker", np.eye(3), [[0, 1, 2]], np.zeros((3, 3))), "texture coordinates"),
        (lambda: bake_to_uv("checker", np.eye(3), [[0, 1, 2]], np.zeros((2, 2))), r"shape \[2, 2\]: give \[V, 2\]"),
        (lambda: bake_to_uv("checker", np.eye(3), [[0, 1, 2]], np.full((3, 2), np.inf)), "not finite"),
        (lambda: bake_to_uv("checker", np.eye(3), [[0, 1, 2]], np.zeros((3, 2)), size=0), "1 to 32768"),
    ],
)
def test_bad_requests_are_named(call, message):
    with pytest.raises(OmtwarpError, match=message):
        call()


def test_patterns_take_any_device(device):
    d = directions(100)
    np.testing.assert_allclose(pattern("globe")(d, device=device), pattern("globe")(d), atol=1e-9)


def test_directions_and_maps_that_are_not_finite_are_refused():
    """Texels of what is not finite lie outside of the picture: reading them ended the process."""
    picture, wrong = np.zeros((16, 32, 3), np.uint8), np.full((5, 3), np.nan)
    for directions in (wrong, np.ones((5, 2)), "abc", [[0.0], [1.0, 2.0]]):
        with pytest.raises(OmtwarpError, match="directions: "):
            sample(picture, directions, device="cpu")
    faces, uv = [[0, 1, 2]], np.eye(5, 2)
    for sphere in (wrong, np.ones((5, 2)), "abc"):
        with pytest.raises(OmtwarpError, match="sphere: "):
            bake_to_uv(picture, sphere, faces, uv, size=16, device="cpu")
    for rotation in (np.eye(2), wrong, "abc"):
        with pytest.raises(OmtwarpError, match="rotation: "):
            bake_to_uv(picture, np.eye(5, 3) + 1, faces, uv, size=16, rotation=rotation, device="cpu")


def test_what_is_no_map_values_or_number_of_samples_is_refused():
    """Complex numbers, text, NaN and ragged rows were taken in part, or ended in errors of NumPy's."""
    points, faces = np.eye(4, 3) + 1.0, [[0, 1, 2]]
    for wrong in (np.full((4, 3), np.nan), points * 1j, "abc", points[:, :2], [[1.0], [1.0, 2.0]]):
        with pytest.raises(OmtwarpError, match="sphere: "):
            bake_vertex_values(np.ones(4), wrong, faces, "cube", size=64, device="cpu")
        with pytest.raises(OmtwarpError, match="faces: "):
            bake_vertex_values(np.ones(4), points, wrong, "cube", size=64, device="cpu")
    for values in ([], "abc", [[1.0], [1.0, 2.0]], np.ones(4) * 1j, np.full(4, np.nan)):
        with pytest.raises(OmtwarpError, match="values at vertices"):
            VertexValues(values)
    for samples in (np.nan, "x", None, 0, 2**31, True):
        with pytest.raises(OmtwarpError, match="supersample: must be a whole number from 1 to 1024"):
            bake(pattern("checker"), "cube", size=64, supersample=samples, device="cpu")
    for seam in (np.nan, np.inf, "x", None, [1.0]):
        with pytest.raises(OmtwarpError, match="seam: must be a finite number"):
            make_atlas("equirectangular", 64, seam=seam)
    for size in (np.array("x"), "64", (64, 32, 16), {}, 64.5, np.ones((2, 2))):
        with pytest.raises(OmtwarpError, match="texture size"):
            make_atlas("equirectangular", size)
    for uv in ("abc", np.ones((4, 2)) * 1j, [[1.0], [1.0, 2.0]]):
        with pytest.raises(OmtwarpError, match="texture coordinates: must be"):
            bake_to_uv(np.zeros((16, 32, 3), np.uint8), points, faces, uv, size=16, device="cpu")
