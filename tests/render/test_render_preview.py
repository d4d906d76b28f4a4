"""Pictures against what analytic geometry says must be in them, with both renderers."""

from __future__ import annotations

import functools
import importlib.util
import os
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from PIL import Image

from omtwarp.colors import to_linear
from omtwarp.errors import OmtwarpError
from omtwarp.maps.result import MapResult
from omtwarp.render import (
    Arrows,
    Camera,
    ScalarField,
    SurfaceView,
    Wireframe,
    comparison,
    gl_client,
    map_view,
    preview,
    sheet,
)
from omtwarp.render.camera import SIX_VIEWS, VIEWS, frame

DARK, LIGHT = np.array([40, 90, 160]), np.array([240, 225, 205])
COLUMNS, ROWS = 24, 12


def _has_opengl() -> bool:
    try:
        gl_client.prepare()
        preview((np.eye(3), np.array([[0, 1, 2]])), size=(16, 16), backend="pyrender")
    except OmtwarpError:
        return False
    return True


@pytest.fixture(scope="session")
def opengl() -> bool:
    return importlib.util.find_spec("pyrender") is not None and _has_opengl()


@pytest.fixture(params=["pyrender", "warp"])
def backend(request: pytest.FixtureRequest, opengl: bool) -> str:
    """Both renderers; without OpenGL the first is skipped, but not in continuous integration, which must have it."""
    if request.param == "pyrender" and not opengl and not os.environ.get("CI"):
        pytest.skip("no OpenGL on this machine")
    return request.param


@pytest.fixture
def both(opengl: bool) -> tuple[str, str]:
    if not opengl and not os.environ.get("CI"):
        pytest.skip("no OpenGL on this machine")
    return ("pyrender", "warp")


def checker() -> np.ndarray:
    row, column = np.indices((ROWS * 32, COLUMNS * 32)) // 32
    return np.where(((row + column) % 2)[..., None] == 1, LIGHT, DARK).astype(np.uint8)


def is_light(points: np.ndarray) -> np.ndarray:
    """The checker's analytic colour at points of any length around the origin."""
    lon, lat = np.arctan2(points[..., 1], points[..., 0]), np.arctan2(points[..., 2], np.hypot(*points[..., :2].T).T)
    column = np.floor((0.5 + lon / (2 * np.pi)) * COLUMNS).clip(0, COLUMNS - 1)
    row = np.floor((0.5 - lat / np.pi) * ROWS).clip(0, ROWS - 1)
    return (row + column) % 2 == 1


def globe(subdivisions: int = 5) -> SurfaceView:
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions)
    return SurfaceView(mesh.vertices, mesh.faces, image=checker(), sphere=mesh.vertices, up="z", front="+x")


def pixel_rays(view: SurfaceView, camera: Camera, size: int, offsets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Origin [3] and directions [size, size, K, 3] of rays through every pixel's centre moved by offsets [K, 2]."""
    (shot,) = frame(np.asarray(view.vertices), [camera], 1.0, up=view.up, front=view.front)
    row, column = np.indices((size, size))
    x = (2 * (column[..., None] + 0.5 + offsets[:, 0]) / size - 1) * shot.half_width
    y = (1 - 2 * (row[..., None] + 0.5 + offsets[:, 1]) / size) * shot.half_height
    ways = np.stack([x, y, -np.ones_like(x)], axis=-1) @ shot.pose[:3, :3].T
    return shot.pose[:3, 3], ways / np.linalg.norm(ways, axis=-1, keepdims=True)


def window(radius: float, count: int) -> np.ndarray:
    line = np.linspace(-radius, radius, count)
    return np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)


def assert_checker(
    picture: np.ndarray, light: np.ndarray, inside: np.ndarray, offsets: np.ndarray, least: float = 0.5
) -> None:
    """Pixels whose surroundings have one colour show it; all others show a mixture of the two, in the right parts.

    Args:
        picture: the rendered picture, [size, size, 3].
        light: the analytic colour at points in and around every pixel, bool [size, size, K].
        inside: pixels to look at.
        offsets: where those points lie, in pixels from the centre, [K, 2].
        least: share of the pixels whose colour must be certain, so that the test says something.
    """
    sure = inside & (light.all(axis=2) | ~light.any(axis=2))
    expected = np.where(light[..., :1], LIGHT, DARK)
    wrong = np.abs(picture.astype(int) - expected).max(axis=2) > 3
    assert not (wrong & sure).any(), f"{(wrong & sure).sum()} of {sure.sum()} pixels: {np.argwhere(wrong & sure)[:3]}"
    part = (picture.astype(float) - DARK) / (LIGHT - DARK)
    mixed = inside & ~sure
    assert np.ptp(part, axis=2)[mixed].max() < 0.35  # light is averaged, its encoding is not: channels part a little
    assert part[mixed].min() > -0.03 and part[mixed].max() < 1.03
    linear_dark, linear_light = to_linear(DARK / 255), to_linear(LIGHT / 255)
    share = ((to_linear(picture / 255.0) - linear_dark) / (linear_light - linear_dark)).mean(axis=2)
    expected_share = light[..., np.abs(offsets).max(axis=1) < 0.7].mean(axis=2)
    assert np.abs(share - expected_share)[mixed].mean() < 0.12
    assert sure.sum() > least * inside.sum()


@pytest.mark.parametrize("name", SIX_VIEWS)
def test_checker_on_a_sphere_from_six_sides(name: str, backend: str) -> None:
    """Seam (back), both poles (top, bottom) and all between agree with the analytic checker."""
    size, view = 192, globe()
    camera = Camera(*VIEWS[name])
    picture = np.asarray(preview(view, views=name, size=(size, size), light="flat", backend=backend))
    offsets = window(1.3, 7)
    origin, ways = pixel_rays(view, camera, size, offsets)
    along = -ways @ origin
    gap = along**2 - (origin @ origin - 1.0)
    hit = gap > 0
    points = origin + (along - np.sqrt(np.where(hit, gap, 0)))[..., None] * ways
    # Where the ray grazes the surface the facets' chords shift the point of impact noticeably.
    steep = -np.einsum("...i,...i->...", points, ways) > 0.25
    assert_checker(picture, is_light(points), (hit & steep).all(axis=2), offsets)


@functools.cache
def coarse_reference(size: int) -> tuple[SurfaceView, Camera, np.ndarray, np.ndarray, np.ndarray]:
    """A globe of 320 triangles seen near its pole, and where rays meet it, found triangle by triangle.

    Returns:
        The surface, the camera, the points [size, size, K, 3], the pixels to look at and the rays' offsets [K, 2].
    """
    view, camera = globe(2), Camera(20.0, 75.0)
    offsets = window(1.2, 5)
    origin, ways = pixel_rays(view, camera, size, offsets)
    points, depth = np.zeros_like(ways), np.full(ways.shape[:-1], np.inf)
    for a, b, c in np.asarray(view.vertices)[np.asarray(view.faces)]:
        normal = np.cross(b - a, c - a)
        if normal @ (origin - a) <= 0:
            continue
        t = ((a - origin) @ normal) / (ways @ normal)
        p = origin + t[..., None] * ways
        within = np.ones_like(t, dtype=bool)
        for one, other in ((a, b), (b, c), (c, a)):
            within &= (p - one) @ np.cross(normal, other - one) >= -1e-12
        nearer = within & (t < depth)
        points[nearer], depth[nearer] = p[nearer], t[nearer]
    middle = points[:, :, 12] / np.maximum(np.linalg.norm(points[:, :, 12], axis=-1, keepdims=True), 1e-9)
    steep = -np.einsum("...i,...i->...", middle, ways[:, :, 12]) > 0.3
    return view, camera, points, np.isfinite(depth).all(axis=2) & steep, offsets


def test_checker_on_a_coarse_mesh_at_the_pole(backend: str) -> None:
    """On 320 triangles a pole with texture coordinates at the corners would be a star; here it is none."""
    size = 112
    view, camera, points, inside, offsets = coarse_reference(size)
    picture = np.asarray(preview(view, camera=camera, size=(size, size), light="flat", backend=backend))
    assert_checker(picture, is_light(points), inside, offsets, least=0.25)


def test_number_of_cells_around_the_equator(backend: str) -> None:
    """Half the equator faces the camera: 12 of its 24 cells, counted as changes of colour along a row of pixels."""
    camera = Camera(7.5, 0.0, projection="orthographic")
    picture = np.asarray(preview(globe(), camera=camera, size=(256, 256), light="flat", backend=backend)).astype(int)
    # One row of cells above the equator, in its middle.
    row = picture[round(127.5 - 0.9 * 128 * np.sin(np.pi / 24)), 14:242]
    light = np.abs(row - LIGHT).sum(axis=1) < np.abs(row - DARK).sum(axis=1)
    assert (light[1:] != light[:-1]).sum() in (11, 12, 13)


@pytest.mark.parametrize("kind", ["image", "plain", "wireframe", "arrows"])
def test_both_renderers_draw_the_same_picture(kind: str, both: tuple[str, str]) -> None:
    """Camera, light, texture filter, lines and arrows agree to the eye."""
    mesh = trimesh.creation.torus(0.7, 0.3, major_sections=48, minor_sections=24)
    points = np.asarray(mesh.vertices)
    view = SurfaceView(points, mesh.faces, up="z")
    options: dict = {}
    if kind == "image":
        view = SurfaceView(
            points, mesh.faces, image=checker(), sphere=points / np.linalg.norm(points, axis=1)[:, None], up="z"
        )
    if kind == "wireframe":
        options["wireframe"] = True
    if kind == "arrows":
        options["arrows"] = np.cross([0, 0, 1], points)
    first, second = (
        np.asarray(preview(view, size=(256, 256), transparent=True, backend=name, **options)).astype(int)
        for name in both
    )
    covered = first[..., 3:] / 255.0
    gap = np.abs(first[..., :3] - second[..., :3]) * covered
    assert gap.mean() < 0.6
    assert (gap.max(axis=2) > 24).mean() < 0.005
    assert (np.abs(first[..., 3] - second[..., 3]) > 64).mean() < 0.002


def test_a_picture_twice_is_the_same_bits(backend: str) -> None:
    one, two = (np.asarray(preview(globe(3), size=(96, 96), backend=backend)) for _ in range(2))
    assert np.array_equal(one, two)


@pytest.mark.parametrize("scale", [1e-30, 1e30])
def test_size_and_place_of_the_mesh_do_not_matter(scale: float, backend: str) -> None:
    mesh = trimesh.creation.icosphere(subdivisions=2)
    vertices = np.asarray(mesh.vertices)
    plain = np.asarray(preview((vertices, mesh.faces), size=(64, 64), backend=backend)).astype(int)
    other = np.asarray(preview((vertices * scale, mesh.faces), size=(64, 64), backend=backend)).astype(int)
    assert np.abs(plain - other).max() <= 2


def test_texture_coordinates_put_the_image_the_right_way_round(backend: str, tmp_path) -> None:
    """A square with a picture of four colours, through a GLB file: upright, not mirrored, colours exact."""
    vertices = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    faces = [[0, 1, 2], [0, 2, 3]]
    pixels = np.zeros((64, 64, 3), np.uint8)
    pixels[:32, :32], pixels[:32, 32:], pixels[32:, :32], pixels[32:, 32:] = (
        (200, 0, 0),
        (0, 180, 0),
        (0, 0, 160),
        (90, 90, 90),
    )
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=Image.fromarray(pixels), metallicFactor=0.0)
    uv = (vertices[:, :2] + 1) / 2
    mesh = trimesh.Trimesh(
        vertices, faces, visual=trimesh.visual.TextureVisuals(uv=uv, material=material), process=False
    )
    file = tmp_path / "square.glb"
    mesh.export(file)
    picture = np.asarray(preview(file, views="front", size=(64, 64), light="flat", backend=backend)).astype(int)
    for (row, column), color in zip(
        [(16, 16), (16, 48), (48, 16), (48, 48)], pixels[[8, 8, 56, 56], [8, 56, 8, 56]], strict=True
    ):
        assert np.abs(picture[row, column] - color).max() <= 2


def test_texture_coordinates_per_corner(backend: str) -> None:
    """Two triangles that share an edge look up different ends of the image."""
    vertices = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    image = np.array([[[250, 10, 10], [10, 10, 250]]], np.uint8).repeat(8, axis=1)
    uv = np.zeros((2, 3, 2)) + np.array([0.25, 0.75])[:, None, None]
    picture = np.asarray(
        preview(
            SurfaceView(vertices, faces, image=image, uv=uv),
            views="front",
            size=(64, 64),
            light="flat",
            backend=backend,
        )
    )
    assert np.abs(picture[48, 48].astype(int) - [250, 10, 10]).max() <= 2
    assert np.abs(picture[16, 16].astype(int) - [10, 10, 250]).max() <= 2


@pytest.mark.parametrize("per", ["vertex", "face", "plain"])
def test_colors_are_shown_exactly_without_light(per: str, backend: str) -> None:
    box = trimesh.creation.box()
    color = np.array([37, 140, 221], np.uint8)
    colors = {"vertex": np.tile(color, (8, 1)), "face": np.tile(color, (12, 1)), "plain": None}[per]
    view = SurfaceView(box.vertices, box.faces, colors=colors, color=tuple(color / 255.0) if per == "plain" else None)
    picture = np.asarray(preview(view, size=(64, 64), light="flat", backend=backend)).astype(int)
    assert np.abs(picture[32, 32] - color).max() <= 1


def test_face_colors_stay_on_their_faces(backend: str) -> None:
    """Each side of a cube seen from its own side has its own colour, up to the edge."""
    box = trimesh.creation.box()
    side = np.argmax(np.abs(box.face_normals), axis=1) * 2 + (box.face_normals.sum(axis=1) < 0)
    palette = np.array(
        [[200, 30, 30], [30, 200, 30], [30, 30, 200], [200, 200, 30], [30, 200, 200], [200, 30, 200]], np.uint8
    )
    mesh = trimesh.Trimesh(box.vertices, box.faces, face_colors=palette[side], process=False)
    for name, number in (("right", 0), ("left", 1), ("top", 2), ("bottom", 3), ("front", 4), ("back", 5)):
        picture = np.asarray(preview(mesh, views=name, size=(48, 48), light="flat", backend=backend)).astype(int)
        assert np.abs(picture[8:40, 8:40] - palette[number]).max() <= 2, name


def test_scalar_goes_through_the_colour_map(backend: str) -> None:
    """Height over a square: bottom, middle and top of the map; NaN is grey; the bar stands at the right."""
    vertices = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    options = {"views": "front", "size": (128, 128), "light": "flat", "backend": backend}
    plain = np.asarray(
        preview((vertices, faces), scalar=vertices[:, 1], colormap="gray", color_bar=False, **options)
    ).astype(int)
    column = plain[10:118, 64, 0]
    assert np.all(np.diff(column) <= 0) and np.abs(plain[64, 64] - 128).max() <= 6
    assert np.abs(column - np.interp(np.arange(10, 118) + 0.5, [6.4, 121.6], [255, 0])).max() <= 6
    ranged = np.asarray(
        preview(
            (vertices, faces), scalar=vertices[:, 1], scalar_range=(-3, 3), colormap="gray", color_bar=False, **options
        )
    )
    assert abs(int(ranged[118, 64, 0]) - 85) <= 8 and abs(int(ranged[10, 64, 0]) - 170) <= 8
    broken = np.asarray(preview((vertices, faces), scalar=[np.nan, 1.0], color_bar=False, **options)).astype(int)
    assert np.abs(broken[100, 100] - 150).max() <= 3 and np.ptp(broken[30, 30]) > 40
    barred = np.asarray(preview((vertices, faces), scalar=vertices[:, 1], scalar_label="height", **options)).astype(int)
    assert (np.abs(barred[:, 70:] - 255).max(axis=2) > 40).any(axis=0).sum() > 10
    assert np.abs(barred[64, 2] - 255).max() == 0


def test_transparent_background(backend: str) -> None:
    """Nothing outside, everything inside, and partly covered pixels keep the surface's own colour."""
    mesh = trimesh.creation.icosphere(subdivisions=3)
    view = SurfaceView(mesh.vertices, mesh.faces, color=(0.2, 0.6, 0.4))
    picture = np.asarray(preview(view, size=(128, 128), transparent=True, light="flat", backend=backend)).astype(int)
    assert picture.shape == (128, 128, 4)
    alpha = picture[..., 3]
    assert alpha[0, 0] == alpha[-1, -1] == alpha[64, 1] == 0 and alpha[64, 64] == 255
    partly = (alpha > 60) & (alpha < 200)
    assert partly.sum() > 50  # antialiased
    assert np.abs(picture[partly][:, :3] - [51, 153, 102]).max() <= 6
    # The share of covered area is that of the disc, whose diameter is the picture less its margins.
    assert alpha.mean() / 255 == pytest.approx(np.pi / 4 * 0.9**2, rel=0.02)


def test_background_is_composed_behind(backend: str) -> None:
    mesh = trimesh.creation.icosphere(subdivisions=2)
    picture = np.asarray(preview(mesh, size=(64, 64), background=("#000000", (0.0, 0.0, 1.0)), backend=backend)).astype(
        int
    )
    assert picture[0, 0].tolist() == [0, 0, 0] and picture[-1, 0].tolist() == [0, 0, 255]


def test_wireframe_marks_the_edges_and_nothing_else(backend: str) -> None:
    """One big triangle: dark along its sides, plain in its middle; lines are as wide as asked."""
    triangle = (np.array([[-1.0, -0.8, 0], [1, -0.8, 0], [0, 0.9, 0]]), np.array([[0, 1, 2]]))
    options = {"views": "front", "size": (128, 128), "light": "flat", "backend": backend}
    wires = Wireframe(color="black", width=4.0, opacity=1.0)
    bare = np.asarray(preview(triangle, **options)).astype(int)
    drawn = np.asarray(preview(triangle, wireframe=wires, **options)).astype(int)
    assert np.array_equal(bare[70, 64], drawn[70, 64])
    changed = np.abs(bare - drawn).max(axis=2) > 60
    column = changed[:, 64]
    bottom = np.flatnonzero(column[80:])
    assert 1 <= len(bottom) <= 3  # half of the line lies within the triangle
    assert drawn[80:, 64][bottom[-1]].max() < 90


def test_arrows_lie_on_the_visible_side(backend: str) -> None:
    mesh = trimesh.creation.icosphere(subdivisions=3)
    points = np.asarray(mesh.vertices)
    view = SurfaceView(points, mesh.faces, color="white", up="z")
    around = np.cross([0, 0, 1], points)
    options = {"views": "front", "size": (160, 160), "light": "flat", "backend": backend}

    def red(field) -> int:
        picture = np.asarray(preview(view, arrows=field, **options)).astype(int)
        return int(((picture[..., 0] > 150) & (picture[..., 1] < 80)).sum())

    everywhere = red(Arrows(around, color="red", count=60))
    assert everywhere > 100
    assert red(Arrows(np.zeros_like(around), color="red")) == 0
    hidden = around * (points[:, 1:2] > 0.5)  # the front looks along +y: these are behind the sphere
    assert red(Arrows(hidden, color="red", count=60)) == 0
    per_face = np.cross([0, 0, 1], mesh.triangles_center)
    assert red(Arrows(per_face, color="red", count=60, uniform=True)) > 100


def test_turntable_frames_and_gif(backend: str, tmp_path) -> None:
    """A turntable has the frames asked for, all different and evenly spaced; its GIF has all of them and loops."""
    target = tmp_path / "turn.gif"
    frames = preview(globe(3), target, frames=5, size=(64, 64), camera=Camera(0, 10), fps=10, backend=backend)
    assert isinstance(frames, list) and len(frames) == 5
    arrays = [np.asarray(shown).astype(int) for shown in frames]
    for k in range(5):
        assert np.abs(arrays[k] - arrays[k - 1]).mean() > 2
    again = np.asarray(preview(globe(3), camera=Camera(144, 10), size=(64, 64), backend=backend)).astype(int)
    assert np.abs(arrays[2] - again).mean() < 1.0
    with Image.open(target) as film:
        assert film.convert("RGB").getpixel((0, 0)) == (255, 255, 255)
        assert film.n_frames == 5 and film.info["loop"] == 0 and film.info["duration"] == 100
    assert [file.name for file in tmp_path.iterdir()] == ["turn.gif"]


def test_several_views_make_one_sheet(backend: str, tmp_path) -> None:
    target = tmp_path / "six.png"
    picture = preview(globe(3), target, views="six", size=(64, 64), backend=backend)
    assert picture.width == 3 * 64 and picture.height > 2 * 64
    with Image.open(target) as written:
        assert written.size == picture.size and np.array_equal(np.asarray(written), np.asarray(picture))
    pair = preview(globe(3), views=["front", (90, 0)], captions=False, size=(64, 64), backend=backend)
    assert pair.size == (128, 64)


def test_sheet_and_comparison(backend: str) -> None:
    mesh = trimesh.creation.icosphere(subdivisions=2)
    points = np.asarray(mesh.vertices)
    made = SimpleNamespace(
        vertices=points * [1, 1, 1.5], faces=mesh.faces, sphere=points, conformal=points[:, [1, 2, 0]]
    )
    four = comparison(made, size=(64, 64), backend=backend)
    assert four.width == 128 and four.height > 128
    left, right = np.asarray(four)[:64, :64].astype(int), np.asarray(four)[:64, 64:].astype(int)
    assert np.abs(left - right).mean() > 5  # another map, another picture
    wide = sheet(
        [map_view(made, on="sphere"), mesh, four], captions=["a", "b", "c"], columns=3, size=(64, 64), backend=backend
    )
    assert wide.width == 3 * 128
    clear = sheet([made], size=(64, 64), transparent=True, backend=backend)
    assert clear.mode == "RGBA" and clear.getpixel((0, 0))[3] == 0


def test_finished_map_file_is_drawn_like_the_map(tmp_path) -> None:
    mesh = trimesh.creation.icosphere(subdivisions=2)
    points, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces, dtype=np.int32)
    made = MapResult(points, faces, points, points, np.ones(len(points)))
    made.save(tmp_path / "ball.npz")
    one, two = (np.asarray(preview(it, size=(48, 48), backend="warp")) for it in (tmp_path / "ball.npz", made))
    assert np.array_equal(one, two)


def test_image_repeats_upwards_only_where_coordinates_ask_for_it(backend: str) -> None:
    """An image is tiled upwards beyond [0, 1], and within [0, 1] its top row does not bleed into the bottom row."""
    vertices = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    image = np.array([[[250, 10, 10]], [[10, 10, 250]]], np.uint8).repeat(16, axis=0).repeat(16, axis=1)
    uv = (vertices[:, :2] + 1) / 2
    options = {"views": "front", "size": (100, 100), "light": "flat", "backend": backend}
    once = np.asarray(preview(SurfaceView(vertices, faces, image=image, uv=uv), **options)).astype(int)
    assert np.abs(once[6, 50] - [250, 10, 10]).max() <= 3 and np.abs(once[93, 50] - [10, 10, 250]).max() <= 3
    tiled = np.asarray(preview(SurfaceView(vertices, faces, image=image, uv=uv * 2), **options)).astype(int)
    quarter = tiled[[16, 39, 61, 84], 50]  # the middles of the four stripes
    assert np.abs(quarter - [[250, 10, 10], [10, 10, 250]] * 2).max() <= 3


def test_scalar_field_of_ratios_is_logarithmic(backend: str) -> None:
    """A ratio and its inverse lie at equal distances from the middle of the map."""
    box = trimesh.creation.box()
    ratio = np.where(np.argmax(np.abs(box.face_normals), axis=1) == 0, 4.0, 1.0)
    field = ScalarField(ratio, colormap="gray", range=(0.25, 4.0), logarithmic=True)
    front = np.asarray(
        preview(box, scalar=field, views="front", size=(64, 64), light="flat", color_bar=False, backend=backend)
    )
    side = np.asarray(
        preview(box, scalar=field, views="right", size=(64, 64), light="flat", color_bar=False, backend=backend)
    )
    assert abs(int(front[32, 32, 0]) - 128) <= 2 and side[32, 32, 0] >= 253
