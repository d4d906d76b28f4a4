"""Forty-eight shapes of sixteen kinds, in the axes of different programs, with the views that show them well.

Each kind is made of simple bodies, with z upwards and -y ahead, in three variants; every variant is then put into the
axes of a file: y upwards or z upwards, and the front towards any side.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import NDArray

Points = NDArray[np.float64]
BALLS = [trimesh.creation.icosphere(subdivisions=2), trimesh.creation.icosphere(subdivisions=3)]
Vary = Callable[[float], float]
SIDES = {
    "front": (0, -1, 0),
    "back": (0, 1, 0),
    "right": (-1, 0, 0),
    "left": (1, 0, 0),
    "up": (0, 0, 1),
    "down": (0, 0, -1),
}
# Axes of files, as rows of what x, y and z of a shape become: y up with the front to z or -z or x, z up to -y, y, x.
FILES = {
    "y to z": ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
    "z to -y": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "y to -z": ((-1, 0, 0), (0, 0, 1), (0, 1, 0)),
    "z to x": ((0, 1, 0), (-1, 0, 0), (0, 0, 1)),
    "y to x": ((0, 0, -1), (-1, 0, 0), (0, 1, 0)),
    "z to y": ((-1, 0, 0), (0, -1, 0), (0, 0, 1)),
}


@dataclass(frozen=True)
class Standing:
    """A shape, and which views of it are right.

    Attributes:
        name: kind and variant.
        vertices, faces: the shape.
        ups: upward axes that are right, such as ``"z"``.
        fronts: axes towards the viewer that are right.
    """

    name: str
    vertices: Points
    faces: NDArray[np.int64]
    ups: frozenset[str]
    fronts: frozenset[str]


class Body:
    """Simple bodies put together; those of a pair are mirrored in x."""

    def __init__(self) -> None:
        self.parts: list[trimesh.Trimesh] = []
        self.eggs: dict[int, tuple[Points, Points]] = {}  # centres and radii of parts that hide what is in them

    def egg(self, centre, radii, pair: bool = False) -> None:
        for side in (1, -1) if pair else (1,):
            self._ball(np.array(centre) * (side, 1, 1), np.array(radii), fine=max(radii) >= 0.1)

    def limb(self, start, end, radius: float, pair: bool = False) -> None:
        for side in (1, -1) if pair else (1,):
            ends = np.array([start, end], dtype=float) * (side, 1, 1)
            self.tube(np.linspace(0, 1, 8)[:, None] * (ends[1] - ends[0]) + ends[0], radius)

    def tube(self, points, radii) -> None:
        """Put a tube of changing radius about a curve."""
        for place, radius in zip(points, np.broadcast_to(radii, len(points)), strict=True):
            self._ball(place, np.full(3, radius), fine=False)

    def box(self, centre, sides, pair: bool = False) -> None:
        for side in (1, -1) if pair else (1,):
            box = trimesh.creation.box(sides)
            box.apply_translation(np.array(centre) * (side, 1, 1))
            self.parts.append(box)

    def turned(self, profile) -> None:
        """Turn a profile of radius and height about the vertical axis."""
        self.parts.append(trimesh.creation.revolve(np.array(profile, dtype=float), sections=48))

    def outside(self) -> tuple[Points, NDArray[np.int64]]:
        """Return vertices and faces, without faces that a ball hides."""
        vertices, faces, count = [], [], 0
        for number, part in enumerate(self.parts):
            middle = np.asarray(part.triangles_center)
            hidden = np.zeros(len(middle), dtype=bool)
            for other, (centre, radii) in self.eggs.items():
                hidden |= (other != number) & ((((middle - centre) / radii) ** 2).sum(axis=1) < 0.97)
            vertices.append(np.asarray(part.vertices))
            faces.append(np.asarray(part.faces)[~hidden] + count)
            count += len(part.vertices)
        whole = np.concatenate(faces)
        used, own = np.unique(whole, return_inverse=True)
        return np.concatenate(vertices)[used], own.reshape(-1, 3)

    def _ball(self, centre: Points, radii: Points, fine: bool) -> None:
        self.eggs[len(self.parts)] = centre, radii
        self.parts.append(trimesh.Trimesh(BALLS[fine].vertices * radii + centre, BALLS[fine].faces, process=False))


def cat(body: Body, vary: Vary) -> None:
    body.egg((0, 0.1, 0.45), (0.16, 0.42 * vary(0.2), 0.17))
    head = 0.62 * vary(0.1)
    body.egg((0, -0.42, head), (0.15, 0.15, 0.14))
    body.egg((0, -0.55, head - 0.04), (0.05, 0.05, 0.04))
    body.egg((0.07, -0.54, head + 0.04), (0.03, 0.02, 0.03), pair=True)
    body.limb((0.09, -0.40, head + 0.11), (0.11, -0.40, head + 0.2), 0.03, pair=True)
    for y in (-0.22, 0.4):
        body.limb((0.1, y, 0.4), (0.1, y, 0.05), 0.05, pair=True)
        body.egg((0.1, y - 0.05, 0.04), (0.055, 0.08, 0.04), pair=True)
    t = np.linspace(0, 1, 12)
    body.tube(np.stack([0 * t, 0.5 + 0.35 * t, 0.5 + 0.35 * t**2 * vary(0.5)], axis=1), 0.035)


def sitting_dog(body: Body, vary: Vary) -> None:
    body.egg((0, 0.12, 0.3), (0.2, 0.24, 0.28))
    body.egg((0, -0.05, 0.55 * vary(0.1)), (0.16, 0.16, 0.25))
    head = 0.88 * vary(0.05)
    body.egg((0, -0.12, head), (0.14, 0.16, 0.13))
    body.egg((0, -0.3, head - 0.04), (0.07, 0.13, 0.06))
    body.egg((0.06, -0.24, head + 0.06), (0.025, 0.02, 0.025), pair=True)
    body.egg((0.15, -0.08, head), (0.03, 0.06, 0.12), pair=True)
    body.limb((0.1, -0.16, 0.5), (0.1, -0.2, 0.05), 0.055, pair=True)
    body.egg((0.1, -0.26, 0.04), (0.06, 0.1, 0.04), pair=True)
    body.egg((0.19, 0.1, 0.14), (0.09, 0.2, 0.14), pair=True)
    body.limb((0, 0.34, 0.06), (0, 0.62, 0.06), 0.04)


def penguin(body: Body, vary: Vary) -> None:
    body.egg((0, 0, 0.5), (0.25, 0.23 * vary(0.1), 0.42))
    head = 0.98 * vary(0.04)
    body.egg((0, -0.02, head), (0.16, 0.16, 0.16))
    body.limb((0, -0.16, head - 0.02), (0, -0.3 * vary(0.1), head - 0.05), 0.03)
    body.egg((0.08, -0.14, head + 0.04), (0.025, 0.02, 0.025), pair=True)
    body.egg((0.28, 0.02, 0.52), (0.04, 0.12, 0.28), pair=True)
    body.egg((0.12, -0.12, 0.05), (0.09, 0.16, 0.04), pair=True)
    body.egg((0, 0.24, 0.14), (0.08, 0.1, 0.05))


def person(body: Body, vary: Vary) -> None:
    body.egg((0, 0, 1.15), (0.2, 0.12, 0.33))
    body.egg((0, -0.01, 1.62), (0.1, 0.12, 0.14))
    body.egg((0, -0.13, 1.6), (0.02, 0.03, 0.03))
    body.egg((0.04, -0.11, 1.65), (0.018, 0.015, 0.015), pair=True)
    out = 0.5 * vary(0.3)
    body.limb((0.2, 0, 1.4), (0.2 + out * 0.6, 0, 1.4 - out), 0.05, pair=True)
    body.limb((0.1, 0, 0.85), (0.12, 0, 0.08), 0.075, pair=True)
    body.egg((0.12, -0.07, 0.04), (0.055, 0.14, 0.045), pair=True)


def horse(body: Body, vary: Vary) -> None:
    body.egg((0, 0, 1.0), (0.24, 0.62 * vary(0.1), 0.26))
    body.limb((0, -0.5, 1.1), (0, -0.85, 1.55 * vary(0.05)), 0.12)
    body.limb((0, -0.85, 1.6), (0, -1.2, 1.4), 0.09)
    body.limb((0.07, -0.82, 1.68), (0.08, -0.82, 1.8), 0.025, pair=True)
    for y in (-0.42, 0.45):
        body.limb((0.16, y, 0.9), (0.16, y, 0.06), 0.06, pair=True)
    body.limb((0, 0.62, 1.1), (0, 0.8, 0.5), 0.05)


def bird(body: Body, vary: Vary) -> None:
    body.egg((0, 0.05, 0.5), (0.2, 0.32 * vary(0.1), 0.2))
    body.egg((0, -0.26, 0.78), (0.13, 0.14, 0.13))
    body.limb((0, -0.4, 0.77), (0, -0.54, 0.74), 0.025)
    body.egg((0.08, -0.35, 0.82), (0.02, 0.02, 0.02), pair=True)
    body.egg((0, 0.46, 0.5), (0.09, 0.2, 0.03))
    body.limb((0.08, 0, 0.34), (0.08, 0, 0.04), 0.02, pair=True)
    body.egg((0.08, -0.06, 0.02), (0.06, 0.12, 0.02), pair=True)


def foot(body: Body, vary: Vary) -> None:
    body.egg((0, 0.0, 0.1), (0.13, 0.45 * vary(0.1), 0.1))
    body.egg((0.03, -0.3, 0.06), (0.15, 0.2, 0.06))
    for k in range(5):
        body.egg((0.14 - 0.06 * k, -0.5 + 0.03 * k, 0.04), (0.032, 0.06, 0.04))
    body.limb((0, 0.28, 0.2), (0, 0.3, 0.6 * vary(0.2)), 0.11)
    body.egg((0, 0.36, 0.07), (0.1, 0.12, 0.07))


def bottle(body: Body, vary: Vary) -> None:
    r, h = 0.16 * vary(0.3), 0.6 * vary(0.1)
    body.turned([(0, 0), (r, 0), (r, 0.1), (r, h), (0.05, h + 0.2), (0.05, h + 0.38), (0, h + 0.38)])


def mug(body: Body, vary: Vary) -> None:
    h = 0.4 * vary(0.3)
    body.turned([(0, 0), (0.2, 0), (0.22, h), (0.19, h), (0.17, 0.04), (0, 0.04)])
    t = np.linspace(-1.3, 1.3, 14)
    body.tube(np.stack([0.2 + 0.14 * np.cos(t), 0 * t, h / 2 + 0.15 * np.sin(t)], axis=1), 0.025)


def brain(body: Body, vary: Vary) -> None:
    body.egg((0.32, 0, 0.62), (0.33, 0.85 * vary(0.1), 0.5), pair=True)
    body.egg((0.42, -0.3, 0.32), (0.24, 0.42, 0.24), pair=True)
    body.egg((0.22, 0.5, 0.3), (0.26, 0.3, 0.2), pair=True)
    rng = np.random.default_rng(int(1000 * vary(0.1)))
    for _ in range(40):
        way = rng.normal(size=3) * (1, 1, 1)
        way /= np.linalg.norm(way)
        body.egg((0.32 + 0.3 * abs(way[0]), 0.8 * way[1], 0.62 + 0.46 * abs(way[2])), (0.06, 0.08, 0.06), pair=True)


def banana(body: Body, vary: Vary) -> None:
    t = np.linspace(-1, 1, 30)
    body.tube(np.stack([0.9 * np.sin(t), 0 * t, 0.7 * (1 - np.cos(t)) * vary(0.3)], axis=1), 0.14 * (1.02 - t**6 * 0.8))


def femur(body: Body, vary: Vary) -> None:
    t = np.linspace(0, 1, 30)
    body.tube(np.stack([0.02 * np.sin(3 * t), -0.04 * np.sin(np.pi * t), t], axis=1), 0.045 * vary(0.1))
    body.egg((0.05, 0.01, 0.0), (0.055, 0.07, 0.06))
    body.egg((-0.05, 0.01, 0.01), (0.055, 0.065, 0.06))
    body.limb((0, 0, 0.97), (0.11, -0.02, 1.04), 0.04)
    body.egg((0.13, -0.02, 1.05), (0.055, 0.055, 0.055))
    body.egg((-0.04, 0.01, 1.0), (0.05, 0.05, 0.06))


def asteroid(body: Body, vary: Vary) -> None:
    rng = np.random.default_rng(int(1e6 * vary(0.4)))
    ball = trimesh.creation.icosphere(subdivisions=4)
    bumps = rng.normal(size=(12, 3))
    bumps /= np.linalg.norm(bumps, axis=1)[:, None]
    high = (rng.uniform(-0.25, 0.25, 12) * np.exp(4 * (ball.vertices @ bumps.T - 1))).sum(axis=1)
    ball.vertices *= (1 + high)[:, None] * (1, 0.8, 0.7)
    body.parts.append(ball)


def bust(body: Body, vary: Vary) -> None:
    body.egg((0, 0, 0.95), (0.2, 0.24, 0.28 * vary(0.1)))
    body.egg((0, -0.25, 0.92), (0.035, 0.06, 0.07))
    body.egg((0.08, -0.2, 1.0), (0.04, 0.025, 0.025), pair=True)
    body.egg((0, -0.22, 0.8), (0.07, 0.03, 0.02))
    body.egg((0.2, 0.02, 0.95), (0.03, 0.06, 0.08), pair=True)
    body.limb((0, 0.03, 0.7), (0, 0.03, 0.5), 0.12)
    body.egg((0, 0.02, 0.36), (0.42, 0.2, 0.2 * vary(0.1)))
    body.box((0, 0.02, 0.1), (0.4, 0.26, 0.2))


def chair(body: Body, vary: Vary) -> None:
    body.box((0, 0, 0.45), (0.5, 0.5, 0.06))
    body.box((0, 0.22, 0.78), (0.5, 0.05, 0.6 * vary(0.2)))
    for y in (-0.21, 0.21):
        body.box((0.21, y, 0.21), (0.06, 0.06, 0.42), pair=True)


def fish(body: Body, vary: Vary) -> None:
    body.egg((0, 0, 0.3), (0.12, 0.6 * vary(0.1), 0.24))
    body.egg((0, 0.72, 0.32), (0.03, 0.14, 0.26))
    body.egg((0, 0.05, 0.54), (0.02, 0.22, 0.1))
    body.egg((0.11, -0.15, 0.24), (0.02, 0.1, 0.05), pair=True)
    body.egg((0.08, -0.42, 0.36), (0.03, 0.03, 0.03), pair=True)


FRONT = ("front",)
AROUND = ("front", "back", "left", "right")
# Of every kind: which sides may be seen, and which ends may be up.
KINDS: dict[Callable[[Body, Vary], None], tuple[tuple[str, ...], tuple[str, ...]]] = {
    cat: (("front", "left", "right"), ("up",)),
    sitting_dog: (FRONT, ("up",)),
    penguin: (FRONT, ("up",)),
    person: (FRONT, ("up",)),
    horse: (("front", "left", "right"), ("up",)),
    bird: (("front", "left", "right"), ("up",)),
    foot: (("front", "left", "right"), ("up",)),
    bottle: (AROUND, ("up",)),
    mug: (AROUND, ("up",)),
    brain: (AROUND, ("up",)),
    banana: (("front", "back", "up", "down"), ("up", "down", "front", "back")),
    femur: (AROUND, ("up", "down", *AROUND)),
    asteroid: (tuple(SIDES), tuple(SIDES)),
    bust: (FRONT, ("up",)),
    chair: (("front", "left", "right"), ("up",)),
    fish: (("left", "right"), ("up",)),
}


def axis_name(way: NDArray) -> str:
    k = int(np.argmax(np.abs(way)))
    return ("-" if way[k] < 0 else "") + "xyz"[k]


def standing_shapes() -> list[Standing]:
    """Return all shapes, every kind in three variants and files."""
    shapes = []
    for number, (make, (fronts, ups)) in enumerate(KINDS.items()):
        for variant in range(3):
            rng = np.random.default_rng(10 * number + variant)
            body = Body()
            make(body, lambda most, rng=rng: 1.0 + most * rng.uniform(-1.0, 1.0))
            points, faces = body.outside()
            file = list(FILES)[(number + 2 * variant + variant // 2) % 6]
            frame = np.array(FILES[file], dtype=float).T  # a point p becomes p @ frame.T of x to file
            names = {side: axis_name(np.array(way) @ np.array(FILES[file])) for side, way in SIDES.items()}
            vertices = points @ np.array(FILES[file], dtype=float)
            assert np.linalg.det(frame) > 0
            shapes.append(
                Standing(
                    f"{make.__name__} {variant + 1}, {file}", vertices, faces,
                    frozenset(names[up] for up in ups), frozenset(names[front] for front in fronts),
                )
            )  # fmt: skip
    return shapes
