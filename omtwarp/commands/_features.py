"""Data at vertices as features of two spheres, as the commands that compare them take them."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from omtwarp.errors import OmtwarpError

if TYPE_CHECKING:
    from numpy.typing import NDArray


def read_features(ours: list[Path], theirs: list[Path]) -> tuple[dict[str, NDArray], dict[str, NDArray]]:
    """Read the data of both sides; return their columns by name, with the same names in the same order.

    Raises:
        OmtwarpError: a file cannot be read, or the two sides have different numbers of files or columns.
    """
    from omtwarp.mesh.data import read_data

    if len(ours) != len(theirs):
        raise OmtwarpError(f"{len(ours)} features here and {len(theirs)} there: give as many --to-feature as --feature")
    mine: dict[str, NDArray] = {}
    others: dict[str, NDArray] = {}
    for here, there in zip(ours, theirs, strict=True):
        one, other = read_data(here).values, read_data(there).values
        if one.shape[1] != other.shape[1]:
            raise OmtwarpError(f"'{here}' and '{there}' hold different numbers of features")
        for column, its_own in zip(one.T, other.T, strict=True):
            name = f"{here} ({len(mine) + 1})"
            mine[name], others[name] = column, its_own
    return mine, others
