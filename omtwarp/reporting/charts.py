"""Charts as SVG text, drawn in the page's own colours, so that they follow its light and dark look."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

WIDTH = 560.0


@dataclass(frozen=True)
class Row:
    """A distribution to be drawn.

    Attributes:
        label: its name.
        colour: CSS variable.
        values: log2 of a ratio, shape [N].
        weights: shape [N], sum 1.
        remark: a few words beside it.
    """

    label: str
    colour: str
    values: Floats
    weights: Floats
    remark: str


def distributions(rows: Sequence[Row], title: str, description: str, *, mirrored: bool) -> str:
    """Histograms of ratios above one another on a common axis of powers of two, each scaled to its own peak.

    Args:
        rows: from top to bottom.
        title: for screen readers.
        description: likewise.
        mirrored: whether the ratio lies on both sides of 1 (areas), or on one (the larger over the smaller).
    """
    low, high, step = ratio_range(rows, mirrored)
    left, right, top, height, gap = 8.0, WIDTH - 8.0, 8.0, 62.0, 26.0
    bottom = top + len(rows) * (height + gap)
    bins = 120 if mirrored else 96

    def x(value: float) -> float:
        return left + (value - low) / (high - low) * (right - left)

    parts = []
    for exponent in np.arange(math.ceil(low / step) * step, high + 1e-9, step):
        at = x(float(exponent))
        kind = "axis-one" if abs(exponent) < 1e-9 else "grid"
        parts.append(f'<line class="{kind}" x1="{at:.1f}" x2="{at:.1f}" y1="{top:.0f}" y2="{bottom:.0f}"/>')
        anchor = "start" if at < left + 12 else "end" if at > right - 12 else "middle"
        name = power_name(float(exponent))
        parts.append(f'<text class="tick" x="{at:.1f}" y="{bottom + 18:.0f}" text-anchor="{anchor}">{name}</text>')
    for k, row in enumerate(rows):
        base = top + (k + 1) * (height + gap) - gap + 14
        shares, edges = np.histogram(np.clip(row.values, low, high), bins, (low, high), weights=row.weights)
        peak = max(float(shares.max()), 1e-12)
        path = [f"M{x(low):.1f},{base:.1f}"]
        for share, begin, end in zip(shares, edges[:-1], edges[1:], strict=True):
            level = base - share / peak * height
            path.append(f"L{x(begin):.1f},{level:.1f}L{x(end):.1f},{level:.1f}")
        path.append(f"L{x(high):.1f},{base:.1f}Z")
        parts.append(f'<path class="hill" style="--ink:var({row.colour})" d="{"".join(path)}"/>')
        parts.append(f'<line class="baseline" x1="{left}" x2="{right}" y1="{base:.1f}" y2="{base:.1f}"/>')
        # The words stand where the hill is not.
        middle = float(np.sum(np.clip(row.values, low, high) * row.weights))
        side, anchor = (left + 2, "start") if mirrored and middle > 0.1 * high else (right - 2, "end")
        words = f'<tspan style="fill:var({row.colour})" class="row-name">{escape(row.label)}</tspan>'
        parts.append(f'<text class="row" x="{side}" y="{base - height + 20:.1f}" text-anchor="{anchor}">{words}</text>')
        parts.append(
            f'<text class="remark" x="{side}" y="{base - height + 36:.1f}" text-anchor="{anchor}">'
            f"{escape(row.remark)}</text>"
        )
    return _svg(bottom + 28, title, description, parts)


def ratio_range(rows: Sequence[Row], mirrored: bool) -> tuple[float, float, float]:
    """Lowest and highest exponent of the axis, and the step of its labels; it holds 99 % of every distribution."""
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
    """Two to the power of the exponent in a few characters: 1/4, 1, 1.4, 64, 10³, 10⁻⁶."""
    value = 2.0**exponent
    decimal = math.log10(value)
    if abs(decimal - round(decimal)) < 1e-9 and abs(decimal) > 2.5:
        return f"10{_superscript(round(decimal))}"
    if exponent < 0:
        return f"1/{power_name(-exponent)}"
    return f"{value:.0f}" if abs(value - round(value)) < 1e-9 else f"{value:.1f}"


def _superscript(number: int) -> str:
    return str(number).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))


def curve(
    x: Sequence[float],
    y: Sequence[float],
    title: str,
    description: str,
    *,
    colour: str,
    x_label: str,
    y_label: str,
    logarithmic: bool = False,
    level: tuple[float, str] | None = None,
    mark: tuple[int, str] | None = None,
    height: float = 300.0,
) -> str:
    """A line through points, with a horizontal level and one marked point.

    Args:
        x, y: the points; with a logarithmic axis those with y <= 0 are left out.
        title, description: for screen readers.
        colour: CSS variable.
        x_label, y_label: names of the axes.
        logarithmic: scale of y.
        level: a value of y with its name, drawn across.
        mark: index of a point with a few words.
        height: of the chart; its width is that of all charts.
    """
    pairs = zip(map(float, x), map(float, y), strict=True)
    points = [(a, b) for a, b in pairs if math.isfinite(b) and (b > 0 or not logarithmic)]
    if not points:
        return ""
    values = [b for _, b in points] + ([level[0]] if level else [])
    ticks = log_ticks(min(values), max(values)) if logarithmic else nice_ticks(min(values), max(values), 5)
    low, high = ticks[0], ticks[-1]
    left, right, top, bottom = 64.0, WIDTH - 12.0, 30.0, height - 44.0
    last = max(1.0, *(a for a, _ in points))

    def px(value: float) -> float:
        return left + value / last * (right - left)

    def py(value: float) -> float:
        if logarithmic:
            share = (math.log(value) - math.log(low)) / (math.log(high) - math.log(low))
        else:
            share = (value - low) / (high - low)
        return bottom - share * (bottom - top)

    parts = [f'<text class="axis-name" x="{0}" y="14">{escape(y_label)}</text>']
    for tick in ticks:
        at = py(tick)
        name = power_of_ten(tick) if logarithmic else f"{tick:.6g}"
        parts.append(f'<line class="grid" x1="{left}" x2="{right}" y1="{at:.1f}" y2="{at:.1f}"/>')
        parts.append(f'<text class="tick" x="{left - 8}" y="{at + 4:.1f}" text-anchor="end">{name}</text>')
    for tick in nice_ticks(0.0, last, 6):
        if tick <= last:
            parts.append(
                f'<text class="tick" x="{px(tick):.1f}" y="{bottom + 18:.0f}" text-anchor="middle">{tick:.6g}</text>'
            )
    parts.append(
        f'<text class="axis-name" x="{right}" y="{bottom + 36:.0f}" text-anchor="end">{escape(x_label)}</text>'
    )
    if level:
        at = py(level[0])
        parts.append(f'<line class="level" x1="{left}" x2="{right}" y1="{at:.1f}" y2="{at:.1f}"/>')
        parts.append(f'<text class="remark" x="{right}" y="{at - 6:.1f}" text-anchor="end">{escape(level[1])}</text>')
    line = " ".join(f"{px(a):.1f},{py(b):.1f}" for a, b in points)
    parts.append(f'<polyline class="curve" style="--ink:var({colour})" points="{line}"/>')
    for a, b in (points[0], points[-1]):
        parts.append(f'<circle class="dot" style="--ink:var({colour})" cx="{px(a):.1f}" cy="{py(b):.1f}" r="3.5"/>')
    if mark and 0 <= mark[0] < len(points):
        a, b = points[mark[0]]
        anchor, shift = ("start", 10) if px(a) < 0.6 * right else ("end", -10)
        parts.append(f'<circle class="ring" style="--ink:var({colour})" cx="{px(a):.1f}" cy="{py(b):.1f}" r="6"/>')
        parts.append(
            f'<text class="remark" x="{px(a) + shift:.1f}" y="{py(b) - 10:.1f}" text-anchor="{anchor}">'
            f"{escape(mark[1])}</text>"
        )
    return _svg(height, title, description, parts)


def nice_ticks(low: float, high: float, count: int) -> list[float]:
    """Round numbers from at or below ``low`` to at or above ``high``."""
    span = max(high - low, 1e-12, 1e-9 * max(abs(low), abs(high)))
    raw = span / count
    unit = 10.0 ** math.floor(math.log10(raw))
    step = next(unit * m for m in (1, 2, 2.5, 5, 10) if unit * m >= raw * (1 - 1e-9))
    first, last = math.floor(low / step + 1e-9), math.ceil(high / step - 1e-9)
    return [k * step for k in range(first, max(last, first + 1) + 1)]


def log_ticks(low: float, high: float) -> list[float]:
    """Powers of ten that enclose an interval, at most about six of them."""
    first, last = math.floor(math.log10(low) + 1e-9), math.ceil(math.log10(high) - 1e-9)
    last = max(last, first + 1)
    step = max(1, math.ceil((last - first) / 5))
    return [10.0**k for k in range(first, last + step, step)]


def power_of_ten(value: float) -> str:
    exponent = round(math.log10(value))
    return f"{value:g}" if -3 <= exponent <= 3 else f"10{_superscript(exponent)}"


def _svg(height: float, title: str, description: str, parts: Sequence[str]) -> str:
    return (
        f'<svg class="chart" viewBox="0 0 {WIDTH:.0f} {height:.0f}" role="img">'
        f"<title>{escape(title)}</title><desc>{escape(description)}</desc>{''.join(parts)}</svg>"
    )
