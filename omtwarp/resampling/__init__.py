"""Resampling of data and surfaces from one sphere to another by sparse matrices."""

from omtwarp.resampling.resample import Resampling, SpherePoints, as_points, file_points, resample

__all__ = ["Resampling", "SpherePoints", "as_points", "file_points", "resample"]
