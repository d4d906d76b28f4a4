"""Times of every stage by mesh size and device, compared with one sparse factorisation by SciPy."""

from omtwarp.benchmark.measure import markdown
from omtwarp.benchmark.runner import run

__all__ = ["markdown", "run"]
