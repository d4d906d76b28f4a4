"""Measures of a map: distortion, flips, degree, certificate, optimality."""

from omtwarp.metrics.distortion import WEIGHTINGS, Distortion, distortion, measure_triangles

__all__ = ["WEIGHTINGS", "Distortion", "distortion", "measure_triangles"]
