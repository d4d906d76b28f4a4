"""Frames of films, which the package writes to files alone."""

from collections.abc import Iterator

from PIL import Image

from omtwarp.render.films import _Studio, story_of


def film_frames(
    result,
    *,
    size,
    fps,
    seconds,
    image=None,
    view=None,
    up=None,
    front=None,
    captions=True,
    backend="auto",
    device="cpu",
) -> Iterator[Image.Image]:
    """The frames of ``film``, one after another, with the same arguments."""
    scene = story_of(result, "circles", image, size[0], view, up, front, device)
    studio = _Studio(*scene, "white", captions, backend, device, fps)
    return studio.frames(studio.times(size[0] / size[1], seconds), size)
