"""Tests of the steps that raise a lower bound, on concave functions with a known maximum."""

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from omtwarp.metrics.dual import ascend


class Paraboloid:
    """The excess u · A u / 2 + least of a potential u, where the matrix of the fit is A times a matrix near identity.

    Args:
        rng: makes the matrices.
        size: of the potential.
        kink: slope of |u_0|, which is added to the excess.
    """

    def __init__(self, rng, size, kink=0.0, least=0.0):
        square = rng.normal(size=(size, size))
        self.matrix = square @ square.T / size + np.eye(size)
        change = np.eye(size) + 0.2 * np.diag(rng.uniform(-1.0, 1.0, size))
        self.inverse = change @ np.linalg.inv(self.matrix) @ change.T
        self.kink, self.least, self.counted = kink, least, 0

    def bound(self, potential):
        self.counted += 1
        excess = 0.5 * potential @ self.matrix @ potential + self.kink * abs(potential[0]) + self.least
        return SimpleNamespace(potential=potential, excess=float(excess))

    def slope(self, current):
        out = -self.matrix @ current.potential
        out[0] -= self.kink * np.sign(current.potential[0])
        return out

    def smoothed(self, slope):
        return self.inverse @ slope


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10_000), size=st.integers(1, 40))
def test_the_maximum_of_a_paraboloid_is_reached(seed, size):
    """Twenty steps leave at most 1e-6 of the excess, and none of them lowers the bound."""
    rng = np.random.default_rng(seed)
    dual = Paraboloid(rng, size)
    first = dual.bound(rng.normal(size=size))
    seen = []
    best, steps = ascend(dual, first, 20, 1e-6 * first.excess, lambda done, found: seen.append(found.excess))
    assert best.excess <= 1e-6 * first.excess and steps <= 20
    assert len(seen) == steps and seen == sorted(seen, reverse=True)


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10_000), kink=st.floats(0.0, 10.0))
def test_kinks_do_no_harm(seed, kink):
    """With a kink the bound is never lowered, and steps end."""
    rng = np.random.default_rng(seed)
    dual = Paraboloid(rng, 5, kink)
    first = dual.bound(rng.normal(size=5))
    best, steps = ascend(dual, first, 20, 0.0)
    assert best.excess <= first.excess and steps <= 20


def test_steps_end_where_what_is_wanted_is_out_of_reach():
    """With a least excess that is far above what is wanted, few bounds are computed."""
    dual = Paraboloid(np.random.default_rng(0), 30, least=1.0)
    first = dual.bound(np.full(30, 0.1))
    best, steps = ascend(dual, first, 1000, 0.5)
    assert best.excess == pytest.approx(1.0, rel=0.01)
    assert steps < 15 and dual.counted < 30


@pytest.mark.parametrize(("most", "allowed"), [(0, 0), (1, 3), (3, 9), (5, 5)])
def test_no_more_steps_are_taken_than_allowed(most, allowed):
    """Few steps are followed by up to three times as many while each gains much."""
    dual = Paraboloid(np.random.default_rng(1), 200)
    first = dual.bound(np.random.default_rng(2).normal(size=200))
    assert ascend(dual, first, most, 0.0)[1] <= allowed


def test_nothing_is_done_where_a_bound_is_enough():
    dual = Paraboloid(np.random.default_rng(3), 4)
    first = dual.bound(np.ones(4))
    assert ascend(dual, first, 20, first.excess) == (first, 0)
