"""Coefficient files of SPHARM-PDM (``.coef``), in its order and signs.

SPHARM-PDM writes x(θ, φ) = Σ_l [ c_l0 N_l0 P_l0 + Σ_m>0 (a_lm cos mφ + b_lm sin mφ) N_lm P_lm ], P_lm with the
Condon-Shortley phase (-1)^m and without the factor √2 of real orthonormal harmonics: a_lm = √2 (-1)^m times our
coefficient of Y_lm, b_lm the same of Y_l,-m. The file has c_l0, a_l1, b_l1, a_l2, ... degree by degree, three numbers
each.
"""

from __future__ import annotations

import os
import re

import numpy as np
from numpy.typing import NDArray

from omtwarp.errors import OmtwarpError
from omtwarp.files.inputs import read_bytes
from omtwarp.files.output import as_path, staged
from omtwarp.harmonics import degree_of
from omtwarp.shape_analysis.expansion import Expansion


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
    with staged(as_path(path)) as file:
        file.write_text(f"{{ {len(numbers)},{lines}}}", "ascii")


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


def _order(degree: int) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return, for each row of the file, the package's row and the factor between the two."""
    rows, factors = [], []
    for n in range(degree + 1):
        rows.append(n * n + n)
        factors.append(1.0)
        for m in range(1, n + 1):
            rows += [n * n + n + m, n * n + n - m]
            factors += [np.sqrt(2.0) * (-1.0) ** m] * 2
    return np.array(rows), np.array(factors)
