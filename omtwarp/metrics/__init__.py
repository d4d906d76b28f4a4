"""Measures of a map: distortion, flips, degree, certificate, optimality."""

from omtwarp.metrics.distortion import WEIGHTINGS, Distortion, distortion

__all__ = ["WEIGHTINGS", "Distortion", "distortion"]
