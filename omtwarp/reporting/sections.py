"""The sections of the report page, as HTML text, and their charts as SVG text.

Charts are drawn in the page's own colours, so that they follow its light and dark look.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias, cast

import numpy as np

from omtwarp.maps.result import MapReport
from omtwarp.mesh.arrays import TINY, Floats
from omtwarp.options import Record
from omtwarp.render.annotate import nice_ticks
from omtwarp.reporting.markup import Markup, element, fill_page, html, join
from omtwarp.reporting.scene import log2_angle_ratio, log2_area_ratio
from omtwarp.reporting.stages import Stage

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


def histograms(rows: Sequence[Row], title: str, *, mirrored: bool) -> Markup:
    """Draw histograms of ratios above one another on a common axis of powers of two, each scaled to its own peak.

    Args:
        rows: from top to bottom.
        title: for screen readers, who are told the remarks of the first and the last row too.
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
    return _svg(bottom + 28, title, " ".join(f"{row.label}: {row.remark}." for row in (rows[0], rows[-1])), parts)


def ratio_range(rows: Sequence[Row], mirrored: bool) -> tuple[float, float, float]:
    """Choose the lowest and highest exponent of the axis, and the step of its labels.

    It holds 99 % of every distribution.
    """
    reach = 1.0
    for row in rows:
        reach = max(reach, *_weighted_quantiles(np.abs(row.values), row.weights, (0.99,)))
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
        return "10" + str(round(decimal)).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))
    if exponent < 0:
        return f"1/{power_name(-exponent)}"
    return f"{value:.0f}" if abs(value - round(value)) < ROUND else f"{value:.1f}"


Mark: TypeAlias = tuple[float, str] | None
"""A number in a chart, and a few words about it."""


def curve(
    points: Iterable[tuple[float, float]], title: str, told: str, y_label: str, level: Mark = None, mark: Mark = None
) -> Markup:
    """Draw the curve of a number over iterations, with a horizontal level and one marked point.

    Args:
        points: iterations and the number at each; those at which it is not finite are left out.
        title, told: for screen readers.
        y_label: name of the number.
        level: a value of it, drawn across.
        mark: index of a point.
    """
    points = [(float(a), float(b)) for a, b in points if math.isfinite(b)]
    if not points:
        return html("")
    values = [b for _, b in points] + ([level[0]] if level else [])
    ticks = nice_ticks(min(values), max(values), 5)
    last = max(1.0, *(a for a, _ in points))
    left, right, top, bottom = 64.0, WIDTH - 12.0, 30.0, HEIGHT - 44.0

    def across(value: float) -> float:
        return left + value / last * (right - left)

    def above(value: float) -> float:
        return bottom - (value - ticks[0]) / (ticks[-1] - ticks[0]) * (bottom - top)

    parts = [element("text", y_label, class_="axis-name", x=0, y=14)]
    for tick in ticks:
        at = above(tick)
        parts.append(element("line", class_="grid", x1=left, x2=right, y1=at, y2=at))
        parts.append(element("text", f"{tick:.6g}", class_="tick", x=left - 8, y=at + 4, text_anchor="end"))
    for tick in (tick for tick in nice_ticks(0.0, last, 6) if tick <= last):
        at, below = across(tick), f"{bottom + 18:.0f}"
        parts.append(element("text", f"{tick:.6g}", class_="tick", x=at, y=below, text_anchor="middle"))
    below = f"{bottom + 36:.0f}"
    parts.append(element("text", "iteration", class_="axis-name", x=right, y=below, text_anchor="end"))
    if level:
        at = above(level[0])
        parts.append(element("line", class_="level", x1=left, x2=right, y1=at, y2=at))
        parts.append(element("text", level[1], class_="remark", x=right, y=at - 6, text_anchor="end"))
    line = " ".join(f"{across(a):.1f},{above(b):.1f}" for a, b in points)
    ink = "--ink:var(--transport)"
    parts.append(element("polyline", class_="curve", style=ink, points=line))
    for a, b in (points[0], points[-1]):
        parts.append(element("circle", class_="dot", style=ink, cx=across(a), cy=above(b), r=3.5))
    if mark and 0 <= mark[0] < len(points):
        at, up = across(points[int(mark[0])][0]), above(points[int(mark[0])][1])
        anchor, shift = ("start", 10) if at < 0.6 * right else ("end", -10)
        parts.append(element("circle", class_="ring", style=ink, cx=at, cy=up, r=6))
        parts.append(element("text", mark[1], class_="remark", x=at + shift, y=up - 10, text_anchor=anchor))
    return _svg(HEIGHT, title, told, parts)


def _svg(height: float, title: str, description: str, parts: Sequence[Markup]) -> Markup:
    heading = (element("title", title), element("desc", description))
    return element("svg", *heading, *parts, class_="chart", viewBox=f"0 0 {WIDTH:.0f} {height:.0f}", role="img")


def figures(stages: Sequence[Stage], report: MapReport) -> Markup:
    """Show the most important numbers of a map."""
    first, last = stages[0], stages[-1]
    known = (stage.record.get("transport_cost") for stage in reversed(stages))
    cost = next((cost for cost in known if cost is not None), None)  # disks and caps are made of optimal maps
    covered = f"of {len(last.distortion.triple):,}; {_cover(last)}"
    figures = [("Flipped triangles", f"{last.distortion.flips:,}", covered)]
    for name in ("area", "angle"):
        before, after = (_number(getattr(stage.distortion, name)["surface"]) for stage in (first, last))
        figures.append((f"{name.capitalize()} distortion", after, f"2 is perfect; {first.label.lower()} {before}"))
    if cost is not None and len(stages) > 1:
        figures.append(("Transport cost", _number(cost), f"from the {first.label.lower()} map, squared distance"))
    if "seconds" in report:
        figures.append(("Time", seconds_text(report["seconds"]), where(report)))
    items = join(
        html("<div><dt>{}</dt><dd><strong>{}</strong><span>{}</span></dd></div>", name, value, remark)
        for name, value, remark in figures
    )
    return html('<dl class="figures">{}</dl>', items)


def _cover(stage: Stage) -> str:
    """Return the degree of a map in words, or the part of the sphere that it covers."""
    degree = stage.distortion.degree
    if stage.count > 1:
        return f"{stage.count} {stage.domain}"
    if stage.disk is not None:
        return "on the disk"
    # Degrees are whole numbers but for the round-off of a million solid angles, or the share of the sphere that is
    # covered.
    return f"degree {degree:.3f}" if abs(degree - round(degree)) < 1e-6 else f"{degree:.1%} of the sphere"


def pictures(stages: Sequence[Stage], stills: Mapping[str, str], shown: str) -> Markup:
    """Show pictures of the first and the last stage: ``stills`` by key; ``shown`` names the texture."""
    pair = [stages[0], stages[-1]] if len(stages) > 1 else [stages[0]]
    gained = "Coloured by the area that each triangle gained (red) or lost (blue)."
    drawn = [("", f"{shown} on the surface", "", stage, _picture_caption(stage)) for stage in pair]
    drawn += [
        ("sphere ", f"The triangles on the {stage.domain}", f", on the {stage.domain}", stage, gained) for stage in pair
    ]
    figures = [
        fill_page(
            "figure.html", source=stills[kind + stage.key], alternative=f"{alternative}, {stage.label} map",
            swatch=_swatch(stage), name=f"{stage.label}{where}.", words=words,
        )
        for kind, alternative, where, stage, words in drawn
    ]  # fmt: skip
    words = f"{shown} on the sphere, carried to the surface by {'two maps' if len(pair) > 1 else 'the map'}."
    return section("Before and after", words, html('<div class="pair pictures">{}</div>', join(figures)))


def _picture_caption(stage: Stage) -> str:
    nine_tenths = (0.05, 0.95)  # quantiles between which nine tenths of a distribution lie, as the words say
    low, high = _weighted_quantiles(log2_area_ratio(stage), stage.weights, nine_tenths)
    spread = 2.0 ** (high - low)
    times = f"{spread:.2f}" if spread < 10 else f"{spread:,.0f}" if spread < 1e6 else _number(spread)
    return html("Scale of area varies by a factor of {} over nine tenths of the surface.", times)


def distributions(stages: Sequence[Stage]) -> Markup:
    """Show histograms of the area and angle ratios at every stage."""
    area, angle = [], []
    for stage in stages:
        weights = stage.weights
        ratio, stretch = log2_area_ratio(stage), log2_angle_ratio(stage)
        within = float(weights[np.abs(ratio) <= math.log2(1.05)].sum())
        area.append(Row(stage.label, stage.colour, ratio, weights, f"{within:.1%} within 5 %"))
        (median,) = _weighted_quantiles(stretch, weights, (0.5,))
        angle.append(Row(stage.label, stage.colour, stretch, weights, f"median {2.0**median:.2f}"))
    left = histograms(area, "Histogram of area ratios", mirrored=True)
    right = histograms(angle, "Histogram of stretch ratios", mirrored=False)
    return fill_page("distributions.html", domain=stages[-1].domain, areas=left, angles=right)


def transport(report: MapReport, history: Sequence[Record], stages: Sequence[Stage]) -> Markup:
    """Show the cost over the iterations, its value at the start, and how far the map is from optimal."""
    optimality = report.get("optimality") or {}
    cards = []
    if len(history) > 1:
        iterations = [float(entry.get("iteration", k)) for k, entry in enumerate(history)]
        costs = [float(entry["cost"]) for entry in history]
        # Near end, of the final cost: the iteration that reaches it is named
        near = next((k for k, cost in enumerate(costs) if cost <= 1.01 * costs[-1]), len(costs) - 1)
        bound = optimality.get("lower_bound")
        name = "squared geodesic" if report.get("cost") != "geodesic" else "geodesic"
        chart = curve(
            zip(iterations, costs, strict=True),
            "Transport cost over iterations",
            f"From {costs[0]:.5g} to {costs[-1]:.5g} in {iterations[-1]:.0f} iterations.",
            f"cost M, {name}",
            (float(bound), "lower bound for any map") if bound and name != "geodesic" else None,
            (near, f"within 1 % after {iterations[near]:.0f}") if 0 < near < len(costs) - 1 else None,
        )
        change = html("{} → {} in {:.0f} iterations.", _number(costs[0]), _number(costs[-1]), iterations[-1])
        cards.append(html('<div class="card"><h3>Cost of the transport</h3><p>{}</p>{}</div>', change, chart))
    facts = _transport_facts(report, stages, optimality)
    if facts:
        listed = html('<dl class="facts">{}</dl>', join(_fact(name, value) for name, value in facts))
        cards.append(html('<div class="card"><h3>Start and optimality</h3>{}</div>', listed))
    if not cards:
        return html("")
    words = "From the start to the optimal map: mass moves along the gradient flow that lowers its cost."
    return section("Transport", words, html('<div class="pair">{}</div>', join(cards)))


def _transport_facts(
    report: MapReport, stages: Sequence[Stage], optimality: Mapping[str, float | int | None]
) -> list[tuple[str, str]]:
    facts: list[tuple[str, str]] = []
    start = report.get("start", {})
    if start:
        facts.append(("Start", ": ".join(filter(None, (start.get("route"), start.get("reason"))))))
    for name, key in (("Method", "method"), ("Scheme", "scheme"), ("Cost", "cost")):
        value = cast(Mapping[str, object], report).get(key)
        if value not in (None, ""):
            facts.append((name, str(value)))
    weight = next((stage.record.get("weight") for stage in stages if stage.key == "refine"), None)
    if weight not in (None, ""):
        facts.append(("Refinement", f"{weight} (weight of area against angle)"))
    if "relative_curl" in optimality:
        of = "the displacement's direction" if report.get("cost") == "geodesic" else "the displacement"
        facts.append(("Curl left over", f"{optimality['relative_curl']:.2%} of {of}; 0 for an optimal map"))
    if optimality.get("lower_bound"):
        facts.append(("Lower bound", html("{} (Kantorovich's dual)", _number(optimality["lower_bound"]))))
    if optimality.get("gap") is not None:
        facts.append(("Gap", f"the optimal cost is at most {optimality['gap']:.3%} lower"))
    repaired = [(stage.label, stage.record.get("repaired", 0)) for stage in stages]
    after = ", ".join(f"{count} after {label}" for label, count in repaired if count)
    if any("repaired" in stage.record for stage in stages):
        facts.append(("Flips repaired", after or "none were needed"))
    return facts


def stage_table(stages: Sequence[Stage], report: MapReport) -> Markup:
    """Describe every stage: its time, iterations and measures."""
    total = sum(float(record.get("seconds", 0.0)) for record in report.get("stages", ())) or 1.0
    rows = []
    for stage in stages:
        record, measured = stage.record, stage.distortion
        seconds = record.get("seconds")
        share = 0.0 if seconds is None else float(seconds) / total
        remarks = []
        if record.get("route") not in (None, "conformal", ""):
            remarks.append(str(record["route"]))
        if record.get("converged") is False:
            remarks.append("stopped before it converged")
        remark = html("<small>{}</small>", "; ".join(remarks)) if remarks else ""
        bar = html('<span class="bar"><i style="width:{:.0%}"></i></span>', share)
        time = "–" if seconds is None else html("{}{}", seconds_text(seconds), bar)
        cells = [
            time,
            f"{record['iterations']:,}" if "iterations" in record else "–",
            f"{measured.flips:,}",
            *(_number(of[kind]) for of in (measured.area, measured.angle) for kind in ("surface", "p95", "sphere")),
            _number(record["transport_cost"]) if "transport_cost" in record else "–",
        ]
        head = element("th", _swatch(stage), stage.label, remark, scope="row")
        rows.append(element("tr", head, *(element("td", cell) for cell in cells)))
    return fill_page("stages.html", rows=join(rows), image="torus" if stages[-1].domain == "torus" else "sphere")


def certificate(report: MapReport, shown_faces: int, last: Stage, filled: bool) -> Markup:
    """Describe the certificate.

    Args:
        report: of the map.
        shown_faces: the number of faces in the interactive view.
        last: the final map.
        filled: whether holes or the sides of cuts are filled.
    """
    certificate = report.get("certificate")
    if not certificate:
        return html("")
    flips, crossings = certificate.get("flips") or 0, certificate.get("ray_degree")
    words = ""
    if last.domain.startswith(("hemisphere", "cap", "disk")):
        seen = ", the disk seen from above its centre" if last.disk is not None else ""
        words += f" The rim is closed by a fan of triangles to the point opposite to it{seen}."
    if filled:
        words += " What fills holes and the sides of cuts is part of it."
    if last.count > 1:
        words += " Each part is certified by itself."
    count = report.get("mesh", {}).get("faces")
    simplified = f"simplified to {shown_faces:,} triangles; figures are of the whole mesh"
    return fill_page(
        "certificate.html", words=words, flips=f"{flips:,}",
        first=f"the first is face {certificate.get('first_flip')}" if flips else "by exact orientation tests",
        wound=f"{certificate.get('wound') or 0:,}", degree=certificate.get("degree"), rays=certificate.get("rays"),
        crossings=f"{crossings} time{'s' * (crossings != 1)}", area=_number(certificate["smallest_area"]),
        face=certificate["smallest_face"],
        more=_fact("Interactive view", simplified) if count and shown_faces < count else "",
    )  # fmt: skip


def where(report: MapReport) -> str:
    device = str(report.get("device", "cpu"))
    return "on the CPU" if device == "cpu" else f"on {device}"


def _weighted_quantiles(values: Floats, weights: Floats, shares: Sequence[float]) -> list[float]:
    order = np.argsort(values, kind="stable")
    total = np.cumsum(weights[order])
    places = np.searchsorted(total, np.asarray(shares) * total[-1])
    return [float(values[order[min(place, len(order) - 1)]]) for place in places]


def section(heading: str, words: str, content: Markup) -> Markup:
    """Make a section of a page: a heading, a sentence and what they are about."""
    return html('<section class="block"><h2>{}</h2><p>{}</p>{}</section>', heading, words, content)


def _fact(name: str, value: str) -> Markup:
    return html("<dt>{}</dt><dd>{}</dd>", name, value)


def _swatch(stage: Stage) -> Markup:
    return html('<i class="swatch" style="--ink:var({})"></i>', stage.colour)


def _number(value: float | None) -> str:
    """Write a number with as many digits as a reader needs."""
    value = math.nan if value is None else float(value)
    if not math.isfinite(value):
        return "∞" if value > 0 else "undefined"
    if value != 0 and not 1e-3 <= abs(value) < 1e5:
        mantissa, exponent = f"{value:.1e}".split("e")
        return html("{}\u202f×\u202f10<sup>{}</sup>", mantissa, int(exponent))
    return f"{value:.4f}" if abs(value) < 100 else f"{value:,.0f}"


def seconds_text(value: float) -> str:
    if value < 0.1:
        return f"{1000 * value:.0f} ms"
    if value < 120:
        return f"{value:.2g} s" if value < 1 else f"{value:.1f} s"
    return f"{value / 60:.1f} min"
