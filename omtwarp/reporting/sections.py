"""The sections of the report page, as HTML text."""

from __future__ import annotations

import math
from collections.abc import Sequence
from html import escape
from typing import Any

import numpy as np

from omtwarp.reporting import charts
from omtwarp.reporting.scene import log2_angle_ratio, log2_area_ratio
from omtwarp.reporting.stages import Stage


def figures(stages: Sequence[Stage], report: dict[str, Any]) -> str:
    """The numbers that matter most."""
    first, last = stages[0], stages[-1]
    cost = last.record.get("transport_cost")
    figures = [
        ("Flipped triangles", f"{last.distortion.flips:,}", f"of {len(last.distortion.triple):,}; degree "
         f"{last.distortion.degree:.3f}"),
        ("Area distortion", _number(last.distortion.area["surface"]), f"2 is perfect; {first.label.lower()} "
         f"{_number(first.distortion.area['surface'])}"),
        ("Angle distortion", _number(last.distortion.angle["surface"]), f"2 is perfect; {first.label.lower()} "
         f"{_number(first.distortion.angle['surface'])}"),
    ]  # fmt: skip
    if cost is not None and len(stages) > 1:
        figures.append(("Transport cost", _number(cost), f"from the {first.label.lower()} map, squared distance"))
    if "seconds" in report:
        figures.append(("Time", seconds_text(report["seconds"]), where(report)))
    items = "".join(
        f"<div><dt>{name}</dt><dd><strong>{value}</strong><span>{remark}</span></dd></div>"
        for name, value, remark in figures
    )
    return f'<dl class="figures">{items}</dl>'


def pictures(stages: Sequence[Stage], stills: dict[str, str], shown: str) -> str:
    """Still pictures of the first and the last stage: ``stills`` by key, ``shown`` what the texture is."""
    pair = [stages[0], stages[-1]] if len(stages) > 1 else [stages[0]]
    figures = []
    for stage in pair:
        text = _picture_caption(stage)
        figures.append(
            f'<figure><img src="{stills[stage.key]}" alt="{escape(shown)} on the surface, {escape(stage.label)} map" '
            f'loading="lazy"><figcaption>{_swatch(stage)}<b>{escape(stage.label)}.</b> {text}</figcaption></figure>'
        )
    for stage in pair:
        label = escape(stage.label)
        figures.append(
            f'<figure><img src="{stills["sphere " + stage.key]}" alt="The triangles on the sphere, {label} map" '
            f'loading="lazy"><figcaption>{_swatch(stage)}<b>{label}, on the sphere.</b> '
            "Coloured by the area that each triangle gained (red) or lost (blue).</figcaption></figure>"
        )
    maps = "two maps" if len(pair) > 1 else "the map"
    words = f"{shown} on the sphere, carried to the surface by {maps}."
    return _section("Before and after", words, f'<div class="pair pictures">{"".join(figures)}</div>')


def _picture_caption(stage: Stage) -> str:
    ratio = log2_area_ratio(stage)
    low, high = _weighted_quantiles(ratio, stage.weights, (0.05, 0.95))
    spread = 2.0 ** (high - low)
    times = f"{spread:.2f}" if spread < 10 else f"{spread:,.0f}" if spread < 1e6 else _number(spread)
    return f"Scale of area varies by a factor of {times} over nine tenths of the surface."


def distributions(stages: Sequence[Stage]) -> str:
    """Histograms of area and angle ratios at every stage."""
    area, angle = [], []
    for stage in stages:
        weights = stage.weights
        ratio, stretch = log2_area_ratio(stage), log2_angle_ratio(stage)
        within = float(weights[np.abs(ratio) <= math.log2(1.05)].sum())
        area.append(charts.Row(stage.label, stage.colour, ratio, weights, f"{within:.1%} within 5 %"))
        (median,) = _weighted_quantiles(stretch, weights, (0.5,))
        angle.append(charts.Row(stage.label, stage.colour, stretch, weights, f"median {2.0**median:.2f}"))
    first, last = area[0], area[-1]
    left = charts.distributions(
        area, "Histogram of area ratios", f"{first.label}: {first.remark}. {last.label}: {last.remark}.", mirrored=True
    )
    right = charts.distributions(
        angle,
        "Histogram of stretch ratios",
        f"{angle[0].label}: {angle[0].remark}. {angle[-1].label}: {angle[-1].remark}.",
        mirrored=False,
    )
    cards = (
        '<div class="card"><h3>Area ratio</h3><p>Area on the sphere over area on the surface; 1 preserves area.</p>'
        f"{left}</div>"
        '<div class="card"><h3>Angle ratio</h3><p>Larger over smaller singular value; 1 preserves angles.</p>'
        f"{right}</div>"
    )
    words = "How much of the surface is distorted how far, each distribution scaled to its own peak."
    return _section("Distortion", words, f'<div class="pair">{cards}</div>')


def transport(result: Any, stages: Sequence[Stage]) -> str:
    """Cost over iterations, where the map started, and how far it is from optimal."""
    history = [entry for entry in result.history if isinstance(entry.get("cost"), int | float)]
    report = result.report
    optimality = report.get("optimality") or {}
    cards = []
    if len(history) > 1:
        iterations = [float(entry.get("iteration", k)) for k, entry in enumerate(history)]
        costs = [float(entry["cost"]) for entry in history]
        near = next((k for k, cost in enumerate(costs) if cost <= 1.01 * costs[-1]), len(costs) - 1)
        bound = optimality.get("lower_bound")
        name = "squared geodesic" if report.get("cost") != "geodesic" else "geodesic"
        chart = charts.curve(
            iterations,
            costs,
            "Transport cost over iterations",
            f"From {costs[0]:.5g} to {costs[-1]:.5g} in {iterations[-1]:.0f} iterations.",
            colour="--transport",
            x_label="iteration",
            y_label=f"cost M, {name}",
            level=(float(bound), "lower bound for any map") if bound and name != "geodesic" else None,
            mark=(near, f"within 1 % after {iterations[near]:.0f}") if 0 < near < len(costs) - 1 else None,
        )
        words = f"{_number(costs[0])} → {_number(costs[-1])} in {iterations[-1]:.0f} iterations."
        cards.append(f'<div class="card"><h3>Cost of the transport</h3><p>{words}</p>{chart}</div>')
    facts = _transport_facts(report, stages, optimality)
    if facts:
        cards.append(f'<div class="card"><h3>Start and optimality</h3>{_facts(facts)}</div>')
    if not cards:
        return ""
    words = "From the start to the optimal map: mass moves along the gradient flow that lowers its cost."
    return _section("Transport", words, f'<div class="pair">{"".join(cards)}</div>')


def _transport_facts(
    report: dict[str, Any], stages: Sequence[Stage], optimality: dict[str, Any]
) -> list[tuple[str, str]]:
    facts = []
    start = report.get("start", {})
    if start:
        road = escape(str(start.get("road", "")))
        reason = escape(str(start.get("reason", "")))
        facts.append(("Start", f"{road}{f': {reason}' if reason else ''}"))
    for name, key in (("Method", "method"), ("Scheme", "scheme"), ("Cost", "cost")):
        if report.get(key) not in (None, ""):
            facts.append((name, escape(str(report[key]))))
    weight = next((stage.record.get("weight") for stage in stages if stage.key == "refine"), None)
    if weight not in (None, ""):
        facts.append(("Refinement", f"{escape(str(weight))} (weight of area against angle)"))
    if "relative_curl" in optimality:
        facts.append(("Curl left over", f"{optimality['relative_curl']:.2%} of the displacement; 0 for an optimal map"))
    if "lower_bound" in optimality:
        facts.append(("Lower bound", f"{_number(optimality['lower_bound'])} (Kantorovich's dual)"))
    if "gap" in optimality:
        facts.append(("Gap", f"the optimal cost is at most {optimality['gap']:.3%} lower"))
    repaired = [(stage.label, int(stage.record.get("repaired", 0) or 0)) for stage in stages]
    mended = ", ".join(f"{count} after {escape(label)}" for label, count in repaired if count)
    if any("repaired" in stage.record for stage in stages):
        facts.append(("Flips repaired", mended or "none were needed"))
    return facts


def stage_table(stages: Sequence[Stage], report: dict[str, Any]) -> str:
    """What every stage did."""
    records = report.get("stages", ())
    total = sum(float(record.get("seconds", 0.0)) for record in records) or 1.0
    rows = []
    for stage in stages:
        record, measured = stage.record, stage.distortion
        seconds = record.get("seconds")
        share = 0.0 if seconds is None else float(seconds) / total
        remarks = []
        if record.get("road") not in (None, "conformal", ""):
            remarks.append(str(record["road"]))
        if record.get("converged") is False:
            remarks.append("stopped before it converged")
        remark = f"<small>{escape('; '.join(remarks))}</small>" if remarks else ""
        bar = f'<span class="bar"><i style="width:{share:.0%}"></i></span>'
        time = "–" if seconds is None else f"{seconds_text(seconds)}{bar}"
        cells = [
            time,
            f"{record['iterations']:,}" if "iterations" in record else "–",
            f"{measured.flips:,}",
            _number(measured.area["surface"]),
            _number(measured.area["p95"]),
            _number(measured.area["sphere"]),
            _number(measured.angle["surface"]),
            _number(measured.angle["p95"]),
            _number(measured.angle["sphere"]),
            _number(record["transport_cost"]) if "transport_cost" in record else "–",
        ]
        rows.append(
            f"<tr><th scope='row'>{_swatch(stage)}{escape(stage.label)}{remark}</th>"
            + "".join(f"<td>{cell}</td>" for cell in cells)
            + "</tr>"
        )
    single = ("Stage", "Time", "Steps", "Flips")
    head = "".join(f"<th scope='col' rowspan='2'>{name}</th>" for name in single)
    for name in ("Area", "Angle"):
        head += f"<th scope='colgroup' colspan='3' class='group'>{name} distortion</th>"
    head += "<th scope='col' rowspan='2'>Transport<br>cost</th></tr><tr>"
    head += 2 * "<th scope='col'>surface</th><th scope='col'>95 %</th><th scope='col'>sphere</th>"
    table = (
        '<div class="scroll" tabindex="0" role="region" aria-label="What each stage did"><table><thead>'
        f"<tr>{head}</tr></thead><tbody>{''.join(rows)}</tbody></table></div>"
    )
    words = (
        "Area distortion is σ₁σ₂ + 1/(σ₁σ₂) and angle distortion σ₁/σ₂ + σ₂/σ₁, with σ the singular values of the map "
        "on a triangle; 2 is perfect. Given are the mean weighted by area on the surface, the 95th percentile over the "
        "triangles, and the mean weighted by area on the sphere."
    )
    return _section("Stages", words, table)


def certificate(report: dict[str, Any], shown_faces: int) -> str:
    """What was established about the map; ``shown_faces`` is how many faces the interactive view has."""
    found = report.get("certificate")
    if not found:
        return ""
    flips, crossings = found.get("flips", 0), found.get("ray_degree")
    where_first = f", the first is face {found.get('first_flip')}" if flips else ", by exact orientation tests"
    facts = [
        ("Flipped triangles", f"{flips:,}{where_first}"),
        ("Rings", f"{found.get('wound', 0):,} vertices whose neighbours do not go around them exactly once"),
        ("Degree", f"{found.get('degree')} from the total signed solid angle"),
        ("Rays", f"{found.get('rays')} from the centre, each of which crosses the map {crossings} "
         f"time{'s' * (crossings != 1)} by signed count"),
        ("Smallest triangle", f"{_number(found.get('smallest_area', 0.0))} of 4π, face {found.get('smallest_face')}"),
    ]  # fmt: skip
    words = (
        "A map of a closed surface to the sphere whose triangles all keep their orientation, and whose vertices' rings "
        "all turn once, covers it evenly; degree 1 then makes it one to one and onto."
    )
    count = report.get("mesh", {}).get("faces")
    if count and shown_faces < count:
        facts.append(("Interactive view", f"simplified to {shown_faces:,} triangles; figures are of the whole mesh"))
    return _section("Certificate", words, f'<div class="card">{_facts(facts)}</div>')


def footer(report: dict[str, Any]) -> str:
    """Versions, and the paper."""
    versions = report.get("versions", {})
    names = ", ".join(f"{escape(str(name))} {escape(str(value))}" for name, value in versions.items())
    return (
        f"<p>Made with {names or 'omtwarp'}.</p>"
        "<p>Method: A. Dominitz and A. Tannenbaum, Texture Mapping via Optimal Mass Transport, IEEE Transactions on "
        "Visualization and Computer Graphics 16(3), 2010. The view uses three.js (MIT licence).</p>"
    )


def where(report: dict[str, Any]) -> str:
    device = str(report.get("device", "cpu"))
    return "on the CPU" if device == "cpu" else f"on {escape(device)}"


def _weighted_quantiles(values: Any, weights: Any, shares: Sequence[float]) -> list[float]:
    order = np.argsort(values, kind="stable")
    total = np.cumsum(weights[order])
    places = np.searchsorted(total, np.asarray(shares) * total[-1])
    return [float(values[order[min(place, len(order) - 1)]]) for place in places]


def _section(heading: str, words: str, content: str) -> str:
    return f'<section class="block"><h2>{escape(heading)}</h2><p>{words}</p>{content}</section>'


def _facts(facts: Sequence[tuple[str, str]]) -> str:
    return f'<dl class="facts">{"".join(f"<dt>{name}</dt><dd>{value}</dd>" for name, value in facts)}</dl>'


def _swatch(stage: Stage) -> str:
    return f'<i class="swatch" style="--ink:var({stage.colour})"></i>'


def _number(value: float) -> str:
    """A figure in as many characters as it deserves."""
    value = float(value)
    if not math.isfinite(value):
        return "∞" if value > 0 else "undefined"
    if value != 0 and not 1e-3 <= abs(value) < 1e5:
        mantissa, exponent = f"{value:.1e}".split("e")
        return f"{mantissa}\u202f×\u202f10<sup>{int(exponent)}</sup>"
    return f"{value:.4f}" if abs(value) < 100 else f"{value:,.0f}"


def seconds_text(value: float) -> str:
    value = float(value)
    if value < 0.1:
        return f"{1000 * value:.0f} ms"
    if value < 120:
        return f"{value:.2g} s" if value < 1 else f"{value:.1f} s"
    return f"{value / 60:.1f} min"
