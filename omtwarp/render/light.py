"""Lights: their directions around the camera, and the gloss of the surface."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from omtwarp.errors import OmtwarpError


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
    "studio": Light(
        directional=(((-0.7, 0.8, 0.9), 2.4), ((1.0, 0.1, 0.6), 0.65), ((0.0, 0.6, -1.0), 0.7)),
        sky=0.36,
        ground=0.17,
        roughness=0.6,
    ),
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
    if light not in LIGHTS:
        raise OmtwarpError(f"unknown light '{light}': use one of {', '.join(LIGHTS)}")
    return LIGHTS[light]
