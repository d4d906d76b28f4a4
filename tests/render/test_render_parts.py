"""Framing, normals, colour maps, output files, errors, and life without OpenGL."""

from __future__ import annotations

import logging
import os
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from hypothesis import given, strategies as st
from PIL import Image

import omtwarp
from omtwarp.colors import COLORMAPS, colormap_table
from omtwarp.errors import OmtwarpError
from omtwarp.render import Camera, Light, ScalarField, SurfaceView, gl_client, output, pictures, preview, sheet
from omtwarp.render.annotate import ticks
from omtwarp.render.camera import VIEWS, camera_axes, frame, turntable
from omtwarp.render.scene import build_parts, weld, welded_normals
from omtwarp.render.subject import map_view

TRIANGLE = (np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]), np.array([[0, 1, 2]]))
OF_RADIUS_2 = SimpleNamespace(vertices=TRIANGLE[0], faces=TRIANGLE[1], sphere=2.0 * np.eye(3), conformal=np.eye(3))
CONFORMAL_OF_RADIUS_2 = SimpleNamespace(**vars(OF_RADIUS_2) | {"sphere": np.eye(3), "conformal": 2.0 * np.eye(3)})


def projected(points: np.ndarray, shot) -> np.ndarray:
    """Project points to picture coordinates in [-1, 1]."""
    seen = (points - shot.pose[:3, 3]) @ shot.pose[:3, :3]
    depth = -seen[:, 2] if shot.perspective else 1.0
    return np.column_stack([seen[:, 0] / depth / shot.half_width, seen[:, 1] / depth / shot.half_height])


@given(
    seed=st.integers(0, 10**6),
    azimuth=st.floats(-180, 180),
    elevation=st.floats(-90, 90),
    aspect=st.floats(0.4, 2.5),
    projection=st.sampled_from(["perspective", "orthographic"]),
    up=st.sampled_from(["y", "z", "-x"]),
)
def test_framing_fills_the_picture(seed, azimuth, elevation, aspect, projection, up) -> None:
    """Every point lies within the margins, and the picture is full in one direction."""
    points = np.random.default_rng(seed).normal(size=(40, 3))
    points /= np.linalg.norm(points, axis=1).max()
    camera = Camera(azimuth, elevation, projection=projection, margin=0.1)
    (shot,) = frame(points, [camera], aspect, up, None)
    seen = projected(points, shot)
    low, high = seen.min(axis=0), seen.max(axis=0)
    assert np.all(low > -0.8 - 1e-9) and np.all(high < 0.8 + 1e-9)
    assert max(np.minimum(high, -low)) == pytest.approx(0.8, abs=1e-9)  # both sides touched in one direction
    depth = -((points - shot.pose[:3, 3]) @ shot.pose[:3, 2])
    assert shot.near < depth.min() and depth.max() < shot.far
    assert np.allclose(shot.pose[:3, :3].T @ shot.pose[:3, :3], np.eye(3), atol=1e-12)
    assert np.linalg.det(shot.pose[:3, :3]) == pytest.approx(1.0)


def test_views_look_where_they_say() -> None:
    """Backward and up directions of the named views, y up and z up."""
    for name, backward, above in (
        ("front", [0, 0, 1], [0, 1, 0]),
        ("back", [0, 0, -1], [0, 1, 0]),
        ("right", [1, 0, 0], [0, 1, 0]),
        ("left", [-1, 0, 0], [0, 1, 0]),
        ("top", [0, 1, 0], [0, 0, -1]),
        ("bottom", [0, -1, 0], [0, 0, 1]),
    ):
        axes = camera_axes(Camera(*VIEWS[name]))
        assert np.allclose(axes[:, 2], backward) and np.allclose(axes[:, 1], above), name
    axes = camera_axes(Camera(0, 0), up="z")
    assert np.allclose(axes, [[1, 0, 0], [0, 0, -1], [0, 1, 0]])
    rolled = camera_axes(Camera(0, 0, roll=90))
    assert np.allclose(rolled[:, 0], [0, 1, 0])


def test_turntable_keeps_the_axis_in_the_middle() -> None:
    points = np.random.default_rng(0).normal(size=(50, 3))
    shots = frame(points, turntable(Camera(10, 20), 7), 1.3, None, None, centred=True)
    for shot in shots:
        assert np.allclose(projected(np.zeros((1, 3)), shot), 0.0, atol=1e-12)
        assert np.abs(projected(points, shot)).max() <= 0.9 + 1e-9
    assert max(np.abs(projected(points, shot)).max() for shot in shots) == pytest.approx(0.9)


def test_normals_do_not_see_the_seam() -> None:
    """A mesh cut into single triangles has the normals of the whole one, and a sphere has its own points."""
    ball = trimesh.creation.icosphere(subdivisions=3)
    points, faces = np.asarray(ball.vertices), np.asarray(ball.faces, dtype=np.int32)
    whole = welded_normals(points, faces)
    assert np.abs(whole - points).max() < 1e-12  # Max's weights are exact on a sphere
    apart = welded_normals(points[faces].reshape(-1, 3), np.arange(3 * len(faces), dtype=np.int32).reshape(-1, 3))
    assert np.abs(apart - whole[faces].reshape(-1, 3)).max() < 1e-12


@given(st.lists(st.integers(0, 3), min_size=3, max_size=40))
def test_weld_numbers_distinct_places(digits) -> None:
    points = np.array(digits[: len(digits) // 3 * 3], dtype=float).reshape(-1, 3)
    group, members = weld(points)
    assert np.array_equal(points[members][group], points)
    assert len(members) == len(np.unique(points, axis=0))


def test_parts_share_vertices_unless_something_differs() -> None:
    ball = trimesh.creation.icosphere(subdivisions=1)
    view = SurfaceView(ball.vertices, ball.faces)
    assert len(build_parts(view)[0].positions) == len(ball.vertices)
    assert len(build_parts(view, edges=True)[0].positions) == 3 * len(ball.faces)
    flat = build_parts(SurfaceView(ball.vertices, ball.faces, smooth=False))[0]
    assert np.allclose(flat.normals[::3], ball.face_normals, atol=1e-6)


@pytest.mark.parametrize("name", COLORMAPS)
def test_colour_maps_agree_with_matplotlib(name: str) -> None:
    matplotlib = pytest.importorskip("matplotlib")
    exact = matplotlib.colormaps[name](np.linspace(0, 1, 256))[:, :3] * 255
    assert np.abs(colormap_table(name) - exact).max() <= 6.5
    assert np.array_equal(colormap_table(name + "_r"), colormap_table(name)[::-1])


@given(st.floats(-1e6, 1e6), st.floats(1e-3, 1e6))
def test_ticks_are_round_and_within_the_limits(low, width) -> None:
    values = ticks(low, low + width)
    slack = 1e-6 * (abs(low) + width)
    assert 2 <= len(values) <= 12
    assert all(low - slack <= value <= low + width + slack for value in values)
    decades = ticks(10.0 ** (low / 1e6 * 5), 10.0 ** (low / 1e6 * 5) * (1 + width), logarithmic=True)
    assert len(decades) >= 2 and decades == sorted(decades)


def test_scalar_limits() -> None:
    assert ScalarField([1.0, np.nan, 3.0]).limits() == (1.0, 3.0)
    low, high = ScalarField([2.0, 2.0]).limits()
    assert low < 2.0 < high and ScalarField([2.0, 2.0]).normalised()[0] == pytest.approx(0.5)
    assert ScalarField([0.0, 0.1, 10.0], logarithmic=True).limits() == (0.1, 10.0)
    assert ScalarField([0.1, 1.0, 10.0], logarithmic=True).normalised() == pytest.approx([0, 0.5, 1])
    empty, inverted = ScalarField([np.nan]), ScalarField([1.0], range=(2, 2))
    for field in (empty, inverted, ScalarField([1.0], range=(-1, 2), logarithmic=True)):
        with pytest.raises(OmtwarpError):
            field.limits()


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: preview("nowhere.glb", backend="warp"), "nowhere.glb: no such file"),
        (lambda: preview(7, backend="warp"), "cannot draw a int"),
        (lambda: preview(TRIANGLE, backend="opengl"), "unknown backend 'opengl'"),
        (lambda: preview(TRIANGLE, views="sideways", backend="warp"), "unknown view 'sideways'"),
        (lambda: preview(TRIANGLE, light="moon", backend="warp"), "unknown light 'moon'"),
        (lambda: preview(TRIANGLE, background="whitish", backend="warp"), "'whitish' is not a background"),
        (lambda: preview(TRIANGLE, size=(4, 4), backend="warp"), "4 x 4 pixels"),
        (lambda: preview(TRIANGLE, size=100, backend="warp"), "size of the picture: shape [], not [2]"),
        (lambda: preview(TRIANGLE, frames=0, backend="warp"), "frames: must be a whole number from 1"),
        (lambda: preview(TRIANGLE, samples=9, backend="warp"), "side: must be a whole number from 1 to 4, not 9"),
        (lambda: preview(TRIANGLE, samples=np.ones(3), backend="warp"), "must be a whole number from 1 to 4"),
        (lambda: preview(TRIANGLE, up=np.ones(3), backend="warp"), "is not an axis"),
        (lambda: preview(TRIANGLE, up="", backend="warp"), "'' is not an axis"),
        (lambda: preview(TRIANGLE, front=3, backend="warp"), "'3' is not an axis"),
        (lambda: preview(TRIANGLE, views="six", captions=3, backend="warp"), "captions: must be a list of texts"),
        (lambda: preview(TRIANGLE, background=(np.nan, 0, 0), backend="warp"), "is not a background"),
        (lambda: preview(TRIANGLE, background=(300, 0, 0), backend="warp"), "(300, 0, 0) is not a background"),
        (lambda: preview(TRIANGLE, background=(-1, 0, 0), backend="warp"), "(-1, 0, 0) is not a background"),
        (lambda: preview(TRIANGLE, background=(1.5, 0, 0), backend="warp"), "(1.5, 0, 0) is not a background"),
        (lambda: preview(TRIANGLE, background=[1, 2], backend="warp"), "[1, 2] is not a background"),
        (lambda: preview(TRIANGLE, camera=4, backend="warp"), "camera '4': must be an omtwarp.render.Camera"),
        (lambda: preview(TRIANGLE, captions=["hello"], backend="warp"), "captions are for a sheet of several views"),
        (lambda: preview(TRIANGLE, scalar_range=(0, 1), backend="warp"), "scalar_range is for numbers given as scalar"),
        (lambda: preview(TRIANGLE, colormap="gray", backend="warp"), "colormap is for numbers given as scalar"),
        (lambda: preview(TRIANGLE, scalar_label="x", backend="warp"), "scalar_label is for numbers given as scalar"),
        (
            lambda: preview(TRIANGLE, scalar=ScalarField([1, 2, 3]), colormap="gray", backend="warp"),
            "colormap is for numbers given as scalar: leave it out",
        ),
        (lambda: preview(TRIANGLE, fps=5, backend="warp"), "fps is for films, with frames: leave it out"),
        (lambda: preview(TRIANGLE, arrows=[[1.0], [1.0, 2.0]], backend="warp"), "arrows: must be numbers in rows"),
        (lambda: SurfaceView(*TRIANGLE, colors=[[1.0], [1.0, 2.0]]), "colors: must be numbers in rows"),
        (lambda: preview(TRIANGLE, scalar=[1.0, 2.0], backend="warp"), "a number per vertex (3) or per face (1)"),
        (
            lambda: preview(TRIANGLE, scalar=[1.0, 2.0, 3.0], colormap="sunset", backend="warp"),
            "unknown colour map 'sunset'",
        ),
        (lambda: preview(TRIANGLE, scalar=[1, 2, 3], colormap=[1], backend="warp"), "unknown colour map '[1]'"),
        (lambda: preview(TRIANGLE, scalar=[1, 2, 3], scalar_range="x", backend="warp"), "the scalar range: "),
        (lambda: preview(TRIANGLE, scalar=[1, 2, 3], scalar_range=(1, 2, 3), backend="warp"), "range: shape [3], not"),
        (lambda: preview(TRIANGLE, arrows=np.ones((2, 3)), backend="warp"), "arrows needs the shape [3, 3] or [1, 3]"),
        (lambda: preview(TRIANGLE, image="x.png", backend="warp"), "no points on the sphere"),
        (lambda: preview(TRIANGLE, "picture.bmpx", backend="warp"), "unknown picture format '.bmpx'"),
        (lambda: preview(TRIANGLE, "nowhere/picture.png", backend="warp"), "there is no directory 'nowhere'"),
        (lambda: preview(TRIANGLE, "film.png", frames=3, backend="warp"), "cannot hold a film"),
        (lambda: preview(TRIANGLE, "picture.jpg", transparent=True, backend="warp"), "cannot be transparent"),
        (lambda: preview(TRIANGLE, device="gpu7", backend="warp"), "unknown device 'gpu7'"),
        (lambda: sheet([], backend="warp"), "at least one panel"),
        (lambda: sheet([TRIANGLE], frames=3, backend="warp"), "'frames'"),
        (lambda: SurfaceView(np.zeros((0, 3)), np.zeros((0, 3), int)), "nothing to draw"),
        (lambda: SurfaceView(TRIANGLE[0], [[0, 1, 5]]), "faces: 5 in row 0 is out of range"),
        (lambda: SurfaceView([[0, 0, 0], [1, 0, 0], [np.nan, 0, 0]], [[0, 1, 2]]), "not finite, first in row 2"),
        (lambda: SurfaceView(*TRIANGLE, colors=np.ones((3, 3)), scalar=[1, 2, 3]), "colors and scalar were given"),
        (lambda: SurfaceView(*TRIANGLE, image=np.zeros((2, 2, 3))), "either points on the sphere"),
        (lambda: SurfaceView(*TRIANGLE, sphere=2.0 * np.eye(3)), "3 points of the sphere are not on the unit sphere"),
        (lambda: preview(OF_RADIUS_2, backend="warp"), "3 points of the sphere are not on the unit sphere"),
        (lambda: map_view(OF_RADIUS_2), "3 points of the sphere are not on the unit sphere"),
        (lambda: omtwarp.film(CONFORMAL_OF_RADIUS_2, "a.gif", backend="warp"), "of the map are not on the unit sphere"),
        (lambda: SurfaceView(*TRIANGLE, uv=np.ones((2, 2))), "uv needs the shape"),
        (lambda: Camera(zoom=-1.0), "zoom > 0"),
        (lambda: Camera(projection="fisheye"), "unknown projection 'fisheye'"),
        (lambda: camera_axes(Camera(), up="y", front="-y"), "different axes"),
        (lambda: camera_axes(Camera(), up="w"), "'w' is not an axis"),
        (lambda: Light(directional=(((0, 0, 1), 1.0),) * 5), "at most 4"),
    ],
)
def test_errors_are_one_clear_line(make, words: str, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(OmtwarpError) as caught:
        make()
    assert words in str(caught.value) and "\n" not in str(caught.value)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("label", "same"), [(5, "5"), ("two\nlines", "two lines")])
def test_a_label_is_one_line_of_text(label, same) -> None:
    options = {"scalar": [1.0, 2.0, 3.0], "size": (128, 128), "backend": "warp"}
    drawn, expected = (np.asarray(preview(TRIANGLE, scalar_label=words, **options)) for words in (label, same))
    np.testing.assert_array_equal(drawn, expected)


def test_unreadable_files_are_named(tmp_path) -> None:
    for name, data in (("a.glb", b"not a mesh"), ("b.ply", b"ply\nformat ascii 1.0\nend_header\n"), ("c.xyzw", b"?")):
        (tmp_path / name).write_bytes(data)
        with pytest.raises(OmtwarpError, match=name):
            preview(tmp_path / name, backend="warp")


def test_mp4_without_ffmpeg_is_refused_before_the_work(tmp_path, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(OmtwarpError, match=r"needs the program ffmpeg.*or write a \.gif or \.webp"):
        preview(TRIANGLE, tmp_path / "film.mp4", backend="warp")


@pytest.mark.skipif(os.name == "nt", reason="a script stands for the program")
def test_the_ffmpeg_on_the_path_is_preferred_and_its_last_words_are_told(tmp_path, monkeypatch) -> None:
    program = tmp_path / "ffmpeg"
    program.write_text("#!/bin/sh\necho first >&2\necho the codec is out of order >&2\nexit 3\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(OmtwarpError, match="ffmpeg could not write it: the codec is out of order"):
        output.save_film([Image.new("RGB", (16, 16))] * 3, tmp_path / "film.mp4", 10.0)
    assert [file.name for file in tmp_path.iterdir()] == ["ffmpeg"]


@pytest.mark.parametrize(
    ("listed", "chosen"),
    [
        (" V....D libx264      H.264\n V....D libopenh264  H.264", "libx264"),
        (" V....D libopenh264  H.264", "libopenh264"),
        ("", "mpeg4"),
    ],
)
@pytest.mark.skipif(os.name == "nt", reason="a script stands for the program")
def test_what_an_ffmpeg_can_encode_is_asked(tmp_path, listed: str, chosen: str) -> None:
    program = tmp_path / "ffmpeg"
    program.write_text(f"#!/bin/sh\ncat <<END\n{listed}\nEND\n")
    program.chmod(0o755)
    assert output._encoder(str(program))[1] == chosen


def test_mp4_keeps_the_colours(tmp_path) -> None:
    """A patch of strong colour comes back to within what BT.709 in eight bits rounds to, not shifted as by BT.601."""
    ffmpeg = pytest.importorskip("imageio_ffmpeg")
    color = (40, 190, 60)
    output.save_film([Image.new("RGB", (64, 48), color)] * 3, tmp_path / "film.mp4", 10.0)
    reader = ffmpeg.read_frames(str(tmp_path / "film.mp4"), output_params=["-vf", "scale=in_color_matrix=bt709"])
    assert next(reader)["size"] == (64, 48)
    shown = np.frombuffer(next(reader), np.uint8).reshape(48, 64, 3).astype(int)
    reader.close()
    assert np.abs(shown - color).max() <= 4


def test_mp4_holds_the_frames(tmp_path) -> None:
    ffmpeg = pytest.importorskip("imageio_ffmpeg")
    frames = preview(TRIANGLE, tmp_path / "film.mp4", frames=5, fps=10, size=(65, 48), backend="warp")
    assert len(frames) == 5 and frames[0].size == (64, 48)  # as the video is
    count, seconds = ffmpeg.count_frames_and_secs(str(tmp_path / "film.mp4"))
    assert count == 5 and seconds == pytest.approx(0.5, abs=0.11)
    assert [file.name for file in tmp_path.iterdir()] == ["film.mp4"]


@pytest.mark.parametrize("failure", [OSError(28, "No space left on device"), KeyboardInterrupt()])
def test_a_failed_write_leaves_the_old_file_and_nothing_else(failure, tmp_path, monkeypatch) -> None:
    target = tmp_path / "picture.png"
    target.write_bytes(b"old")

    def fail(self, file, *_, **__) -> None:
        file.write_bytes(b"half")
        raise failure

    monkeypatch.setattr(Image.Image, "save", fail)
    with pytest.raises(OmtwarpError if isinstance(failure, OSError) else KeyboardInterrupt) as caught:
        output.save_still(Image.new("RGB", (4, 4)), target)
    if isinstance(failure, OSError):
        assert "No space left" in str(caught.value)
    assert target.read_bytes() == b"old" and len(list(tmp_path.iterdir())) == 1


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".webp", ".tif", ".gif"])
def test_still_formats(suffix: str, tmp_path) -> None:
    target = tmp_path / f"picture{suffix}"
    output.save_still(Image.new("RGB", (20, 10), (200, 30, 60)), target)
    with Image.open(target) as read:
        assert read.size == (20, 10)
        assert np.abs(np.asarray(read.convert("RGB")).astype(int) - [200, 30, 60]).max() <= 4


def test_transparent_gif_keeps_its_holes(tmp_path) -> None:
    frames = []
    for k in range(3):
        shown = np.zeros((16, 16, 4), np.uint8)
        shown[4:12, 2 + 3 * k : 6 + 3 * k] = (250, 120, 0, 255)
        frames.append(Image.fromarray(shown))
    output.save_film(frames, tmp_path / "film.gif", fps=10)
    with Image.open(tmp_path / "film.gif") as film:
        film.seek(2)
        page = np.asarray(film.convert("RGBA"))
    assert page[8, 3, 3] == 0 and page[8, 9].tolist()[3] == 255 and abs(int(page[8, 9, 0]) - 250) < 12


# --- without OpenGL ---------------------------------------------------------------------------------------------------


@pytest.fixture
def fresh_client(monkeypatch):
    """Reset the drawing process before a test, and end it afterwards."""
    monkeypatch.setattr(gl_client, "_current", None)
    monkeypatch.setattr(gl_client, "_no_use", "")
    monkeypatch.setattr(pictures, "_told", set())
    yield monkeypatch
    gl_client.shut_down()


_NO_LIBRARY = """
import ctypes, ctypes.util, sys
ctypes.util.find_library = lambda name: None
real = ctypes.CDLL.__init__
def missing(self, name, *rest, **more):
    if name and ("EGL" in str(name) or "libGL" in str(name)):
        raise OSError(f"{name}: cannot open shared object file")
    real(self, name, *rest, **more)
ctypes.CDLL.__init__ = missing
"""


def test_without_an_opengl_library_the_ray_caster_steps_in(fresh_client, caplog) -> None:
    """The message says what to install, and says it once."""
    pytest.importorskip("pyrender")
    fresh_client.setattr(gl_client, "_COMMAND", f"exec({_NO_LIBRARY!r});{gl_client._COMMAND}")
    with caplog.at_level(logging.WARNING, logger="omtwarp.render"):
        for _ in range(2):
            picture = preview(TRIANGLE, size=(32, 32))
            assert picture.info["backend"].startswith("warp")
    assert len(caplog.records) == 1
    assert "apt-get install --no-install-recommends libegl1 libgl1" in caplog.text and "ray caster" in caplog.text
    with pytest.raises(OmtwarpError, match="apt-get install --no-install-recommends libegl1 libgl1"):
        preview(TRIANGLE, size=(32, 32), backend="pyrender")


def test_a_library_that_only_the_loader_finds_is_used(fresh_client) -> None:
    """An OpenGL library on LD_LIBRARY_PATH is used, although neither ldconfig nor a linker lists it."""
    pytest.importorskip("pyrender")
    try:
        preview(TRIANGLE, size=(32, 32), backend="pyrender")
    except OmtwarpError:
        if os.environ.get("CI"):
            raise
        pytest.skip("no OpenGL on this machine")
    gl_client.shut_down()
    unknown = "import ctypes.util; ctypes.util.find_library = lambda name: None"
    fresh_client.setattr(gl_client, "_COMMAND", f"{unknown};{gl_client._COMMAND}")
    assert preview(TRIANGLE, size=(32, 32), backend="pyrender").info["backend"].startswith("pyrender")


def test_without_pyrender_the_ray_caster_steps_in(fresh_client, caplog) -> None:
    find = gl_client.importlib.util.find_spec
    fresh_client.setattr(gl_client.importlib.util, "find_spec", lambda name: None if name == "pyrender" else find(name))
    with caplog.at_level(logging.WARNING, logger="omtwarp.render"):
        assert preview(TRIANGLE, size=(32, 32)).info["backend"].startswith("warp")
    assert "pip install 'omtwarp[preview]'" in caplog.text
    with pytest.raises(OmtwarpError, match=r"libegl1 libgl1"):
        preview(TRIANGLE, size=(32, 32), backend="pyrender")


@pytest.mark.parametrize(
    ("command", "words"),
    [
        ("import os; os.write(2, b'driver bug\\n'); os.abort()", "driver bug"),
        ("import time; time.sleep(60)", "no picture within"),
    ],
)
def test_a_crashing_or_hanging_driver_does_not_take_the_caller_along(fresh_client, caplog, command, words) -> None:
    pytest.importorskip("pyrender")
    fresh_client.setattr(gl_client, "_COMMAND", command)
    fresh_client.setattr(gl_client, "START_SECONDS", 1.0)
    gl_client.prepare()
    process = gl_client._current
    with caplog.at_level(logging.WARNING, logger="omtwarp.render"):
        assert preview(TRIANGLE, size=(32, 32)).info["backend"].startswith("warp")
    assert words in caplog.text
    assert process.poll() is not None  # ended, not left behind


def test_an_idle_drawing_process_ends_and_comes_back(fresh_client) -> None:
    fresh_client.setattr(gl_client, "IDLE_SECONDS", 0.2)
    try:
        first = preview(TRIANGLE, size=(32, 32), backend="pyrender")
    except OmtwarpError:
        if os.environ.get("CI"):
            raise
        pytest.skip("no OpenGL on this machine")
    process = gl_client._current
    deadline = time.monotonic() + 20
    while process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.05)
    assert process.poll() is not None
    again = preview(TRIANGLE, size=(32, 32), backend="pyrender")
    assert np.array_equal(np.asarray(first), np.asarray(again))


def test_importing_the_package_is_cheap() -> None:
    """Nothing heavy is loaded before it is used."""
    code = (
        "import sys, omtwarp.render as render; render.Camera; render.preview;"
        "print([name for name in ('warp', 'trimesh', 'pyrender', 'scipy') if name in sys.modules])"
    )
    root = Path(omtwarp.__file__).parents[1]
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=root)
    assert done.stdout.strip() == "[]"
