"""Films of a map: smooth from frame to frame, ending with the map itself, written with and without ffmpeg."""

from __future__ import annotations

import importlib.util
import itertools
from dataclasses import replace

import numpy as np
import pytest
from drawn_frames import film_frames
from hypothesis import given, strategies as st
from PIL import Image

from omtwarp import film
from omtwarp.errors import OmtwarpError
from omtwarp.maps.result import MapResult
from omtwarp.mesh import shapes
from omtwarp.render import Camera, SurfaceView, films, preview
from omtwarp.render.films import along_great_circles, story_of
from omtwarp.render.subject import map_view
from omtwarp.texturing import rasterize

SIZE = (96, 54)
JUMP = 32  # of 255: a change of a pixel that is seen
DRAWING = {"backend": "warp", "device": "cpu"}


@pytest.fixture(autouse=True)
def measured_coarsely(monkeypatch):
    """Measure motion on few pixels: the times of frames matter to one test only."""
    monkeypatch.setattr(films, "PROBE_WIDTH", 24)


@pytest.fixture(scope="module")
def creature() -> MapResult:
    """A body with limbs on a sphere, and a map that moves its points by up to a third of a turn."""
    surface = shapes.limbs(length=0.8, sharpness=4.0, sphere=720)
    last = surface.vertices / np.linalg.norm(surface.vertices, axis=1)[:, None]
    first = last * (1.0, 1.0, 1.6) + (0.0, 0.0, 0.5)
    first /= np.linalg.norm(first, axis=1)[:, None]
    return MapResult(surface.vertices, surface.faces, last, first, np.ones(len(last)))


def swept(frames: list[Image.Image]) -> np.ndarray:
    """Return the share of the picture that edges sweep over between two frames: changes over those of a whole edge."""
    seen = [np.asarray(frame).astype(int) for frame in frames]
    return np.array([np.abs(a - b).max(axis=2).mean() / 150.0 for a, b in itertools.pairwise(seen)])


def test_no_frame_jumps(creature, monkeypatch):
    """Motion is even, and where it is fastest less than 2 % of the pixels change visibly."""
    size = (48, 27)
    monkeypatch.setattr(films, "PROBE_WIDTH", size[0])  # a sixteenth of the pixels
    story, shot_for = story_of(creature, "circles", None, 960, None, None, None, "cpu")
    studio = films._Studio(story, shot_for, "white", False, "warp", "cpu", 15.0)
    times = studio.times(16 / 9, None)
    assert times[0] == 0.0 and times[-1] == 2.0 and times == sorted(times)
    found = swept(list(studio.frames(times, size)))
    assert found.max() < 0.02 and found.sum() > 0.3  # it does move
    moving = np.sort(found[found > 0])
    assert moving[len(moving) // 4] > 0.3 * moving[-1]
    fastest = int(found.argmax())
    before, after = studio.draw(times[fastest : fastest + 2], 480, 270)
    change = np.abs(before[..., :3].astype(int) - after[..., :3]).max(axis=2)
    assert 0.0 < (change > JUMP).mean() < 0.02


def test_last_frame_is_the_map(creature):
    """Every pixel of the last frame has the colour of its direction: the ball is turned, the pattern with it."""
    south = np.linspace(0.0, 1.0, 256)[:, None]  # 0 at the north pole
    colours = np.concatenate([60 + 160 * south, np.full((256, 1), 90.0), 220 - 160 * south], axis=1)
    gradient = np.broadcast_to(colours[:, None], (256, 512, 3)).astype(np.uint8)
    *_, last = film_frames(
        creature, image=gradient, size=(160, 160), seconds=0.5, fps=8.0, captions=False, view=(0.0, 0.0), up="z",
        front="+x", **DRAWING
    )  # fmt: skip
    row, column = np.nonzero((np.asarray(last) != 255).any(axis=2))
    # A ball, seen as a disc: as wide as high, and full.
    width, height = np.ptp(column) + 1, np.ptp(row) + 1
    assert abs(int(width) - int(height)) <= 2
    assert abs(len(row) / (np.pi / 4.0 * width * height) - 1.0) < 0.02
    # The map takes every vertex in its own direction, so that the ball is not turned: from blue at its top, along a
    # meridian, to red at its bottom. Ratios of colours do not depend on light.
    line = np.asarray(last).astype(float)[row.min() + 8 : row.max() - 8, (column.min() + column.max()) // 2]
    found = (line[:, 0] - line[:, 2]) / line.sum(axis=1)
    height_of = 1.0 - (np.arange(len(line)) + 8.5) / (0.5 * height)
    expected = 2.0 * (0.5 - np.arcsin(height_of) / np.pi) - 1.0
    assert np.corrcoef(expected, found)[0, 1] > 0.99 and found[0] < -0.1 and found[-1] > 0.1


def test_the_end_is_what_a_picture_of_the_sphere_shows(creature):
    """The last frame agrees with a picture of the sphere drawn by itself, camera and light the same."""
    far = Camera(field_of_view=2.0)  # that the film stands farther away shows nowhere
    *_, last = film_frames(creature, size=(128, 128), seconds=0.5, fps=8.0, captions=False, view=far, **DRAWING)
    story, _ = story_of(creature, "circles", None, 128, None, None, None, "cpu")
    ball = SurfaceView(story.domain, story.faces, image=np.asarray(rasterize("circles", 1024)), sphere=creature.sphere)
    alone = preview(ball, size=(128, 128), camera=far, **DRAWING)
    other = preview(replace(ball, sphere=creature.conformal), size=(128, 128), camera=far, **DRAWING)

    def framed(image: Image.Image) -> np.ndarray:
        seen = np.asarray(image)
        row, column = np.nonzero((seen != 255).any(axis=2))
        box = (column.min(), row.min(), column.max() + 1, row.max() + 1)
        return np.asarray(image.crop([int(x) for x in box]).resize((40, 40), Image.Resampling.BOX)).astype(float)

    gap, wrong = (np.abs(framed(one) - framed(alone)).mean() for one in (last, other))
    assert gap < 0.3 * wrong


def test_first_frame_carries_the_conformal_map(creature):
    """Colours of the first frame are those of the conformal map, not of the final one."""
    first = next(film_frames(creature, size=(128, 128), seconds=0.5, fps=8.0, captions=False, **DRAWING))
    picture = rasterize("circles", 1024)
    gaps = {}
    for which in ("conformal", "optimal"):
        alone = np.asarray(preview(map_view(creature, picture, which=which), size=(128, 128), **DRAWING)).astype(float)
        coloured = [np.histogram(x[..., k], bins=16, range=(0, 256))[0] for x in (alone,) for k in range(3)]
        mine = [np.histogram(np.asarray(first)[..., k], bins=16, range=(0, 256))[0] for k in range(3)]
        gaps[which] = sum(np.abs(a / a.sum() - b / b.sum()).sum() for a, b in zip(coloured, mine, strict=True))
    assert gaps["conformal"] < gaps["optimal"]


@given(st.floats(0.0, 1.0), st.integers(0, 1000))
def test_points_go_along_great_circles(time, seed):
    rng = np.random.default_rng(seed)
    first, last = (x / np.linalg.norm(x, axis=1)[:, None] for x in rng.normal(size=(2, 5, 3)))
    points = along_great_circles(first, last, time)
    whole = np.arccos(np.clip((first * last).sum(axis=1), -1, 1))
    part = np.arccos(np.clip((first * points).sum(axis=1), -1, 1))
    np.testing.assert_allclose(np.linalg.norm(points, axis=1), 1.0, atol=1e-12)
    np.testing.assert_allclose(part, time * whole, atol=1e-6)
    assert np.abs(np.einsum("ij,ij->i", points, np.cross(first, last))).max() < 1e-12


@pytest.mark.parametrize("suffix", [".gif", ".webp", ".mp4"])
def test_files(creature, tmp_path, suffix):
    if suffix == ".mp4" and importlib.util.find_spec("imageio_ffmpeg") is None:
        pytest.skip("imageio-ffmpeg is not installed")
    told = []
    path = film(
        creature, tmp_path / f"flow{suffix}", size=(96, 54), seconds=1.0, fps=8.0, **DRAWING,
        progress=lambda stage, done, total, facts: told.append((stage, done, total)),
    )  # fmt: skip
    ends = [entry for entry in told if entry[0] == "film"]
    assert ends[-1][1] == ends[-1][2] >= 8 and told[0][0] == "motion"
    if suffix == ".mp4":
        import imageio_ffmpeg

        count, seconds = imageio_ffmpeg.count_frames_and_secs(str(path))
        assert count == ends[-1][2] and abs(seconds - count / 8.0) < 0.2
        return
    with Image.open(path) as shown:
        # Frames that are equal may be one that is shown for longer.
        total = 0.0
        for k in range(shown.n_frames):
            shown.seek(k)
            shown.load()
            total += shown.info["duration"]
        assert shown.size == (96, 54) and abs(total - 1000.0 * ends[-1][2] / 8.0) < 200


def test_a_map_that_does_not_flow_turns_into_its_sphere(creature):
    still = MapResult(creature.vertices, creature.faces, creature.sphere, creature.sphere, creature.density)
    frames = list(film_frames(still, size=(64, 64), seconds=1.0, fps=8.0, **DRAWING))
    assert len(frames) == 8 and swept(frames).sum() > 0


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"seconds": 0.0}, "a film of 0 seconds"),
        ({"seconds": 1e9}, "a film of 1e+09 seconds"),
        ({"seconds": "2"}, "seconds: must be a finite number"),
        ({"seconds": [1.0]}, "seconds: must be a finite number"),
        ({"size": np.ones(3)}, "size of the film"),
        ({"size": ()}, "size of the film"),
        ({"fps": 1e6}, "frames per second"),
        ({"size": (8, 8)}, "cannot draw a film of 8 x 8 pixels"),
        ({"backend": "none"}, "unknown backend"),
        ({"view": "nowhere"}, "unknown view"),
        ({"pattern": "stripes"}, "stripes"),
    ],
)
def test_mistakes_are_one_line(creature, tmp_path, options, words):
    with pytest.raises(OmtwarpError, match=words.replace("+", r"\+")) as raised:
        film(creature, tmp_path / "flow.gif", **({"size": (64, 64)} | options))
    assert "\n" not in str(raised.value) and list(tmp_path.iterdir()) == []


def test_what_is_no_map_is_refused(tmp_path):
    with pytest.raises(OmtwarpError, match="cannot film a int"):
        film(3, tmp_path / "flow.gif")
    with pytest.raises(OmtwarpError, match="cannot hold a film"):
        film(3, tmp_path / "flow.png")
