"""How straight the edges of circles are in pictures: their length over that of the smooth curve through them.

The smooth curve is the edge without its waves of less than a tenth of its length or so. It is taken in the affine frame
in which the edge is as wide as high, so that an ellipse is left as it is. Curves drawn in closed form say what the
measure itself adds. ``OMTWARP_ALL_VIEWS=1`` looks at every mesh from all sides.
"""

import functools
import os

import numpy as np
import pytest
from contourpy import contour_generator
from scipy.ndimage import binary_dilation, map_coordinates

from omtwarp import map_to_sphere, preview, shapes, texture
from omtwarp.render.camera import SIX_VIEWS
from omtwarp.render.scene import SurfaceView
from omtwarp.texturing.patterns.circles import Circles

SIZE = 2048 if os.environ.get("OMTWARP_ALL_VIEWS") else 1024
SHORTEST = 150.0 * SIZE / 2048  # pixels around a circle; the raster shows in smaller ones
SMOOTHING = 1.0 / 30.0  # of an edge's length: standard deviation of the Gaussian
JUMP = 5  # of 255 levels from one pixel to the next: an outline, behind which lies another part of the surface


def smooth_length(points, deviation=SMOOTHING):
    """Length of a closed curve, shape [N, 2], and of the smooth curve through it."""
    centred = points - points.mean(axis=0)
    sizes, axes = np.linalg.eigh(centred.T @ centred / len(points))
    frame = axes @ np.diag((sizes.prod() ** 0.25) / np.sqrt(sizes)) @ axes.T
    closed = np.concatenate([centred, centred[:1]]) @ frame
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=1))])
    count = max(int(along[-1]), 256)
    at = np.arange(count) / count * along[-1]
    curve = np.interp(at, along, closed[:, 0]) + 1j * np.interp(at, along, closed[:, 1])
    wave = 2.0 * np.pi * np.fft.fftfreq(count, 1.0 / count)  # times the share of the length that a wave has

    def low(share):
        # Three times over what is left: a circle loses a hundred-thousandth of its radius.
        return 1.0 - (1.0 - np.exp(-0.5 * (wave * share) ** 2)) ** 3

    def length(kept):
        z = np.fft.ifft(np.fft.fft(curve) * kept)
        back = np.stack([z.real, z.imag], axis=1) @ np.linalg.inv(frame)
        return np.linalg.norm(np.diff(np.concatenate([back, back[:1]]), axis=0), axis=1).sum()

    return length(low(1.0 / along[-1])), length(low(deviation))  # without the raster's steps of a pixel


def edges_in(grey, hidden, shortest):
    """Closed edges of dark regions, clear of what is hidden: points in pixels, shape [N, 2] each."""
    wide = binary_dilation(hidden, iterations=4)
    for line in contour_generator(z=grey, name="serial").lines(0.5):
        if np.array_equal(line[0], line[-1]) and np.linalg.norm(np.diff(line, axis=0), axis=1).sum() > shortest:
            if not map_coordinates(wide.astype(np.uint8), line.T[::-1], order=0).any():
                yield line[:-1]


def zigzag(grey, hidden, shortest=150.0):
    """Length of all edges over that of the smooth curves through them, and how many there are."""
    pairs = np.array([smooth_length(line) for line in edges_in(grey, hidden, shortest)])
    return pairs[:, 0].sum() / pairs[:, 1].sum(), len(pairs)


def drawn(inside, size=512, samples=4):
    """A picture, 0 inside and 1 outside of a region, each pixel the mean of its samples."""
    at = (np.arange(size * samples) + 0.5) / samples - size / 2
    fine = np.where(inside(at[None, :], at[:, None]), 0.0, 1.0)
    return fine.reshape(size, samples, size, samples).mean(axis=(1, 3))


@pytest.mark.parametrize("width, height", [(85, 85), (85, 40), (150, 30)])
def test_the_measure_adds_nothing_to_smooth_curves(width, height):
    def ellipse(x, y):
        u, v = 0.8 * x + 0.6 * y, 0.8 * y - 0.6 * x
        return (u / width) ** 2 + (v / height) ** 2 < 1.0

    def egg(x, y):
        return np.hypot(x, y) < 60.0 + 10.0 * np.cos(2.0 * np.arctan2(y, x)) + 6.0 * np.sin(3.0 * np.arctan2(y, x))

    for shape in (ellipse, egg):
        ratio, count = zigzag(drawn(shape), np.zeros((512, 512), dtype=bool))
        assert count == 1 and abs(ratio - 1.0) < 0.005


def test_the_measure_sees_a_zigzag():
    """A circle of 25 chords, each off by a tenth of its length: as on a coarse mesh."""

    def star(x, y):
        return np.hypot(x, y) < 85.0 + 4.0 * np.sign(np.sin(12.5 * np.arctan2(y, x) + 0.3))

    ratio, _ = zigzag(drawn(star), np.zeros((512, 512), dtype=bool))
    assert ratio > 1.02


@functools.cache
def creature(faces):
    return map_to_sphere(shapes.demo_shape(faces), device="cpu")


@functools.cache
def pose(view):
    return {"size": (SIZE, SIZE), "views": view, "up": "z", "front": "-y", "light": "flat", "backend": "warp"}


@functools.cache
def outlines(faces, view):
    """Pixels at the outlines of the creature from one side, and beside it."""
    mesh = creature(faces)
    low = mesh.vertices.min(axis=0)
    places = (255.0 * (mesh.vertices - low) / np.ptp(mesh.vertices, axis=0).max()).astype(np.uint8)
    colours = SurfaceView(mesh.vertices, mesh.faces, colors=places)
    levels = np.asarray(preview(colours, transparent=True, **pose(view))).astype(np.int16)
    hidden = levels[..., 3] < 255
    for axis in (0, 1):
        jump = np.abs(np.diff(levels[..., :3], axis=axis)).max(axis=2) > JUMP
        hidden |= np.pad(jump, [(int(axis == 0), 0), (int(axis == 1), 0)])
    return hidden


def seen(faces, size, view):
    """The zigzag of circles on the creature from one side, in a square picture, with a texture of some size."""
    black = Circles()
    black.palette, black.background = np.zeros_like(black.palette), np.ones(3)
    textured = texture(creature(faces), pattern=black, size=size, device="cpu")
    grey = np.asarray(preview(textured, background="white", **pose(view)).convert("L")) / 255.0
    return zigzag(grey, outlines(faces, view), SHORTEST)


def test_texels_do_not_show_as_saw_teeth():
    """With the size that is chosen: no more zigzag than with four times as many texels.

    Textures of few texels show that the measure sees their teeth.
    """
    found = {size: seen(4000, size, "left")[0] for size in (None, "auto", 512, 256)}
    print(found)
    assert found[None] < 1.02 and found[None] < found["auto"] + 0.001
    assert 1.02 < found[512] < found[256]


@pytest.mark.parametrize("faces", [4000, pytest.param(20000, marks=pytest.mark.skipif(
    not os.environ.get("OMTWARP_ALL_VIEWS"), reason="OMTWARP_ALL_VIEWS is not set"))])  # fmt: skip
def test_edges_of_circles_are_smooth_curves(faces):
    for view in SIX_VIEWS if os.environ.get("OMTWARP_ALL_VIEWS") else ("right",):
        ratio, count = seen(faces, 2520, view)
        print(f"{faces} faces, {view}: {ratio:.4f} over {count} edges")
        assert count > 3 and ratio < 1.02
