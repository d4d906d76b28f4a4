"""Rotations that bring spheres into one position: by a shape's own axes, to another map, or to a group's mean."""

from omtwarp.alignment.align import Alignment, align, align_to_axes
from omtwarp.alignment.group import GroupAlignment, procrustes_mean

__all__ = ["Alignment", "GroupAlignment", "align", "align_to_axes", "procrustes_mean"]
