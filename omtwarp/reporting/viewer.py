"""The interactive view's elements, and the page around it."""

from __future__ import annotations

from collections.abc import Sequence

from omtwarp.reporting.markup import Markup, asset, data_block, fill_page, html, join, script, source_hash
from omtwarp.reporting.scene import (
    ANGLE_COLOURS,
    ANGLE_PART,
    ANGLE_RANGE,
    AREA_COLOURS,
    AREA_RANGE,
    Scene,
    colour_ramp,
)
from omtwarp.reporting.stages import TORUS, Stage

# A tick on a disc, and a warning; drawn here so that they do not depend on fonts.
_TICK = html(
    '<svg viewBox="0 0 20 20" aria-hidden="true"><circle cx="10" cy="10" r="9" fill="currentColor" opacity=".18"/>'
    '<path d="M5.8 10.4l2.8 2.8 5.6-6" fill="none" stroke="currentColor" stroke-width="2" stroke-linecap="round" '
    'stroke-linejoin="round"/></svg>'
)
_WARNING = html(
    '<svg viewBox="0 0 20 20" aria-hidden="true"><circle cx="10" cy="10" r="9" fill="currentColor" opacity=".18"/>'
    '<path d="M10 5.4v5.6M10 13.6v.6" stroke="currentColor" stroke-width="2.2" stroke-linecap="round"/></svg>'
)
_ICON = "<svg xmlns='http://www.w3.org/2000/svg' viewBox='0 0 24 24'><circle cx='12' cy='12' r='10.4' fill='%231f6f78'/><g fill='none' stroke='%23fff' stroke-width='1.3' opacity='.9'><ellipse cx='12' cy='12' rx='4.6' ry='10.4'/><path d='M1.6 12h20.8M3.2 6.8h17.6M3.2 17.2h17.6'/></g></svg>"  # noqa: E501


def page_with_view(
    scene: Scene,
    *,
    title: str,
    version: str,
    lead: str,
    verdict: Markup,
    view: Markup,
    sections: Markup,
    footer: Markup,
) -> str:
    """Put a page together: one HTML file that needs nothing else.

    Args:
        scene: what the view draws.
        title: heading of the page.
        version: of the package.
        lead: a sentence below the heading.
        verdict: whether the map is one to one, see :func:`verdict`.
        view: see :func:`viewer_section`.
        sections: what follows the view.
        footer: the end of the page.
    """
    three, viewer = script("three/three.min.js"), script("viewer.js")
    return fill_page(
        asset("page.html"),
        version=version,
        title=title,
        scripts=html("{} {}", source_hash(three), source_hash(viewer)),
        icon=f"data:image/svg+xml,{_ICON.replace('<', '%3C').replace('>', '%3E').replace(' ', '%20')}",
        style=asset("page.css"),
        lead=lead,
        verdict=verdict,
        view=view,
        sections=sections,
        footer=footer,
        scene=data_block(scene.header),
        data=data_block(scene.data),
        three=three,
        viewer=viewer,
    )


def verdict(bijective: bool, flips: int) -> Markup:
    """Say whether a map is one to one, or how many triangles it flips."""
    if bijective:
        return html('<p class="verdict">{} Certified one to one: no flipped triangle, degree 1</p>', _TICK)
    if flips:
        words = f"{flips:,} flipped triangle{'s' * (flips > 1)}: not one to one"
        return html('<p class="verdict bad">{} {}</p>', _WARNING, words)
    return html('<p class="verdict bad">{} Not certified</p>', _WARNING)


def viewer_section(stages: Sequence[Stage], poster: str, poster_alt: str, texture: str) -> Markup:
    """Make the elements of the interactive view, over a picture that is shown until the view draws.

    Args:
        stages: of the map, the last one shown first.
        poster: the picture, as a data URI.
        poster_alt: what the picture shows.
        texture: name of the texture among the colourings.
    """
    return Markup(
        fill_page(
            asset("viewer.html"),
            poster=poster,
            poster_alt=poster_alt,
            controls=_controls(stages, texture),
            legends=_legends(stages[-1].domain),
        )
    )


def _controls(stages: Sequence[Stage], texture: str) -> Markup:
    last, domain = stages[-1].key, stages[-1].domain
    colourings = [
        ("picture", texture),
        ("graticule", "Lattice" if domain == TORUS else "Graticule"),
        ("area", "Area"),
        ("angle", "Angle"),
        ("plain", "Plain"),
    ]
    return (
        _segments("Map", "stage", [(stage.key, stage.label) for stage in stages], last)
        + _segments("Colour", "colouring", colourings, "picture")
        + html(
            '<label class="slider"><span><em>Surface</em><em>{}</em></span>'
            '<input type="range" name="morph" min="0" max="100" value="0" aria-label="From the surface to the {}">'
            "</label>"
            '<div class="buttons"><label class="toggle"><input type="checkbox" name="wireframe">Wireframe</label>'
            '<button type="button" id="viewer-home">Reset view</button></div>',
            domain.capitalize(),
            domain,
        )
    )


def _legends(domain: str) -> Markup:
    area, angle = 2.0**AREA_RANGE, 2.0**ANGLE_RANGE
    area_ticks = (f"1/{area:.0f}", "1", f"{area:.0f}")
    angle_ticks = ("1", f"{2 ** (ANGLE_RANGE / 2):.1f}", f"{angle:.0f} or more")
    return _legend("area", f"Area: {domain} / surface", colour_ramp(AREA_COLOURS, count=12), area_ticks) + _legend(
        "angle", "Larger / smaller stretch", colour_ramp(ANGLE_COLOURS, ANGLE_PART, count=12), angle_ticks
    )


def _segments(legend: str, name: str, options: Sequence[tuple[str, str]], chosen: str) -> Markup:
    labels = join(
        html(
            '<label><input type="radio" name="{}" value="{}"{}><span>{}</span></label>',
            name,
            key,
            " checked" if key == chosen else "",
            label,
        )
        for key, label in options
    )
    return html('<fieldset><legend>{}</legend><div class="segments">{}</div></fieldset>', legend, labels)


def _legend(name: str, label: str, colours: str, ticks: Sequence[str]) -> Markup:
    stops = ",".join(f"#{colours[k : k + 6]}" for k in range(0, len(colours), 6))
    return html(
        '<div class="legend" data-legend="{}" hidden><span>{}</span>'
        '<i style="background:linear-gradient(90deg,{})"></i><b>{}</b></div>',
        name,
        label,
        stops,
        join(html("<em>{}</em>", tick) for tick in ticks),
    )
