"""Charts: axes that enclose the values, and histograms that match them."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest
from hypothesis import given, strategies as st

from omtwarp.reporting import sections as charts

finite = st.floats(-1e6, 1e6, allow_nan=False)


@given(finite, finite, st.integers(2, 8))
def test_ticks_enclose_the_values(a, b, count):
    low, high = sorted((a, b))
    ticks = charts.nice_ticks(low, high, count)
    slack = 1e-6 * max(1.0, abs(low), abs(high))
    assert ticks[0] <= low + slack and ticks[-1] >= high - slack
    assert 2 <= len(ticks) <= 2 * count + 4
    assert np.all(np.diff(ticks) > 0)


def test_common_axis_holds_nearly_all_of_every_row():
    rng = np.random.default_rng(2)
    rows = [charts.Row(str(s), "--after", rng.normal(0, s, 4000), np.full(4000, 1 / 4000), "") for s in (0.01, 3.0)]
    low, high, step = charts.ratio_range(rows, True)
    assert low == -high and high % step == pytest.approx(0, abs=1e-9)
    assert all((np.abs(row.values) <= high).mean() >= 0.99 for row in rows)
    wild = charts.Row("", "--after", np.array([-60.0, 60.0]), np.array([0.5, 0.5]), "")
    assert charts.ratio_range([wild], True)[1] < 27


def test_curve_passes_through_its_points():
    text = charts.curve([(0, 4.0), (1, 2.0), (2, 1.0)], "t", "d", "y", level=(0.5, "low"))
    ElementTree.fromstring(text)
    points = [tuple(map(float, p.split(","))) for p in re.search(r'points="([^"]+)"', text)[1].split()]
    (x0, y0), (x1, y1), (x2, y2) = points
    assert x1 - x0 == pytest.approx(x2 - x1, abs=0.2)
    assert (y1 - y0) / (y2 - y1) == pytest.approx(2.0, abs=0.02)
    assert charts.curve([(0, np.nan), (1, np.inf)], "t", "d", "y") == ""
