"""Shapes as sums of spherical harmonics, SPHARM-PDM's files, distances of shapes, and the statistics of groups."""

from omtwarp.shape_analysis.distance import ShapeDistance, shape_distance
from omtwarp.shape_analysis.expansion import Expansion, expand, read_coef, write_coef
from omtwarp.shape_analysis.group import Effect, GroupStudy, linear_effects, study_group
from omtwarp.shape_analysis.reports import write_group_report

__all__ = [
    "Effect",
    "Expansion",
    "GroupStudy",
    "ShapeDistance",
    "expand",
    "linear_effects",
    "read_coef",
    "shape_distance",
    "study_group",
    "write_coef",
    "write_group_report",
]
