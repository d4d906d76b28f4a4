"""Films of a map: from the conformal to the optimal map, and the surface turning into its sphere or torus.

A story says where every vertex is drawn, and on the map's domain, at any time, the domains of parts side by side; a
studio draws its moments.
"""

from __future__ import annotations

import itertools
import math
import os
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image, ImageDraw
from scipy.sparse import csr_matrix
from scipy.spatial.transform import Rotation

from omtwarp.colors import backdrop
from omtwarp.errors import OmtwarpError, choose, truth
from omtwarp.files.limits import MOST_FILM_PIXELS, MOST_FRAMES
from omtwarp.location import combined
from omtwarp.maps.domains import is_torus_map
from omtwarp.maps.result import MapResult
from omtwarp.maps.torus_map import ring_torus, tube_radius
from omtwarp.mesh.arrays import Bytes, FinishedMap, Floats, Ints, cross, normalised, norms, real_number
from omtwarp.mesh.polygons import grid_shares, grid_triangles
from omtwarp.mesh.surface import SPHERE_AREA, as_unit_vectors, sums_around, triangle_areas
from omtwarp.options import Backend, BackendLike, PatternLike, Progress, tell
from omtwarp.render import annotate, output
from omtwarp.render.camera import Camera, Shot, as_light, as_view, camera_axes, frame
from omtwarp.render.pictures import View, checked_rate, checked_size, render
from omtwarp.render.scene import Appearance, Part, RenderJob, SurfaceView, centred, smooth_parts, welded_normals
from omtwarp.render.subject import Picture, map_view, posed, torus_view
from omtwarp.texturing.adaptive import rasterize
from omtwarp.texturing.image import PictureLike
from omtwarp.texturing.smooth import smooth_map
from omtwarp.texturing.textured import domains_of, texture_torus

PROBE_WIDTH = 192  # of the pictures on which motion is measured
SPACING = 1.08  # distance of two domains over the sum of their radii, as seen
EASE = 0.12  # share of the motion in which it accelerates, and in which it slows down
BATCH = 12  # frames that are drawn together: their texture is uploaded once


def film(
    result: FinishedMap,
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
    equal areas. The last frame shows the sphere of the final map; of other maps the disk from its front, a ring torus,
    or the sphere of every part, moved so that none hides another. No display is needed.

    Args:
        result: a :class:`~omtwarp.MapResult`.
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
    target = output.check_target(path, film=True, transparent=False)
    pictorial = target.suffix.lower() != ".mp4"
    # Browsers load .gif and .webp as pictures.
    width, height = checked_size(((640, 360) if pictorial else (1920, 1080)) if size is None else size, "film")
    rate = checked_rate((20.0 if pictorial else 30.0) if fps is None else fps)
    if seconds is not None and not 0.0 < real_number(seconds, "seconds") * rate <= MOST_FRAMES:
        raise OmtwarpError(f"a film of {seconds:g} seconds: use more than 0 and at most {MOST_FRAMES / rate:g}")
    if pictorial and seconds is not None:
        _require_room(round(seconds * rate), width, height, target.suffix)
    choose(Backend, backend)
    backdrop(background, 1, 2)
    scene = story_of(result, pattern, image, width, view, up, front, device)
    studio = _Studio(*scene, background, truth(captions, "captions"), backend, device, rate)
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

    def draw(self, times: Sequence[float], width: int, height: int) -> list[Bytes]:
        """Return the pictures of some moments, uint8 [height, width, 4], colours multiplied by their coverage."""
        parts, shots = [self.story.part(time) for time in times], [self.shot_for(width / height)] * len(times)
        job = RenderJob(parts, shots, width, height, as_light("studio"), one_each=True)
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
            moving = min(math.ceil(total / 0.008 / (1.0 - EASE)), MOST_FRAMES - 3 * rest)
        else:
            whole = max(round(seconds * self.fps), 2)
            rest = min(rest, whole // 6)
            moving = max(whole - (len(parts) + 1) * rest, 1)
        chosen = [parts[0][0]] * max(rest, 1)
        for moments, swept in curves:
            count = max(round(moving * swept[-1] / total), 1)
            way = _eased(np.arange(1, count + 1) / count) * swept[-1]
            chosen += [float(time) for time in np.interp(way, swept, moments)]
            chosen[-1] = moments[-1]
            chosen += [moments[-1]] * rest
        return chosen

    def _motion(
        self, first: float, last: float, aspect: float, most: int, progress: Progress | None
    ) -> tuple[list[float], Floats]:
        """Return at most about ``most`` moments of a part of the film, and the motion from its beginning to each."""
        # Motion is measured on small pictures, with times halved until no step sweeps over more than this share.
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
            tell(progress, "motion", level, most_halvings, {})
            times = sorted(seen)
            wide = [(a, b) for a, b in itertools.pairwise(times) if swept(a, b) > step]
            if not wide or len(times) > most:
                break
            look([0.5 * (a + b) for a, b in wide])
        times = sorted(seen)
        # A small number is added so that motion always increases.
        steps = [swept(a, b) + 1e-6 * (b - a) for a, b in itertools.pairwise(times)]
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
        repeats = Counter(times)
        moments = sorted(repeats)
        done = 0
        for start in range(0, len(moments), BATCH):
            some = moments[start : start + BATCH]
            for moment, picture in zip(some, self.draw(some, width, height - band), strict=True):
                image = annotate.compose(picture, size, self.background, False, ink)
                if band:
                    place = (width / 2, height - 0.55 * band)
                    words = self.story.captions[math.floor(moment) + math.ceil(moment)]  # at 0, to 1, at 1, to 2, at 2
                    ImageDraw.Draw(image).text(place, words, font=annotate.font(letters), fill=ink, anchor="mm")
                for _ in range(repeats[moment]):
                    yield image
                done += repeats[moment]
            tell(progress, "film", done, len(times), {})


def _eased(x: Floats) -> Floats:
    """Return the distance covered, at times in [0, 1], by a motion that speeds up and slows down over EASE."""
    speed = 1.0 / (1.0 - EASE)
    begun = speed * x**2 / (2.0 * EASE)
    ending = 1.0 - speed * (1.0 - x) ** 2 / (2.0 * EASE)
    return np.where(x < EASE, begun, np.where(x > 1.0 - EASE, ending, speed * (x - EASE / 2.0)))


@dataclass(frozen=True)
class Story:
    """Where every vertex is drawn and on the map's domain, at any time of a film.

    From time 0 to 1 the points on the sphere go along great circles from the conformal to the final map, which is what
    optimal transport does with them; on a torus they go straight. From 1 to 2 the surface goes straight to the domain.

    Both maps are divided as pictures of maps are, so that lines of the pattern are smooth curves between the vertices.

    Attributes:
        surface: the surface, centred, its farthest point at distance 1, shape [V, 3].
        domain: the vertices on the domain, of the surface's area, turned to lie nearest to it, shape [V, 3].
        domain_points: the same of the divided map, shape [N, 3].
        first: the conformal map, divided: unit vectors, or u and v of a torus, shape [N, 3].
        last: the final map, divided, shape [N, 3].
        faces: of the surface, shape [F, 3].
        parts: the triangles that the surface's are divided into, corners numbered as ``first`` and ``last`` are.
        weights: sparse, shape [N, V]: every point of the divided maps as a combination of vertices; None where they
            are not divided.
        image: picture that is carried along, equirectangular or repeating both ways.
        name: of the domain, in words.
        on_torus: whether the maps are to a torus.
    """

    surface: Floats
    domain: Floats
    domain_points: Floats
    first: Floats
    last: Floats
    faces: Ints
    parts: Ints
    weights: csr_matrix | None
    image: Bytes
    name: str = "sphere"
    on_torus: bool = False

    @property
    def flows(self) -> bool:
        """Whether the conformal and the optimal map differ, so that the film shows the flow between them."""
        return not np.array_equal(self.first, self.last)

    @property
    def captions(self) -> tuple[str, str, str, str, str]:
        """Words for what is seen at time 0, to 1, at 1, to 2, and at 2."""
        owner = "their" if self.name.endswith("s") and self.name != "torus" else "its"
        there = f"to {owner} {self.name}", f"the map on the {self.name}"
        return ("conformal map", "to the optimal map", "optimal map", *there)

    def part(self, time: float) -> Part:
        """Return the surface as it is drawn at a time between 0 and 2."""
        places = self.surface + max(time - 1.0, 0.0) * (self.domain - self.surface)
        flow = min(time, 1.0)
        if self.on_torus:
            points = self.first + flow * (self.last - self.first)
        else:
            points = along_great_circles(self.first, self.last, flow)
        normals = welded_normals(places, self.faces)
        if self.weights is not None:
            # During the second part, added points also move to the domain, not to the flat triangles inside it.
            fill = max(time - 1.0, 0.0) * (self.domain_points - self.weights @ self.domain)
            places, normals = self.weights @ places + fill, normalised(self.weights @ normals)
        look = Appearance(kind="uv" if self.on_torus else "sphere", value=points, image=self.image)
        look.repeat_rows = self.on_torus
        return Part(positions=places, normals=normals, faces=self.parts, **vars(look))


def along_great_circles(first: Floats, last: Floats, time: float) -> Floats:
    """Return the points on the way between unit vectors, at constant speed along great circles, shape [N, 3].

    Args:
        first: where points are at time 0, shape [N, 3].
        last: where they are at time 1, shape [N, 3].
        time: 0 to 1; both ends are exact.
    """
    smallest_sine = 1e-12  # of points next to their antipodes, between which no great circle is the shortest
    if time <= 0.0:
        return first
    if time >= 1.0:
        return last
    angle = np.arctan2(norms(cross(first, last)), np.einsum("ij,ij->i", first, last))[:, None]
    sine = np.maximum(np.sin(angle), smallest_sine)
    # Near, radians: between points nearer than this the great circle is a straight line
    near = angle < 1e-6
    ahead = np.where(near, time, np.sin(time * angle) / sine)
    behind = np.where(near, 1.0 - time, np.sin((1.0 - time) * angle) / sine)
    points = behind * first + ahead * last
    return points / np.maximum(norms(points)[..., None], smallest_sine)


def story_of(
    result: FinishedMap,
    pattern: str,
    image: Picture | None,
    width: int,
    view: View | None,
    up: str | None,
    front: str | None,
    device: str,
) -> tuple[Story, Callable[[float], Shot]]:
    """Return the course of a film, and the camera for a picture of a given width over height.

    Args:
        result: the map.
        pattern: that is carried along where there is no image.
        image: a picture in place of it.
        width: of the film in pixels.
        view: from where it is seen, which parts that have a domain each are laid out for.
        up, front: axes; guessed where they are None.
        device: where the pattern is computed.

    Raises:
        OmtwarpError: no map, or an unusable picture.
    """
    camera = as_view("three-quarter" if view is None else view, Camera())
    # Texels around the sphere of a pattern: two to a pixel of the picture, of which a ball fills about a half.
    texels = int(np.clip(2 ** math.ceil(math.log2(2 * width)), 512, 4096))
    if is_torus_map(result):
        story, shown = _on_torus(result, pattern, image, texels // 2, up, front)
    elif isinstance(result, FinishedMap):
        picture = rasterize(pattern, texels, device=device) if image is None else image
        story, shown = _on_domains(result, picture, camera, up, front)
    else:
        raise OmtwarpError(f"cannot film a {type(result).__name__}: give a map")
    used = np.unique(story.faces)
    extent = np.concatenate([story.surface[used], story.domain[used]])
    return story, lambda aspect: frame(extent, [camera], aspect, shown.up, shown.front)[0]


def _on_domains(
    result: FinishedMap, image: Picture, camera: Camera, up: str | None, front: str | None
) -> tuple[Story, SurfaceView]:
    """Return the course of a film of a map to spheres, disks and parts of spheres."""
    shown = posed(map_view(result, image), up, front)
    surface = centred(shown)
    faces = np.asarray(result.faces, dtype=np.int32)
    first, last = as_unit_vectors(np.asarray(result.conformal)), as_unit_vectors(result.sphere)
    parts, weights = faces, None
    divisions = smooth_parts(len(faces))
    if divisions > 1:
        divided = smooth_map(surface, faces, last, divisions)
        flows = not np.array_equal(first, last)
        first = smooth_map(surface, faces, first, divisions).sphere if flows else divided.sphere
        last, parts, weights = divided.sphere, divided.faces, divided.weights
    number = domains_of(result, len(faces))
    axes = camera_axes(camera, shown.up or "y", shown.front)
    disk = getattr(result, "disk", None)
    points = np.asarray(result.sphere) if disk is None else np.column_stack([disk, np.zeros(len(disk))])
    fits = fits_of(surface, points, faces, number, str(getattr(result, "domain", "sphere")), axes)
    domain = placed_on(points, faces, number, *fits)
    if disk is None:
        ends = placed_on(last, parts, np.repeat(number, len(parts) // len(faces)), *fits)
    else:
        ends = domain if weights is None else weights @ domain
    picture, name = np.asarray(shown.image), domain_name(result)
    return Story(surface, domain, ends, first, last, faces, parts, weights, picture, name), shown


def _on_torus(
    result: MapResult, pattern: str, image: Picture | None, texels: int, up: str | None, front: str | None
) -> tuple[Story, SurfaceView]:
    """Return the course of a film of a map to a torus, which ends with a ring torus."""
    tube_turns = 24  # beginnings along the tube of a ring torus that are compared

    cut = texture_torus(result, image, None if image is not None else pattern, size=texels)
    shown = posed(torus_view(result, cut.image), up, front)
    corners, vertex, last = cut.split()
    surface = centred(shown)[vertex]
    weights = vertex_areas(surface, corners)
    middle = np.average(surface, axis=0, weights=weights)
    tube = int(np.argmin(norms(result.lattice)))  # the vector that goes around the tube
    # Fitted: vertices, at most, that they are compared at
    chosen = np.linspace(0, len(surface) - 1, min(4000, len(surface))).astype(int)
    steps = np.zeros((tube_turns, 2))
    steps[:, tube] = np.arange(tube_turns) / tube_turns
    here, there, heavy = surface[chosen] - middle, result.coordinates[vertex[chosen]], weights[chosen]
    fits = [Rotation.align_vectors(here, ring_torus(there + step, result.lattice), weights=heavy) for step in steps]
    best = int(np.argmin([off for _, off in fits]))
    scale = math.sqrt(triangle_areas(surface, corners).sum() / (4.0 * math.pi**2 * tube_radius(result.lattice)))
    to_ring = scale * fits[best][0].as_matrix().T
    first, parts, shares = last - result.coordinates[vertex] + result.conformal[vertex], corners, None
    divisions = smooth_parts(len(corners))
    if divisions > 1:
        share = grid_shares(divisions)
        shares = combined(np.repeat(corners, len(share), axis=0), np.tile(share, (len(corners), 1)), len(surface))
        parts = (np.arange(len(corners))[:, None, None] * len(share) + grid_triangles(divisions)).reshape(-1, 3)
        first, last = shares @ first, shares @ last
    # Of equal coordinates up to whole numbers, so that the two sides of a seam are at the same place to the last bit.
    domain = (ring_torus(result.coordinates + steps[best], result.lattice) @ to_ring)[vertex] + middle
    ends = domain if shares is None else ring_torus(last + steps[best], result.lattice) @ to_ring + middle
    flat = np.zeros((len(last), 1))
    return Story(
        surface, domain, ends, np.hstack([first, flat]), np.hstack([last, flat]), corners, parts, shares,
        np.asarray(cut.image[..., :3]), "torus", on_torus=True,
    ), shown  # fmt: skip


def domain_name(result: FinishedMap) -> str:
    """Return what a map goes to, in words."""
    one = str(getattr(result, "domain", "sphere"))
    if getattr(result, "cap_centres", None) is not None or one not in ("sphere", "hemisphere", "disk", "cap"):
        one = "sphere"
    return one + "s" if domains_of(result, len(np.asarray(result.faces))).any() else one


def vertex_areas(surface: Floats, faces: Ints) -> Floats:
    """Return three times the area around every vertex, and a little for those without, shape [V]."""
    areas = sums_around(triangle_areas(surface, faces), faces, len(surface))
    return areas + 1e-9 * areas.mean()  # which turns a domain as little as that


def fits_of(
    surface: Floats, points: Floats, faces: Ints, number: NDArray[np.intp], kind: str, axes: Floats
) -> tuple[Floats, Floats]:
    """Return the matrices [P, 3, 3] and shifts [P, 3] that take every domain's points next to its part of the surface.

    Every domain gets the area of its part, and a disk faces the camera. Where there are several, none hides another
    from it.

    Args:
        surface: shape [V, 3].
        points: on the domains, shape [V, 3].
        faces: shape [F, 3].
        number: the domain of every face, shape [F].
        kind: of the domains.
        axes: the camera's, as columns.
    """
    matrices, shifts, radii = [], [], []
    for k in range(int(number.max(initial=0)) + 1):
        mine = faces[number == k]
        weights = vertex_areas(surface, mine)
        used = np.unique(mine)
        covered = {"sphere": SPHERE_AREA, "disk": math.pi}.get(kind) or float(triangle_areas(points, mine).sum())
        centre = np.average(surface[used], axis=0, weights=weights[used]) if number.any() else np.zeros(3)
        here, there = surface[used] - centre, points[used]
        if kind == "disk":
            turn = _facing(axes, here, there, weights[used])
        else:
            turn = Rotation.align_vectors(here, there, weights=weights[used])[0].as_matrix()
        scale = math.sqrt(triangle_areas(surface, mine).sum() / covered)
        matrices.append(scale * turn.T)
        shifts.append(centre)
        radii.append(scale)
    return np.array(matrices), _apart(np.array(shifts), np.array(radii), axes)


def _facing(axes: Floats, here: Floats, there: Floats, weights: Floats) -> Floats:
    """Return the rotation of a disk that shows its front to the camera, turned in its plane to lie nearest to a part.

    Args:
        axes: the camera's, as columns.
        here: the part's vertices about their middle, shape [N, 3].
        there: the same on the disk, shape [N, 3].
        weights: of the vertices, shape [N].
    """
    x, y = (here @ axes[:, :2]).T
    angle = math.atan2(weights @ (there[:, 0] * y - there[:, 1] * x), weights @ (there[:, 0] * x + there[:, 1] * y))
    return axes @ Rotation.from_rotvec([0.0, 0.0, angle]).as_matrix()


def _apart(centres: Floats, radii: Floats, axes: Floats) -> Floats:
    """Return the centres of balls moved across the line of sight until none hides another, shape [P, 3].

    Args:
        centres: shape [P, 3].
        radii: shape [P].
        axes: the camera's, as columns.
    """
    start = 1e-3  # of its radius: how far each is moved along that way at first
    count = len(centres)
    # Most pushed, domains: more are left where their parts are
    if count == 1 or count > 500:
        return centres
    # Spiral, radians: the golden angle, between the ways in which domains at one place go apart
    turns = 2.399963 * np.arange(count)
    flat = centres @ axes[:, :2] + start * radii[:, None] * np.column_stack([np.cos(turns), np.sin(turns)])
    wanted = SPACING * (radii[:, None] + radii[None])
    np.fill_diagonal(wanted, 0.0)
    # Pushes, of domains that hide each other, at most: 50 random ones took 41
    for _ in range(300):
        between = flat[:, None] - flat[None]
        far = norms(between)
        lack = np.maximum(wanted - far, 0.0)
        if lack.max() <= 0.5 * (SPACING - 1.0) * radii.min():
            break
        way = between / np.maximum(far, np.finfo(float).tiny)[..., None]
        flat = flat + 0.5 * (lack[..., None] * way).sum(axis=1)
    return centres + (flat - centres @ axes[:, :2]) @ axes[:, :2].T


def placed_on(points: Floats, faces: Ints, number: NDArray[np.intp], matrices: Floats, shifts: Floats) -> Floats:
    """Return points on domains where they are drawn, shape [N, 3].

    Args:
        points: shape [N, 3].
        faces: triangles of them, shape [F, 3].
        number: the domain of every triangle, shape [F].
        matrices, shifts: of the domains, shapes [P, 3, 3] and [P, 3].
    """
    own = np.zeros(len(points), dtype=np.intp)
    own[faces] = number[:, None]
    return np.einsum("ni,nij->nj", points, matrices[own]) + shifts[own]
