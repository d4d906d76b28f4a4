"""A surface, or any data on a sphere, as a sum of real orthonormal spherical harmonics (SPHARM)."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from typing import Literal, TypeAlias, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import cho_factor, cho_solve

from omtwarp.device.threads import blas_threads
from omtwarp.errors import OmtwarpError, check_word
from omtwarp.files.inputs import read_bytes
from omtwarp.files.output import write_text
from omtwarp.geometry.harmonics import check_degree, degree_of, degrees, harmonics_in_parts, orders, power_per_degree
from omtwarp.mesh.arrays import Floats, cross, norms, real_numbers, whole_number, whole_numbers
from omtwarp.mesh.shapes import icosphere
from omtwarp.mesh.surface import Surface, sums_around, triangle_areas

ExpandBy: TypeAlias = Literal["least-squares", "quadrature"]
# Dunavant's rule of degree 4 (1985): barycentric coordinates (1 - 2 a, a, a) in all orders, and weights.
_RULE = ((0.445948490915965, 0.223381589678011), (0.091576213509771, 0.109951743655322))


@dataclass(frozen=True, eq=False)
class Expansion:
    """Coefficients of real orthonormal spherical harmonics, in the convention of :mod:`omtwarp.geometry.harmonics`.

    Attributes:
        coefficients: float64, shape [(L + 1)², C]; row l² + l + m belongs to Y_lm. For a surface C is 3: x, y, z.
    """

    coefficients: Floats

    def __post_init__(self) -> None:
        given = np.array(real_numbers(self.coefficients, "coefficients", None))
        given = given[:, None] if given.ndim == 1 else given
        if given.ndim != 2:
            raise OmtwarpError(f"coefficients of shape {list(given.shape)}: expected [(L + 1)², C]")
        degree_of(len(given))
        given.flags.writeable = False
        object.__setattr__(self, "coefficients", given)

    @property
    def degree(self) -> int:
        """L, the highest degree."""
        return degree_of(len(self.coefficients))

    @blas_threads(1)
    def at(self, points: ArrayLike) -> Floats:
        """Evaluate the sum at unit vectors, shape [N, 3]; returns shape [N, C]."""
        directions = real_numbers(points, "points", (None, 3))
        out = np.empty((len(directions), self.coefficients.shape[1]))
        for part, basis in harmonics_in_parts(directions, self.degree):
            out[part] = basis @ self.coefficients
        return out

    def truncated(self, degree: int) -> Expansion:
        """Drop all coefficients above a degree.

        Raises:
            OmtwarpError: the expansion does not reach that degree.
        """
        degree = check_degree(degree)
        if degree > self.degree:
            raise OmtwarpError(f"cannot cut coefficients of degree {self.degree} at degree {degree}")
        return Expansion(self.coefficients[: (degree + 1) ** 2])

    def power(self) -> Floats:
        """Return the power of every degree, shape [L + 1].

        The sum is the integral of the square over the unit sphere.
        """
        return power_per_degree(self.coefficients)

    def surface(self, sphere: Surface | int = 24) -> Surface:
        """Reconstruct the surface over a triangulated unit sphere, or a geodesic one of that frequency.

        Raises:
            OmtwarpError: the expansion is not of three coordinates.
        """
        if self.coefficients.shape[1] != 3:
            raise OmtwarpError(f"an expansion of {self.coefficients.shape[1]} components is no surface: it needs 3")
        if isinstance(sphere, int | float | np.number):
            sphere = icosphere(whole_number(sphere, "the frequency", least=1))
        return Surface(self.at(sphere.vertices), sphere.faces)


@blas_threads(1)
def expand(
    sphere: ArrayLike,
    values: ArrayLike,
    degree: int,
    *,
    faces: ArrayLike | None = None,
    method: ExpandBy = "least-squares",
) -> Expansion:
    """Expand data at points of the unit sphere in spherical harmonics.

    Args:
        sphere: unit vectors, such as a map, shape [V, 3].
        values: the data: the surface's vertices, shape [V, 3], or any, shape [V] or [V, C].
        degree: the highest degree L.
        faces: triangles of the sphere, shape [F, 3]. With them points weigh as much as the area around them; needed for
            quadrature.
        method: ``least-squares``: the sum nearest to the data at the points, as SPHARM-PDM and most others have it;
            ``quadrature``: integrals over the spherical triangles of the data, linear on each, times every harmonic
            (Dunavant's rule of degree 4): needs no linear system, and uses the surface between its vertices.

    Raises:
        OmtwarpError: arrays that do not fit together, or more coefficients than the points determine.

    Example:
        >>> import omtwarp
        >>> from omtwarp.shape_analysis import expand
        >>> sphere = omtwarp.shapes.icosphere(8)
        >>> ellipsoid = sphere.vertices * [3.0, 2.0, 1.0]
        >>> (expand(sphere.vertices, ellipsoid, 4).power() / (4 * 3.141592653589793)).round(6).tolist()
        [0.0, 4.666667, 0.0, 0.0, 0.0]
    """
    degree = check_degree(degree)
    points = real_numbers(sphere, "the points", None, finite=False)
    data = real_numbers(values, "the data", None, finite=False)
    data = data[:, None] if data.ndim == 1 else data
    if points.ndim != 2 or points.shape[1] != 3 or data.ndim != 2 or len(data) != len(points):
        raise OmtwarpError(f"data of shape {list(data.shape)} at points of shape {list(points.shape)}: they do not fit")
    if not (np.isfinite(points).all() and np.isfinite(data).all()):
        raise OmtwarpError("the points or the data on them are not all finite")
    lengths = norms(points)
    # Most off sphere, of a radius of 1: points written with four digits pass, and those of another radius do not
    if np.abs(lengths - 1.0).max() > 1e-3:
        span = f"{lengths.min():.4g} to {lengths.max():.4g}"
        raise OmtwarpError(f"the points do not lie on the unit sphere: their lengths go from {span}")
    triangles = None if faces is None else whole_numbers(faces, "faces", (None, 3), below=len(points))
    if method == "quadrature":
        if triangles is None:
            raise OmtwarpError("quadrature integrates over triangles: give faces")
        return Expansion(_integrals(points, data, triangles, degree))
    check_word("method", method, get_args(ExpandBy))
    weights: Floats = np.ones(len(points))
    if triangles is not None:
        weights = sums_around(triangle_areas(points, triangles.astype(np.int32)), triangles, len(points))
    return Expansion(_least_squares(points, data, weights, degree))


def _least_squares(points: Floats, data: Floats, weights: Floats, degree: int) -> Floats:
    """Minimise the weighted sum of squares through the normal equations, which harmonics make well conditioned."""
    count = (degree + 1) ** 2
    too_many = OmtwarpError(
        f"{len(points)} points do not determine the {count} coefficients of degree {degree}: use a lower degree"
    )
    if len(points) < count:
        raise too_many
    normal, right = np.zeros((count, count)), np.zeros((count, data.shape[1]))
    for part, basis in harmonics_in_parts(points, degree):
        weighted = basis * weights[part, None]
        normal += weighted.T @ basis
        right += weighted.T @ data[part]
    spectrum = np.linalg.eigvalsh(normal)
    # Least squares whose normal matrix is worse conditioned than this determine the highest degrees by rounding alone.
    if spectrum[0] * 1e10 <= spectrum[-1]:
        raise too_many
    return cho_solve(cho_factor(normal, lower=True), right)


def _integrals(points: Floats, data: Floats, faces: NDArray[np.int64], degree: int) -> Floats:
    """Return ∫ f Y_lm over spherical triangles, f linear in the barycentric coordinates of the flat ones."""
    corners, at_corners = points[faces], data[faces]
    normal = cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 2.0  # its length is the area
    right = np.zeros(((degree + 1) ** 2, data.shape[1]))
    for a, weight in _RULE:
        for k in range(3):
            shares = np.full(3, a)
            shares[k] = 1.0 - 2.0 * a
            inner = np.einsum("k,fkc->fc", shares, corners)
            # The ray's projection stretches the flat area by cos / r² = (n · p) / r³.
            stretch = np.einsum("fc,fc->f", normal, inner) / norms(inner) ** 3
            values = np.einsum("k,fkc->fc", shares, at_corners) * (weight * stretch)[:, None]
            for part, basis in harmonics_in_parts(inner, degree):
                right += basis.T @ values[part]
    return right


def write_coef(path: str | os.PathLike[str], expansion: Expansion) -> None:
    """Write the coefficients of a surface for SPHARM-PDM, with all digits.

    Raises:
        OmtwarpError: the expansion is not of three coordinates, or the file cannot be written.
    """
    if expansion.coefficients.shape[1] != 3:
        raise OmtwarpError("a .coef file holds surfaces: give three components per coefficient")
    rows, factors = _order(expansion.degree)
    numbers = expansion.coefficients[rows] * factors[:, None]
    lines = ",\n".join("{" + ", ".join(repr(float(x)) for x in row) + "}" for row in numbers)
    write_text(path, f"{{ {len(numbers)},{lines}}}", "ascii")


def read_coef(path: str | os.PathLike[str]) -> Expansion:
    """Read the coefficients of a surface that SPHARM-PDM, or :func:`write_coef`, wrote.

    Raises:
        OmtwarpError: no such file, or no coefficients in it.
    """
    # Largest file: bytes; degree 500 has 251,001 rows of at most 80
    text = read_bytes(path, 2**26, "file of coefficients").decode("ascii", "replace")
    head = re.match(r"\s*\{\s*(\d{1,9})\s*,", text)
    if head is None:
        raise OmtwarpError(f"'{path}' is no .coef file: it does not begin with '{{ COUNT,'")
    try:
        numbers = [[float(x) for x in row.split(",")] for row in re.findall(r"\{([^{}]*)\}", text[head.end() :])]
        values = np.array(numbers, dtype=np.float64)
    except ValueError as error:
        raise OmtwarpError(f"'{path}' is a damaged .coef file: {error}") from None
    if values.shape != (int(head[1]), 3):
        raise OmtwarpError(f"'{path}' announces {head[1]} coefficients and holds an array of {list(values.shape)}")
    rows, factors = _order(degree_of(len(values)))
    coefficients = np.empty_like(values)
    coefficients[rows] = values / factors[:, None]
    return Expansion(coefficients)


def _order(degree: int) -> tuple[NDArray[np.int64], Floats]:
    """Return, for each row of the file, the package's row and the factor between the two."""
    m = orders(degree)
    rows = np.lexsort((m < 0, np.abs(m), degrees(degree)))
    return rows, np.where(m == 0, 1.0, np.sqrt(2.0) * (-1.0) ** m)[rows]
