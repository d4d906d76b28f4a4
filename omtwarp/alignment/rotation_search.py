"""The rotation under which two sets of functions on the sphere agree best.

With complex coefficients a and b of degree l up to L, f turned by R = Rz(α) Ry(β) Rz(γ) has the correlation

    C(R) = Σ conj(b_lm) D^l_mm'(R) a_lm',    D^l = exp(-iα J_z) exp(-iβ J_y) exp(-iγ J_z)

with g. In the eigenvectors of J_y it is a trigonometric polynomial in all three angles, so that one fast Fourier
transform in three dimensions gives it on a grid of all rotations [1]_ [2]_. From the best grid points Newton's
method climbs to the maximum; the derivatives are products with the matrices J.

.. [1] T. Risbo, "Fourier transform summation of Legendre series and D-functions", J. Geodesy 70 (1996).
.. [2] P. J. Kostelec, D. N. Rockmore, "FFTs on the rotation group", J. Fourier Anal. Appl. 14 (2008).
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter
from scipy.spatial.transform import Rotation

from omtwarp.geometry.harmonics import degree_of, orders
from omtwarp.mesh.arrays import ROUND_OFF, TINY, Floats

Complex = NDArray[np.complex128]


@dataclass(frozen=True)
class Best:
    """The best rotation that was found.

    Attributes:
        rotation: takes points of the first sphere to the second, shape [3, 3].
        score: correlation there, 1 for functions that agree up to a factor.
        runner_up: correlation at the next maximum that is at least 5 degrees away; -1 where there is none.
    """

    rotation: Floats
    score: float
    runner_up: float


def complex_coefficients(real: Floats) -> Complex:
    """Convert real coefficients to those of complex harmonics with the Condon-Shortley phase, shape [(L + 1)², K]."""
    m = orders(degree_of(len(real)))
    opposite, m = real[np.arange(len(m)) - 2 * m], m[:, None]  # of order -m
    positive, negative = (-1.0) ** m * (real - 1j * opposite), opposite + 1j * real
    return np.where(m == 0, real, np.where(m > 0, positive, negative) / np.sqrt(2.0))


@lru_cache(maxsize=64)
def momentum(degree: int) -> tuple[Complex, Complex, Complex]:
    """Return the angular momentum matrices J_x, J_y and J_z of a degree l, with orders from -l to l."""
    m = np.arange(-degree, degree)
    raising = np.diag(np.sqrt(degree * (degree + 1) - m * (m + 1.0)), -1).astype(np.complex128)
    lowering = raising.conj().T
    diagonal = np.diag(np.arange(-degree, degree + 1)).astype(np.complex128)
    return (raising + lowering) / 2.0, (raising - lowering) / 2.0j, diagonal


@lru_cache(maxsize=64)
def _eigenvectors(degree: int) -> tuple[Complex, Complex]:
    """Return the eigenvectors of J_y as columns, for eigenvalues from -l to l, and their conjugates as rows."""
    vectors = np.asarray(np.linalg.eigh(momentum(degree)[1])[1])
    return vectors, vectors.conj().T


def rotation_blocks(rotation: Floats, degree: int) -> list[Complex]:
    """Return the rotation matrix D^l of every degree l up to the highest."""
    waves = [np.exp(-1j * angle * np.arange(-degree, degree + 1)) for angle in _zyz_angles(rotation)]
    blocks = []
    for n in range(degree + 1):
        vectors, conjugates = _eigenvectors(n)
        alpha, beta, gamma = (wave[degree - n : degree + n + 1] for wave in waves)
        blocks.append(alpha[:, None] * ((vectors * beta) @ conjugates) * gamma)
    return blocks


def _zyz_angles(rotation: Floats) -> tuple[float, float, float]:
    """Return α, β and γ of Rz(α) Ry(β) Rz(γ); γ is 0 where only its sum or difference with α counts."""
    across = float(np.hypot(rotation[0, 2], rotation[1, 2]))
    beta = float(np.arctan2(across, rotation[2, 2]))
    if across < ROUND_OFF:
        return float(np.arctan2(-rotation[0, 1], rotation[1, 1])), beta, 0.0
    alpha = float(np.arctan2(rotation[1, 2], rotation[0, 2]))
    return alpha, beta, float(np.arctan2(rotation[2, 1], -rotation[2, 0]))


def rotated(coefficients: Complex, rotation: Floats) -> Complex:
    """Rotate a function: return the coefficients of f(R⁻¹ x), shape [(L + 1)², K]."""
    blocks = rotation_blocks(rotation, degree_of(len(coefficients)))
    return np.concatenate([block @ coefficients[n * n : (n + 1) ** 2] for n, block in enumerate(blocks)])


def correlation_grid(a: Complex, b: Complex, size: int) -> Floats:
    """Return the correlation C at α = 2π p / size, β = 2π q / size, γ = 2π r / size, [size, size // 2 + 1, size]."""
    degree = degree_of(len(a))
    waves = np.zeros((size, size, size), dtype=np.complex128)
    for n in range(degree + 1):
        part, (vectors, conjugates) = slice(n * n, (n + 1) ** 2), _eigenvectors(n)
        products = b[part].conj() @ a[part].T  # summed over features, [m, m']
        places = np.arange(-n, n + 1) % size
        waves[np.ix_(places, places, places)] += np.einsum("mp,mk,kp->mkp", products, vectors, conjugates)
    return np.asarray(np.fft.fftn(waves).real[:, : size // 2 + 1])


def best_rotation(a: Complex, b: Complex) -> Best:
    """Find the rotation that brings a function nearest to another; the means of both do not count.

    Args:
        a, b: complex coefficients, shape [(L + 1)², K], weighted as features are to count.
    """
    return best_rotations(a, b)[0]


def best_rotations(a: Complex, b: Complex) -> list[Best]:
    """Find the rotations at which two functions agree best, more than 5 degrees apart, the best first.

    Args:
        a, b: as for :func:`best_rotation`.
    """
    a, b = a.copy(), b.copy()
    a[0] = b[0] = 0.0
    size = 4 * (degree_of(len(a)) + 1)
    norm = float(np.linalg.norm(a) * np.linalg.norm(b))
    if norm == 0.0:
        return [Best(np.eye(3), 0.0, -1.0)]
    climbed = [_climb(a, b, start) for start in _starts(correlation_grid(a, b, size), size)]
    climbed.sort(key=lambda entry: -entry[1])
    distinct: list[tuple[Floats, float]] = []
    for entry in climbed:
        if all(np.degrees(Rotation.from_matrix(entry[0] @ other[0].T).magnitude()) > 5.0 for other in distinct):
            distinct.append(entry)
    after = [value / norm for _, value in distinct[1:]] + [-1.0]
    return [Best(turn, value / norm, other) for (turn, value), other in zip(distinct, after, strict=True)]


def improved(a: Complex, b: Complex, best: Best, weights: Floats) -> Best:
    """Continue from a rotation with other weights of the features.

    Args:
        a, b: as for :func:`best_rotation`.
        best: what that found.
        weights: of the features, shape [K].
    """
    a, b = a.copy(), b.copy()
    a[0] = b[0] = 0.0
    norm = float(np.linalg.norm(a) * np.linalg.norm(b))
    if norm == 0.0:
        return best
    rotation, _ = _climb(a * weights, b * weights, best.rotation)
    return Best(rotation, float(np.vdot(b, rotated(a, rotation)).real) / norm, best.runner_up)


def _starts(grid: Floats, size: int) -> list[Floats]:
    """Return the highest local maxima of the correlation on the grid, where the climbs start."""
    # Newton starts from so many of the grid's local maxima, at least start_apart degrees from one another. With half
    # and twice of these a turned creature is turned back to round-off.
    starts = 8
    start_apart = 15.0
    peaks = np.flatnonzero(grid == maximum_filter(grid, size=3, mode=("wrap", "nearest", "wrap")))
    order = peaks[np.argsort(-grid.ravel()[peaks], kind="stable")]
    chosen: list[Floats] = []
    smallest = 1.0 + 2.0 * np.cos(np.radians(start_apart))
    for place in order:
        angles = 2.0 * np.pi / size * np.array(np.unravel_index(place, grid.shape))
        rotation = Rotation.from_euler("ZYZ", angles).as_matrix()
        if all(np.einsum("ij,ij->", rotation, other) < smallest for other in chosen):
            chosen.append(rotation)
            if len(chosen) == starts:
                break
    return chosen


def _climb(a: Complex, b: Complex, rotation: Floats) -> tuple[Floats, float]:
    """Run Newton's method on the rotation group, with steps halved until they climb."""
    turned = rotated(a, rotation)
    value = float(np.vdot(b, turned).real)
    for _ in range(40):  # steps at most
        gradient, hessian = derivatives(turned, b)
        bends, axes = np.linalg.eigh(hessian)
        # Where the function is not concave, climb along the slope instead of to a saddle.
        move = axes @ (axes.T @ gradient / np.maximum(np.abs(bends), ROUND_OFF * np.abs(bends).max() + TINY))
        length = float(np.linalg.norm(move))
        # Radians: where steps end. The correlation is flat to round-off 1e-8 away from its maximum; Newton's step is
        # finer.
        if length < 1e-12:
            return rotation, value
        # Longest step: radians; half the shortest wave of degree 16
        move *= min(1.0, 0.2 / length)
        # Most halvings, of a step: it is then below 1e-9 of the first, where the correlation climbs by less than
        # round-off
        for _ in range(30):
            candidate = Rotation.from_rotvec(move).as_matrix() @ rotation
            ahead = rotated(a, candidate)
            reached = float(np.vdot(b, ahead).real)
            if reached > value:
                break
            move = move / 2.0
        else:
            return rotation, value
        rotation, turned, value = candidate, ahead, reached
    return rotation, value


def derivatives(turned: Complex, b: Complex) -> tuple[Floats, Floats]:
    """Return the correlation's first and second derivatives by a small further rotation, [3] and [3, 3]."""
    gradient, hessian = np.zeros(3), np.zeros((3, 3))
    for n in range(1, degree_of(len(b)) + 1):
        part = slice(n * n, (n + 1) ** 2)
        moved = [j @ turned[part] for j in momentum(n)]
        left = [j @ b[part] for j in momentum(n)]  # J is Hermitian
        for k in range(3):
            gradient[k] += np.vdot(b[part], moved[k]).imag  # the real part of -i times it
            for m in range(3):
                hessian[k, m] -= np.vdot(left[k], moved[m]).real
    return gradient, (hessian + hessian.T) / 2.0
