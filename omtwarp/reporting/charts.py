"""Charts as SVG text, drawn in the page's own colours, so that they follow its light and dark look."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from omtwarp.mesh.arrays import ROUND_OFF, TINY, Floats
from omtwarp.reporting.markup import Markup, element, html

# Of a chart in its own units, which the page scales to the column, and of that of a curve.
WIDTH, HEIGHT = 560.0, 300.0

ROUND = 1e-9  # steps: a value that is so near to a tick, as a quotient of rounded numbers is, is the tick


@dataclass(frozen=True)
class Row:
    """A distribution to be drawn.

    Attributes:
        label: its name.
        colour: CSS variable.
        values: log2 of a ratio, shape [N].
        weights: shape [N], sum 1.
        remark: a short text next to it.
    """

    label: str
    colour: str
    values: Floats
    weights: Floats
    remark: str


def distributions(rows: Sequence[Row], title: str, description: str, *, mirrored: bool) -> Markup:
    """Draw histograms of ratios above one another on a common axis of powers of two, each scaled to its own peak.

    Args:
        rows: from top to bottom.
        title: for screen readers.
        description: text for readers who do not see the chart, like ``title``.
        mirrored: whether the ratio lies on both sides of 1 (areas), or on one (the larger over the smaller).
    """
    low, high, step = ratio_range(rows, mirrored)
    left, right, top, height, gap = 8.0, WIDTH - 8.0, 8.0, 62.0, 26.0
    bottom = top + len(rows) * (height + gap)
    bins = 120 if mirrored else 96

    def x(value: float) -> float:
        return left + (value - low) / (high - low) * (right - left)

    parts = []
    for exponent in np.arange(math.ceil(low / step) * step, high + ROUND, step):
        at = x(float(exponent))
        kind = "axis-one" if abs(exponent) < ROUND else "grid"
        parts.append(element("line", class_=kind, x1=at, x2=at, y1=f"{top:.0f}", y2=f"{bottom:.0f}"))
        anchor = "start" if at < left + 12 else "end" if at > right - 12 else "middle"
        name = power_name(float(exponent))
        parts.append(element("text", name, class_="tick", x=at, y=f"{bottom + 18:.0f}", text_anchor=anchor))
    for k, row in enumerate(rows):
        base = top + (k + 1) * (height + gap) - gap + 14
        shares, edges = np.histogram(np.clip(row.values, low, high), bins, (low, high), weights=row.weights)
        peak = max(float(shares.max()), TINY)
        path = [f"M{x(low):.1f},{base:.1f}"]
        for share, begin, end in zip(shares, edges[:-1], edges[1:], strict=True):
            level = base - share / peak * height
            path.append(f"L{x(begin):.1f},{level:.1f}L{x(end):.1f},{level:.1f}")
        path.append(f"L{x(high):.1f},{base:.1f}Z")
        parts.append(element("path", class_="hill", style=f"--ink:var({row.colour})", d="".join(path)))
        parts.append(element("line", class_="baseline", x1=left, x2=right, y1=base, y2=base))
        # The label is where the histogram is low.
        middle = float(np.sum(np.clip(row.values, low, high) * row.weights))
        side, anchor = (left + 2, "start") if mirrored and middle > 0.1 * high else (right - 2, "end")
        words = element("tspan", row.label, style=f"fill:var({row.colour})", class_="row-name")
        for kind, text, below in (("row", words, 20), ("remark", row.remark, 36)):
            level = f"{base - height + below:.1f}"
            parts.append(element("text", text, class_=kind, x=side, y=level, text_anchor=anchor))
    return _svg(bottom + 28, title, description, parts)


def ratio_range(rows: Sequence[Row], mirrored: bool) -> tuple[float, float, float]:
    """Choose the lowest and highest exponent of the axis, and the step of its labels.

    It holds 99 % of every distribution.
    """
    reach = 1.0
    for row in rows:
        order = np.argsort(np.abs(row.values))
        total = np.cumsum(row.weights[order])
        index = int(np.searchsorted(total, 0.99 * total[-1]))
        reach = max(reach, abs(float(row.values[order[min(index, len(order) - 1)]])))
    reach = min(reach * 1.05, 20.0)
    decade = math.log2(10.0)
    steps = (0.5, 1.0, 2.0, decade, 2 * decade, 3 * decade)
    step = next((s for s in steps if reach / s <= (4.0 if mirrored else 7.0)), steps[-1])
    high = math.ceil(reach / step) * step
    return (-high if mirrored else 0.0), high, step


def power_name(exponent: float) -> str:
    """Write two to the power of an exponent in a few characters: 1/4, 1, 1.4, 64, 10³, 10⁻⁶."""
    value = 2.0**exponent
    decimal = math.log10(value)
    if abs(decimal - round(decimal)) < ROUND and abs(decimal) > 2.5:
        power = str(round(decimal)).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))
        return f"10{power}"
    if exponent < 0:
        return f"1/{power_name(-exponent)}"
    return f"{value:.0f}" if abs(value - round(value)) < ROUND else f"{value:.1f}"


def curve(
    x: Sequence[float],
    y: Sequence[float],
    title: str,
    description: str,
    *,
    colour: str,
    x_label: str,
    y_label: str,
    level: tuple[float, str] | None = None,
    mark: tuple[int, str] | None = None,
) -> Markup:
    """Draw a curve through points, with a horizontal level and one marked point.

    Args:
        x, y: the points.
        title, description: for screen readers.
        colour: CSS variable.
        x_label, y_label: names of the axes.
        level: a value of y with its name, drawn across.
        mark: index of a point with a few words.
    """
    pairs = zip(map(float, x), map(float, y), strict=True)
    points = [(a, b) for a, b in pairs if math.isfinite(b)]
    if not points:
        return html("")
    values = [b for _, b in points] + ([level[0]] if level else [])
    ticks = nice_ticks(min(values), max(values), 5)
    plot = _Plot(max(1.0, *(a for a, _ in points)), ticks)
    parts = plot.axes(x_label, y_label)
    if level:
        at = plot.y(level[0])
        parts.append(element("line", class_="level", x1=plot.left, x2=plot.right, y1=at, y2=at))
        parts.append(element("text", level[1], class_="remark", x=plot.right, y=at - 6, text_anchor="end"))
    line = " ".join(f"{plot.x(a):.1f},{plot.y(b):.1f}" for a, b in points)
    ink = f"--ink:var({colour})"
    parts.append(element("polyline", class_="curve", style=ink, points=line))
    for a, b in (points[0], points[-1]):
        parts.append(element("circle", class_="dot", style=ink, cx=plot.x(a), cy=plot.y(b), r=3.5))
    if mark and 0 <= mark[0] < len(points):
        a, b = points[mark[0]]
        anchor, shift = ("start", 10) if plot.x(a) < 0.6 * plot.right else ("end", -10)
        parts.append(element("circle", class_="ring", style=ink, cx=plot.x(a), cy=plot.y(b), r=6))
        at = plot.x(a) + shift
        parts.append(element("text", mark[1], class_="remark", x=at, y=plot.y(b) - 10, text_anchor=anchor))
    return _svg(HEIGHT, title, description, parts)


class _Plot:
    """Where values lie in a chart of a curve.

    Args:
        last: the largest value of x; the least is 0.
        ticks: values of y with a line across, ascending, which enclose all others.
    """

    def __init__(self, last: float, ticks: Sequence[float]):
        self.last, self.ticks = last, ticks
        self.left, self.right, self.top, self.bottom = 64.0, WIDTH - 12.0, 30.0, HEIGHT - 44.0

    def x(self, value: float) -> float:
        return self.left + value / self.last * (self.right - self.left)

    def y(self, value: float) -> float:
        low, high = self.ticks[0], self.ticks[-1]
        return self.bottom - (value - low) / (high - low) * (self.bottom - self.top)

    def axes(self, x_label: str, y_label: str) -> list[Markup]:
        """Draw both axes with their lines, numbers and names."""
        parts = [element("text", y_label, class_="axis-name", x=0, y=14)]
        for tick in self.ticks:
            at = self.y(tick)
            name = f"{tick:.6g}"
            parts.append(element("line", class_="grid", x1=self.left, x2=self.right, y1=at, y2=at))
            parts.append(element("text", name, class_="tick", x=self.left - 8, y=at + 4, text_anchor="end"))
        for tick in nice_ticks(0.0, self.last, 6):
            if tick <= self.last:
                below = f"{self.bottom + 18:.0f}"
                name = f"{tick:.6g}"
                parts.append(element("text", name, class_="tick", x=self.x(tick), y=below, text_anchor="middle"))
        below = f"{self.bottom + 36:.0f}"
        return [*parts, element("text", x_label, class_="axis-name", x=self.right, y=below, text_anchor="end")]


def nice_ticks(low: float, high: float, count: int) -> list[float]:
    """Round numbers from at or below ``low`` to at or above ``high``."""
    span = max(high - low, ROUND_OFF, ROUND * max(abs(low), abs(high)))
    raw = span / count
    unit = 10.0 ** math.floor(math.log10(raw))
    step = next(unit * m for m in (1, 2, 2.5, 5, 10) if unit * m >= raw * (1 - ROUND))
    first, last = math.floor(low / step + ROUND), math.ceil(high / step - ROUND)
    return [k * step for k in range(first, max(last, first + 1) + 1)]


def _svg(height: float, title: str, description: str, parts: Sequence[Markup]) -> Markup:
    heading = (element("title", title), element("desc", description))
    return element("svg", *heading, *parts, class_="chart", viewBox=f"0 0 {WIDTH:.0f} {height:.0f}", role="img")
