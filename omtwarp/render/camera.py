"""Cameras: directions of view, framing that fills the picture, turntables."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from omtwarp.errors import OmtwarpError, check_word
from omtwarp.mesh.arrays import Floats, cross

# Azimuth and elevation in degrees.
VIEWS: dict[str, tuple[float, float]] = {
    "front": (0.0, 0.0),
    "back": (180.0, 0.0),
    "left": (-90.0, 0.0),
    "right": (90.0, 0.0),
    "top": (0.0, 90.0),
    "bottom": (0.0, -90.0),
    "three-quarter": (-30.0, 18.0),
}
SIX_VIEWS = ("front", "back", "left", "right", "top", "bottom")
DEFAULT_FRONT = {"x": "+z", "y": "+z", "z": "-y"}


@dataclass(frozen=True)
class Camera:
    """The direction and projection from which a picture is taken.

    The distance is chosen so that the surface fills the picture; ``zoom`` enlarges it from there.

    Attributes:
        azimuth: degrees around the upward axis; 0 looks at the front, 90 at the subject's right-hand picture side.
        elevation: degrees above the horizon, -90 to 90.
        roll: degrees the camera is turned about its own axis.
        zoom: 1 fills the picture; 2 shows everything twice as large.
        field_of_view: vertical opening in degrees (perspective only).
        projection: ``"perspective"`` or ``"orthographic"``.
        margin: empty border as a part of the picture.
    """

    azimuth: float = VIEWS["three-quarter"][0]
    elevation: float = VIEWS["three-quarter"][1]
    roll: float = 0.0
    zoom: float = 1.0
    field_of_view: float = 24.0
    projection: str = "perspective"
    margin: float = 0.05

    def __post_init__(self) -> None:
        numbers = (self.azimuth, self.elevation, self.roll, self.zoom, self.field_of_view, self.margin)
        possible = self.zoom > 0 and 0 < self.field_of_view < 170 and 0 <= self.margin < 0.5
        if not np.all(np.isfinite(numbers)) or not possible:
            raise OmtwarpError(
                "the camera needs finite angles, zoom > 0, a field of view in (0, 170) degrees and a margin in [0, 0.5)"
            )
        check_word("projection", self.projection, ("perspective", "orthographic"))

    def looking(self, azimuth: float, elevation: float) -> "Camera":
        """Return this camera turned to another direction."""
        return replace(self, azimuth=float(azimuth), elevation=float(elevation))


@dataclass(frozen=True)
class Shot:
    """A camera placed before normalised geometry: everything a backend needs to project.

    Attributes:
        pose: camera to world, float64 [4, 4]; the camera looks along its -z axis, y is up.
        perspective: False is a parallel projection.
        half_width: half the picture's width at distance 1 (perspective) or anywhere (parallel).
        half_height: the same for its height.
        near: distance of the near plane.
        far: distance of the far plane.
    """

    pose: Floats
    perspective: bool
    half_width: float
    half_height: float
    near: float
    far: float


def as_view(view: str | tuple[float, float] | Camera, base: Camera) -> Camera:
    """Return a view by name, as (azimuth, elevation) in degrees, as the text ``"AZ,EL"``, or a :class:`Camera` itself.

    Raises:
        OmtwarpError: the view has none of these forms, or an unknown name.
    """
    if isinstance(view, Camera):
        return view
    given = VIEWS.get(view, view.split(",")) if isinstance(view, str) else view
    try:
        azimuth, elevation = (float(number) for number in given)
    except (TypeError, ValueError):
        raise OmtwarpError(
            f"unknown view {view!r}: use {', '.join(VIEWS)}, azimuth,elevation in degrees such as 30,20, or a Camera"
        ) from None
    return base.looking(azimuth, elevation)


def as_views(views: object, base: Camera) -> list[Camera]:
    """Return the cameras of one or several views; ``"six"`` is front to bottom, None the base camera itself."""
    if views is None:
        return [base]
    if isinstance(views, str) and views == "six":
        return [as_view(view, base) for view in SIX_VIEWS]
    pair = isinstance(views, tuple) and len(views) == 2 and isinstance(views[0], (int, float))
    if isinstance(views, (str, Camera)) or pair:
        return [as_view(views, base)]  # type: ignore[arg-type]
    if not isinstance(views, Sequence) or len(views) == 0:
        raise OmtwarpError(f"{views!r} is not a list of views: use names, (azimuth, elevation) pairs or cameras")
    return [camera for view in views for camera in as_views(view, base)]


def turntable(base: Camera, frames: int) -> list[Camera]:
    """Return the cameras that go once around the upward axis in equal steps; the last step leads back to the first.

    Raises:
        OmtwarpError: fewer than one frame.
    """
    if frames < 1:
        raise OmtwarpError(f"a turntable of {frames} frames is empty: give 1 or more")
    return [replace(base, azimuth=base.azimuth + 360.0 * k / frames) for k in range(frames)]


def axis_vector(name: str) -> Floats:
    """Return the unit vector of an axis such as ``"z"``, ``"+z"`` or ``"-y"``.

    Raises:
        OmtwarpError: the text names no axis.
    """
    letter = name[-1:].lower() if isinstance(name, str) else ""
    if letter not in ("x", "y", "z") or name[:-1] not in ("", "+", "-"):
        raise OmtwarpError(f"'{name}' is not an axis: use x, y or z with an optional sign")
    vector = np.zeros(3)
    vector["xyz".index(letter)] = -1.0 if name.startswith("-") else 1.0
    return vector


def camera_axes(camera: Camera, up: str = "y", front: str | None = None) -> Floats:
    """Return the camera's right, up and backward directions as columns, float64 [3, 3].

    Args:
        camera: gives azimuth, elevation and roll.
        up: the axis that points upwards in the picture.
        front: the axis that points at the viewer in the front view; None takes +z, or -y where z is up.

    Raises:
        OmtwarpError: the two axes are parallel.
    """
    upward = axis_vector(up)
    forward = axis_vector(front or DEFAULT_FRONT[up[-1].lower()])
    if abs(upward @ forward) > 0.5:
        raise OmtwarpError(f"the upward axis '{up}' and the front axis '{front}' must be different axes")
    azimuth, elevation, roll = np.radians([camera.azimuth, camera.elevation, camera.roll])
    level = np.cos(azimuth) * forward + np.sin(azimuth) * cross(upward, forward)
    backward = np.cos(elevation) * level + np.sin(elevation) * upward
    # The derivative of `backward` along the meridian: it stays defined straight above and below.
    above = np.cos(elevation) * upward - np.sin(elevation) * level
    side = cross(above, backward)
    side, above = np.cos(roll) * side + np.sin(roll) * above, np.cos(roll) * above - np.sin(roll) * side
    return np.column_stack([side, above, backward])


def frame(
    points: Floats, cameras: Sequence[Camera], aspect: float, up: str | None, front: str | None, centred: bool = False
) -> list[Shot]:
    """Place cameras so that the points fill the picture, all at one scale.

    Every point gives four inequalities, one for each side of the picture, linear in the distance and the sideways
    shift. The smallest distance that satisfies them is the mean of the two opposite maxima, and their difference is the
    shift that centres the picture.

    Args:
        points: normalised positions, shape [N, 3], around the origin.
        cameras: directions of view; they share the distance of the one that needs most.
        aspect: width over height.
        up: the upward axis; None is y.
        front: the axis of the front view.
        centred: keep the origin in the middle, as a turntable must.
    """
    # In radii of the subject: how far in front of it the camera stands at least, and so its nearest plane of drawing.
    clearance = 1e-3
    far_room = 1.2, 0.1  # factor and addition, by which the farthest plane of drawing lies behind the subject
    smallest_view = 1e-9  # radii: half the height of a view of a single point
    placed = []
    for camera in cameras:
        axes = camera_axes(camera, up or "y", front)
        x, y, z = (points @ axes).T
        perspective = camera.projection == "perspective"
        depth = z if perspective else np.zeros_like(z)
        opening = np.tan(np.radians(camera.field_of_view) / 2.0) if perspective else 1.0
        tall = opening * (1.0 - 2.0 * camera.margin)
        wide = tall * aspect
        if centred:
            shift, distance = np.zeros(2), float(np.max(depth + np.maximum(np.abs(x) / wide, np.abs(y) / tall)))
        else:
            right, left = np.max(depth + x / wide), np.max(depth - x / wide)
            top, bottom = np.max(depth + y / tall), np.max(depth - y / tall)
            distance = float(max(right + left, top + bottom) / 2.0)
            shift = np.array([(right - left) / 2.0 * wide, (top - bottom) / 2.0 * tall])
        placed.append((axes, shift, distance, perspective, opening / camera.zoom, float(z.min()), float(z.max())))
    shared = max(distance for _, _, distance, *_ in placed)
    shots: list[Shot] = []
    for axes, shift, _, perspective, half_height, lowest, highest in placed:
        half_height *= 1.0 if perspective else max(shared, smallest_view)
        distance = max(shared, highest + clearance) if perspective else 3.0
        pose = np.eye(4)
        pose[:3, :3] = axes
        pose[:3, 3] = axes @ np.array([*shift, distance])
        near = max((distance - highest) * 0.5, clearance)
        far = (distance - lowest) * far_room[0] + far_room[1]
        shots.append(Shot(pose, perspective, float(half_height * aspect), float(half_height), near, far))
    return shots


@dataclass(frozen=True)
class Light:
    """A set of lights that moves with the camera, and the gloss of the surface under them.

    Attributes:
        directional: pairs (direction towards the light, intensity); directions in the camera's frame, x to the right,
            y up, z towards the viewer. At most four. An intensity of π lights a white surface facing it fully.
        sky: ambient light from above, linear; 1 returns the colour of the surface itself.
        ground: ambient light from below, linear.
        roughness: 0 (mirror) to 1 (chalk).
        unlit: draw the colours themselves, without any light.
    """

    directional: tuple[tuple[tuple[float, float, float], float], ...] = ()
    sky: float = 1.0
    ground: float = 1.0
    roughness: float = 0.6
    unlit: bool = False

    def __post_init__(self) -> None:
        if len(self.directional) > 4:
            raise OmtwarpError(f"{len(self.directional)} directional lights given, at most 4 can be drawn")

    def unit_directions(self) -> list[tuple[np.ndarray, float]]:
        """Scale the directions of directional lights to unit length."""
        return [(np.asarray(way, float) / np.linalg.norm(way), float(power)) for way, power in self.directional]


LIGHTS = {
    # A key light over the left shoulder, a fill from the right and a rim from behind, which draws the upper outline.
    "studio": Light((((-0.7, 0.8, 0.9), 2.4), ((1.0, 0.1, 0.6), 0.65), ((0.0, 0.6, -1.0), 0.7)), sky=0.36, ground=0.17),
    # Little contrast, for colours that are read as values.
    "soft": Light(directional=(((-0.4, 0.6, 1.0), 1.1), ((0.8, 0.0, 0.8), 0.5)), sky=0.68, ground=0.5, roughness=0.9),
    "flat": Light(unlit=True),
}


def as_light(light: str | Light) -> Light:
    """Return a :class:`Light`, or one of the sets ``studio``, ``soft`` and ``flat`` by name.

    Raises:
        OmtwarpError: no set of lights has this name.
    """
    if isinstance(light, Light):
        return light
    check_word("light", light, LIGHTS)
    return LIGHTS[light]
