"""Shapes as sums of spherical harmonics, and SPHARM-PDM's files of coefficients."""

from omtwarp.shape_analysis.coef_file import read_coef, write_coef
from omtwarp.shape_analysis.expansion import Expansion, expand

__all__ = ["Expansion", "expand", "read_coef", "write_coef"]
