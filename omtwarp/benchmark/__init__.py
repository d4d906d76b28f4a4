"""Times of every stage by mesh size and device, compared with one sparse factorisation by SciPy."""

from omtwarp.benchmark.runner import run
from omtwarp.benchmark.tables import markdown

__all__ = ["markdown", "run"]
