"""Films of a map: from the conformal to the optimal map, and the surface turning into its sphere or torus."""

from __future__ import annotations

import itertools
import math
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image, ImageDraw

from omtwarp.colors import backdrop
from omtwarp.errors import OmtwarpError, choose
from omtwarp.files.limits import FRAMES_PER_SECOND, LARGEST_VIEW, MOST_FILM_PIXELS, MOST_FRAMES
from omtwarp.options import Backend, BackendLike, PatternLike, Progress
from omtwarp.render import annotate, output
from omtwarp.render.camera import Camera, Shot, as_light, as_view, frame
from omtwarp.render.options import View
from omtwarp.render.pictures import render
from omtwarp.render.scene import RenderJob
from omtwarp.render.stories import Story, story_of
from omtwarp.render.subject import FinishedMap
from omtwarp.texturing.image import PictureLike

if TYPE_CHECKING:
    from omtwarp.maps.torus_map import TorusMap

Floats = NDArray[np.float64]

HD = (1920, 1080)  # pixels of an .mp4 where no size is given
# Motion is measured on pictures of this width, with times halved until no step sweeps over more than STEP.
PROBE_WIDTH = 192
# Change of a pixel, of the whole range, that counts as an edge between two fields; smaller changes in proportion.
EASE = 0.12  # share of the motion in which it accelerates, and in which it slows down
BATCH = 12  # frames that are drawn together: their texture is uploaded once

STILL = 1e-6  # added to a film's motion in its whole time, so that time never stands still


def film(
    result: FinishedMap | TorusMap,
    path: str | os.PathLike[str],
    *,
    pattern: PatternLike = "circles",
    image: PictureLike | None = None,
    size: tuple[int, int] | None = None,
    fps: float | None = None,
    seconds: float | None = None,
    view: View | None = None,
    up: str | None = None,
    front: str | None = None,
    background: str | ArrayLike = "white",
    captions: bool = True,
    backend: BackendLike = "auto",
    device: str = "auto",
    progress: Progress | None = None,
) -> Path:
    """Write a film of a map: it flows from the conformal to the optimal one, then the surface becomes its sphere.

    A pattern on the sphere is carried to the surface by the map of every moment, so that its circles move and grow to
    equal areas. The last frame shows the sphere of the final map; of other maps the disk, a ring torus, or the sphere
    of every part, moved so that none hides another. No display is needed.

    Args:
        result: a :class:`~omtwarp.MapResult` or :class:`~omtwarp.TorusMap`.
        path: ``.mp4`` (needs the program ffmpeg), ``.gif`` or ``.webp``; the file appears whole or not at all.
        pattern: ``circles``, ``puzzle``, ``globe`` or ``checker``; on a torus the first or the last.
        image: equirectangular picture in place of the pattern, or one that repeats for a torus: a path, a PIL image or
            an array [H, W, 3].
        size: width and height in pixels; None takes 1920 x 1080, and 640 x 360 for ``.gif`` and ``.webp``.
        fps: frames per second; None takes 30, and 20 for ``.gif`` and ``.webp``.
        seconds: how long the film is; None takes as long as smooth motion needs, with edges that sweep over less than
            a hundredth of the picture from frame to frame.
        view: where the camera stands, as one view of :func:`~omtwarp.preview`; None takes three-quarter.
        up: axis that points upwards; None guesses from the shape, as :func:`omtwarp.preview` does.
        front: axis that points at the viewer in the front view.
        background: a colour, (top, bottom) colours, or ``"studio"``.
        captions: name what is seen below the picture, where it has 44 pixels of height.
        backend: ``"pyrender"`` (OpenGL), ``"warp"`` (ray caster) or ``"auto"``.
        device: where the pattern is computed and the ray caster runs.
        progress: called with the stage, frames done, frames in all and further facts.

    Returns:
        The path.

    Raises:
        OmtwarpError: no map, an option that makes no sense, or a file that cannot be written.

    Example:
        >>> import omtwarp
        >>> result = omtwarp.map_to_sphere(omtwarp.shapes.blob(seed=3, sphere=320), until="moser", device="cpu")
        >>> str(omtwarp.film(result, "flow.gif", size=(96, 54), seconds=1.0, fps=4, backend="warp", device="cpu"))
        'flow.gif'
    """
    small = (640, 360)  # of films that browsers load as pictures: .gif and .webp
    target = output.check_target(path, film=True, transparent=False)
    pictorial = target.suffix.lower() != ".mp4"
    width, height = _checked_size(size or (small if pictorial else HD))
    rate = float((20.0 if pictorial else 30.0) if fps is None else fps)
    slowest, fastest = FRAMES_PER_SECOND
    if not slowest <= rate <= fastest:
        raise OmtwarpError(f"{fps} frames per second asked for: use {slowest:g} to {fastest:g}")
    if seconds is not None and not 0.0 < seconds * rate <= MOST_FRAMES:
        raise OmtwarpError(f"a film of {seconds:g} seconds: use more than 0 and at most {MOST_FRAMES / rate:g}")
    if pictorial and seconds is not None:
        _require_room(round(seconds * rate), width, height, target.suffix)
    choose(Backend, backend)
    backdrop(background, 1, 2)
    studio = _Studio(
        *_scene_of(result, pattern, image, width, view, up, front, device), background, captions, backend, device, rate
    )
    times = studio.times(width / height, seconds, progress)
    if pictorial:
        _require_room(len(times), width, height, target.suffix)
    output.save_film(studio.frames(times, (width, height), progress), target, rate)
    return target


def _require_room(frames: int, width: int, height: int, suffix: str) -> None:
    """Refuse a film whose frames, which are in memory at a time, are too large.

    Raises:
        OmtwarpError: more pixels than a film may have.
    """
    if frames * width * height > MOST_FILM_PIXELS:
        raise OmtwarpError(
            f"a film of {frames} frames of {width} x {height} pixels is more than the "
            f"{MOST_FILM_PIXELS / 1e6:.0f} million pixels that {suffix} takes: make it smaller, or use .mp4"
        )


def _checked_size(size: tuple[int, int]) -> tuple[int, int]:
    width, height = int(size[0]), int(size[1])
    if not (16 <= width <= LARGEST_VIEW and 16 <= height <= LARGEST_VIEW):
        raise OmtwarpError(f"cannot draw a film of {width} x {height} pixels: use 16 to {LARGEST_VIEW} along each side")
    return width, height


def _scene_of(
    result: FinishedMap | TorusMap,
    pattern: str,
    image: PictureLike | None,
    width: int,
    view: View | None,
    up: str | None,
    front: str | None,
    device: str,
) -> tuple[Story, Callable[[float], Shot]]:
    """Return the course of a film, and the camera for a picture of a given width over height.

    Raises:
        OmtwarpError: no map, or an unusable picture or view.
    """
    camera = as_view("three-quarter" if view is None else view, Camera())
    story, shown = story_of(result, pattern, image, width, camera, up, front, device)
    used = np.unique(story.faces)
    extent = np.concatenate([story.surface[used], story.domain[used]])

    def shot_for(aspect: float) -> Shot:
        return frame(extent, [camera], aspect, up=shown.up, front=shown.front)[0]

    return story, shot_for


@dataclass(frozen=True)
class _Studio:
    """Draws the moments of a story."""

    story: Story
    shot_for: Callable[[float], Shot]
    background: str | ArrayLike
    captions: bool
    backend: str
    device: str
    fps: float

    def draw(self, times: Sequence[float], width: int, height: int) -> list[NDArray[np.uint8]]:
        """Return the pictures of some moments, uint8 [height, width, 4], colours multiplied by their coverage."""
        shot = self.shot_for(width / height)
        job = RenderJob(
            parts=[self.story.part(time) for time in times],
            shots=[shot] * len(times),
            width=width,
            height=height,
            light=as_light("studio"),
            one_each=True,
        )
        return render(job, self.backend, self.device)[0]

    def times(self, aspect: float, seconds: float | None, progress: Progress | None = None) -> list[float]:
        """Return the time of every frame, for motion that looks even.

        Motion is the share of the picture that edges sweep over, measured on small pictures; within each part of the
        film its speed is constant except at the beginning and end.
        """
        # Rest: seconds that the film pauses at its beginning, between its two parts and at its end
        rest = max(round(0.7 * self.fps), 1)
        parts = [(0.0, 1.0), (1.0, 2.0)][0 if self.story.flows else 1 :]
        # A film of few frames needs no finer measure of its motion than that.
        most = MOST_FRAMES if seconds is None else math.ceil(seconds * self.fps)
        curves = [self._motion(*part, aspect, most, progress) for part in parts]
        total = sum(swept[-1] for _, swept in curves)
        if seconds is None:
            # Share of the picture that edges sweep over from one frame to the next. Circles on a creature then move by
            # a pixel or two of a picture of 1920 x 1080, and no more than a fiftieth of its pixels change.
            moving = math.ceil(total / 0.008 / (1.0 - EASE))
            if moving + 3 * rest > MOST_FRAMES:
                moving = MOST_FRAMES - 3 * rest
        else:
            whole = max(round(seconds * self.fps), 2)
            rest = min(rest, whole // 6)
            moving = max(whole - (len(parts) + 1) * rest, 1)
        found = [parts[0][0]] * max(rest, 1)
        for moments, swept in curves:
            count = max(round(moving * swept[-1] / max(total, STILL)), 1)
            way = _eased(np.arange(1, count + 1) / count) * swept[-1]
            found += [float(time) for time in np.interp(way, swept, moments)]
            found[-1] = moments[-1]
            found += [moments[-1]] * rest
        return found

    def _motion(
        self, first: float, last: float, aspect: float, most: int, progress: Progress | None
    ) -> tuple[list[float], Floats]:
        """Return at most about ``most`` moments of a part of the film, and the motion from its beginning to each."""
        step = 0.012
        most_halvings = 9
        # Change of a pixel, of the whole range, that counts as an edge between two fields; smaller changes in
        # proportion.
        edge = 0.6
        width, height = PROBE_WIDTH, max(round(PROBE_WIDTH / aspect), 16)
        seen: dict[float, NDArray[np.int16]] = {}

        def look(times: Sequence[float]) -> None:
            for start in range(0, len(times), BATCH):
                some = times[start : start + BATCH]
                for time, picture in zip(some, self.draw(some, width, height), strict=True):
                    seen[time] = picture.astype(np.int16)

        def swept(earlier: float, later: float) -> float:
            change = np.abs(seen[later] - seen[earlier]).max(axis=2) / (255.0 * edge)
            return float(np.minimum(change, 1.0).mean())

        look([float(time) for time in np.linspace(first, last, 9)])
        for level in range(most_halvings):
            if progress is not None:
                progress("motion", level, most_halvings, {})
            times = sorted(seen)
            wide = [(a, b) for a, b in itertools.pairwise(times) if swept(a, b) > step]
            if not wide or len(times) > most:
                break
            look([0.5 * (a + b) for a, b in wide])
        times = sorted(seen)
        # A small number is added so that time always increases.
        steps = [swept(a, b) + STILL * (b - a) for a, b in itertools.pairwise(times)]
        return times, np.concatenate([[0.0], np.cumsum(steps)])

    def frames(
        self, times: Sequence[float], size: tuple[int, int], progress: Progress | None = None
    ) -> Iterator[Image.Image]:
        """Yield the pictures of the film, drawn as they are asked for.

        Moments in which nothing moves are drawn once.
        """
        width, height = size
        letters = max(11.0, height / 26.0)
        # Captioned height, in pixels: a caption of legible letters takes half of that
        band = round(2.0 * letters) if self.captions and height >= 44 else 0
        ink = annotate.ink(self.background, False)
        moments = sorted(set(times))
        repeats = {moment: times.count(moment) for moment in moments}
        done = 0
        for start in range(0, len(moments), BATCH):
            some = moments[start : start + BATCH]
            for moment, picture in zip(some, self.draw(some, width, height - band), strict=True):
                image = annotate.compose(picture, size, self.background, False)
                if band:
                    place = (width / 2, height - 0.55 * band)
                    words = self.story.captions[math.floor(moment) + math.ceil(moment)]  # at 0, to 1, at 1, to 2, at 2
                    ImageDraw.Draw(image).text(place, words, font=annotate.font(letters), fill=ink, anchor="mm")
                for _ in range(repeats[moment]):
                    yield image
                done += repeats[moment]
            if progress is not None:
                progress("film", done, len(times), {})


def _eased(x: Floats) -> Floats:
    """Return the distance covered, at times in [0, 1], by a motion that speeds up and slows down over EASE."""
    speed = 1.0 / (1.0 - EASE)
    begun = speed * x**2 / (2.0 * EASE)
    ending = 1.0 - speed * (1.0 - x) ** 2 / (2.0 * EASE)
    return np.where(x < EASE, begun, np.where(x > 1.0 - EASE, ending, speed * (x - EASE / 2.0)))
