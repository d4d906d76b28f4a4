"""Real, orthonormal spherical harmonics on the unit sphere.

The convention, used throughout the package: Y_lm has ∫ Y_lm² dA = 1, no Condon-Shortley phase, cosines for m > 0 and
sines for m < 0,

    Y_l0 = N_l0 P_l0(cos θ),  Y_lm = √2 N_lm P_lm(cos θ) cos mφ,  Y_l,-m = √2 N_lm P_lm(cos θ) sin mφ,

with θ the angle from the z axis, φ = atan2(y, x), N_lm² = (2l + 1) (l - m)! / (4π (l + m)!) and P_lm ≥ 0 near the north
pole. Y_00 = 1 / √(4π), and (Y_11, Y_1,-1, Y_10) = √(3 / 4π) (x, y, z). pyshtools calls this ``ortho`` with csphase 1.
The coefficient of Y_lm has the index l² + l + m.
"""

from collections.abc import Iterator

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import sph_legendre_p_all

from omtwarp.errors import OmtwarpError
from omtwarp.mesh.arrays import Floats, real_numbers, whole_number


def check_degree(degree: int) -> int:
    """Check a degree from 0 to 500, and return it as an int.

    Raises:
        OmtwarpError: the degree is no whole number, or is out of range.
    """
    # Highest degree: SciPy's recurrence has been compared with pyshtools' up to here
    return whole_number(degree, "the degree", most=500)


def real_harmonics(points: ArrayLike, degree: int) -> Floats:
    """Evaluate all real spherical harmonics up to a degree.

    Args:
        points: vectors of any positive length, shape [N, 3].
        degree: the highest degree L, from 0 to 500.

    Returns:
        float64, shape [N, (L + 1)²]; column l² + l + m is Y_lm.

    Raises:
        OmtwarpError: points of another shape, or another degree.

    Example:
        >>> from omtwarp.geometry.harmonics import real_harmonics
        >>> (real_harmonics([[0.0, 0.0, 1.0]], 1) ** 2 * 4 * 3.141592653589793).round(12).tolist()
        [[1.0, 0.0, 3.0, 0.0]]
    """
    degree = check_degree(degree)
    directions = real_numbers(points, "points", (None, 3))
    out = np.empty((len(directions), (degree + 1) ** 2))
    # At once: numbers held at once while they are made
    chunk = max(1, (2**22) // ((degree + 1) * (2 * degree + 1)))
    for first in range(0, len(directions), chunk):
        part = slice(first, first + chunk)
        _fill(directions[part], degree, out[part])
    return out


def harmonics_in_parts(points: Floats, degree: int) -> Iterator[tuple[slice, Floats]]:
    """Yield :func:`real_harmonics` at some points at a time, and which these are, so that memory is bounded."""
    chunk = max(1, 2**22 // (degree + 1) ** 2)
    for first in range(0, len(points), chunk):
        part = slice(first, first + chunk)
        yield part, real_harmonics(points[part], degree)


def _fill(directions: Floats, degree: int, out: Floats) -> None:
    x, y, z = directions.T
    # atan2 keeps full accuracy next to the poles, where acos(z) loses half of the digits.
    polar, longitude = np.arctan2(np.hypot(x, y), z), np.arctan2(y, x)
    legendre = sph_legendre_p_all(degree, degree, polar)[0]  # [l, m, N], with the Condon-Shortley phase
    orders = np.arange(1, degree + 1)
    phase = np.sqrt(2.0) * (-1.0) ** orders
    cosines = phase[:, None] * np.cos(orders[:, None] * longitude)
    sines = phase[:, None] * np.sin(orders[:, None] * longitude)
    for n in range(degree + 1):
        centre = n * n + n
        out[:, centre] = legendre[n, 0]
        out[:, centre + 1 : centre + n + 1] = (legendre[n, 1 : n + 1] * cosines[:n]).T
        out[:, centre - n : centre] = (legendre[n, 1 : n + 1] * sines[:n]).T[:, ::-1]


def degrees(degree: int) -> NDArray[np.int64]:
    """Return the degree l of every harmonic up to a degree L, shape [(L + 1)²]."""
    return np.repeat(np.arange(degree + 1), 2 * np.arange(degree + 1) + 1)


def orders(degree: int) -> NDArray[np.int64]:
    """Return the order m of every harmonic up to a degree L, from -l to l, shape [(L + 1)²]."""
    middle = degrees(degree) * (degrees(degree) + 1)
    return np.arange(len(middle)) - middle


def degree_of(count: int) -> int:
    """Return the highest degree L of an expansion with that many coefficients, (L + 1)².

    Raises:
        OmtwarpError: the number is not a square.
    """
    root = round(np.sqrt(count))
    if root < 1 or root * root != count:
        raise OmtwarpError(f"{count} coefficients: a whole number of degrees has 1, 4, 9, 16, ... of them")
    return root - 1


def power_per_degree(coefficients: ArrayLike) -> Floats:
    """Sum the squares of the coefficients of every degree, over all components.

    Args:
        coefficients: shape [(L + 1)²] or [(L + 1)², C].

    Returns:
        float64, shape [L + 1]; the sum over degrees is ∫ |f|² dA over the unit sphere (Parseval).
    """
    values = np.asarray(coefficients, dtype=np.float64)
    squares = (values.reshape(len(values), -1) ** 2).sum(axis=1)
    return np.bincount(degrees(degree_of(len(values))), weights=squares).astype(np.float64)
