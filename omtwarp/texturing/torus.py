"""Patterns that close up both ways on a flat torus."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from omtwarp.errors import OmtwarpError
from omtwarp.texturing.atlas import check_size, is_power_of_two

Floats = NDArray[np.float64]

PATTERNS = ("circles", "checker")
LIGHT = np.array([0.96, 0.94, 0.90])  # sRGB between the circles, and of every other field


def torus_pattern(name: str, lattice: Floats, size: int | None = None) -> NDArray[np.uint8]:
    """Return a picture of a flat torus: u to the right along the first lattice vector, v upwards along the second.

    Args:
        name: ``circles``, all of one size and round on the torus, or ``checker``.
        lattice: the two vectors, as rows, shape [2, 2].
        size: width in texels; by default such that the picture has about two million. Where the width is a power of
            two, as by default, the height is the nearest one too.

    Returns:
        uint8, shape [H, W, 3].

    Raises:
        OmtwarpError: another pattern, or a size that is too large.
    """
    if name not in PATTERNS:
        raise OmtwarpError(f"the pattern '{name}' is for the sphere: a torus takes {' or '.join(PATTERNS)}")
    along = np.linalg.norm(lattice, axis=1)
    ratio = float(along[1] / along[0])
    # Texels, of a pattern, as many as a pattern 2048 wide has on the sphere
    wide = _nearest_power(np.sqrt((1 << 21) / ratio)) if size is None else size
    high = _nearest_power(wide * ratio) if is_power_of_two(wide) else round(wide * ratio)
    width, height = check_size((max(wide, 16), max(high, 16)))
    u = (np.arange(width) + 0.5) / width
    v = 1.0 - (np.arange(height) + 0.5) / height
    turn = 2.0 * np.pi * v[:, None]
    tint = np.stack([0.33 + 0.22 * np.cos(turn + shift) for shift in (0.4, -1.9, 2.6)], axis=-1)
    share = _checks(lattice, u, v) if name == "checker" else _circles(lattice, u, v)
    picture = LIGHT + share[..., None] * (tint - LIGHT)
    return np.rint(255.0 * picture).astype(np.uint8)


def _nearest_power(number: float) -> int:
    """Return the power of two whose ratio to a positive number is nearest to 1."""
    return 2 ** max(round(float(np.log2(number))), 0)


def _checks(lattice: Floats, u: Floats, v: Floats) -> Floats:
    """Draw a checker: 1 on its dark cells, which are as nearly square as even numbers allow, shape [H, W]."""
    checks = 6  # fields along the shorter lattice vector, an even number so that the picture closes up
    along = np.linalg.norm(lattice, axis=1)
    columns, rows = (max(2, 2 * round(checks / 2 * float(side / along.min()))) for side in along)
    return ((np.floor(rows * v)[:, None] + np.floor(columns * u)[None, :]) % 2.0).astype(np.float64)


def _circles(lattice: Floats, u: Floats, v: Floats) -> Floats:
    """Draw circles: 1 inside, 0 outside and between the two at their rims, shape [H, W]."""
    area = abs(float(np.linalg.det(lattice)))
    first = float(np.linalg.norm(lattice[0]))
    # Circles, as many as the sphere's pattern has
    apart = np.sqrt(2.0 / np.sqrt(3.0) * area / 162)
    columns = max(1, round(first / apart))
    rows = max(2, 2 * round(area / first / (apart * np.sqrt(3.0) / 2.0) / 2.0))
    offsets = np.array([(j, i) for j in range(-2, 3) for i in np.arange(-2.0, 2.5, 0.5)])
    offsets = offsets[(offsets[:, 1] % 1.0 == 0.5) == (offsets[:, 0] % 2.0 == 1.0)]
    steps = np.stack([offsets[:, 1] / columns, offsets[:, 0] / rows], axis=1) @ lattice
    lengths = np.linalg.norm(steps, axis=1)
    least = float(lengths[lengths > 0.0].min())
    # Coverage: the share of the torus that circles cover
    radius = min(float(np.sqrt(0.56 * area / (columns * rows * np.pi))), 0.46 * least)
    texel = np.sqrt(area / (len(u) * len(v)))
    nearest = np.full((len(v), len(u)), np.inf)
    row = np.round(v * rows)
    for shift in range(-1, 2):
        j = row + shift
        half = 0.5 * (j % 2.0)
        for more in range(-1, 2):
            i = np.round(u[None, :] * columns - half[:, None]) + half[:, None] + more
            du, dv = u[None, :] - i / columns, (v - j / rows)[:, None]
            x, y = du * lattice[0, 0] + dv * lattice[1, 0], du * lattice[0, 1] + dv * lattice[1, 1]
            np.minimum(nearest, np.hypot(x, y), out=nearest)
    return np.clip(0.5 + (radius - nearest) / texel, 0.0, 1.0)
