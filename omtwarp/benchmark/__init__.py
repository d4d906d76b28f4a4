"""How fast the package is on a machine: every stage, mesh size and device, beside one sparse factorisation in SciPy."""

from omtwarp.benchmark.runner import run
from omtwarp.benchmark.tables import markdown

__all__ = ["markdown", "run"]
