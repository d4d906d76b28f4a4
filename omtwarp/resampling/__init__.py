"""Data and surfaces carried from one sphere to another, each way of doing it one sparse matrix."""

from __future__ import annotations

from omtwarp.resampling.resample import Resampling, SpherePoints, as_points, file_points, resample

__all__ = ["Resampling", "SpherePoints", "as_points", "file_points", "resample"]
