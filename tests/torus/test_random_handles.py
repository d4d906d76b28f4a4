"""Random surfaces with handles: each a certified map, or refused in one line; HANDLES says how many, 3 by default."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "examples"))
from random_handles import outcome, surface_with_handles

SEEDS = range(int(os.environ.get("HANDLES", "3")))


@pytest.mark.parametrize("seed", [2 * k + 1 for k in SEEDS])
def test_surface_of_a_seed_is_mapped_or_refused(seed):
    fine, line = outcome(seed, 2500)
    assert fine, line


def test_same_seed_is_the_same_surface():
    one, other = (surface_with_handles(4, 1500) for _ in range(2))
    assert (one.vertices == other.vertices).all() and (one.faces == other.faces).all()
