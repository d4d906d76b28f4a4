"""The page about a map to a torus: pictures, figures of its stages and the certificate, without a script."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from omtwarp.render import Camera, preview
from omtwarp.render.subject import torus_view
from omtwarp.reporting.markup import Markup, element
from omtwarp.reporting.plain import figure, pictures, table, write_plain_page
from omtwarp.texturing.image import PictureLike
from omtwarp.torus.torus_map import TorusMap

FIGURES = (
    ("seconds", "seconds", "{:.2f}"),
    ("iterations", "steps", "{:d}"),
    ("ended", "ended", "{}"),
    ("transport_cost", "transport cost", "{:.6g}"),
    ("largest_ring_error", "largest error of an area around a vertex", "{:.1e}"),
    ("flips", "flipped triangles", "{:d}"),
)


def write_torus_report(
    result: TorusMap,
    path: Path,
    *,
    title: str | None = None,
    image: PictureLike | None = None,
    pattern: str = "circles",
    up: str | None = None,
    picture_size: int = 720,
    device: str = "auto",
) -> Path:
    """Write the page; arguments as of :func:`omtwarp.write_report`.

    Args:
        result: the map.
        path: the file; it appears whole or not at all.
        title: heading of the page.
        image: a picture that repeats both ways.
        pattern: ``circles`` or ``checker``, where there is no image.
        up: the axis of the surface that points upwards.
        picture_size: width of the pictures in pixels.
        device: where pictures are drawn without OpenGL.
    """
    shown = []
    for which, on, words in (
        ("optimal", "surface", "The surface through the optimal map: what is equal on the torus has equal areas."),
        ("conformal", "surface", "The surface through the conformal map: shapes are kept, areas are not."),
        ("optimal", "torus", "The ring torus that the surface covers, areas in proportion."),
    ):
        view = torus_view(result, image, which=which, on=on, pattern=pattern)
        if on == "surface" and up is not None:
            view.up = up
        drawn = preview(
            view,
            size=(picture_size, picture_size * 3 // 4),
            camera=Camera(margin=0.03),
            transparent=True,
            device=device,
        )
        shown.append(figure(drawn, f"{which}, {on}. ", words))
    body = [pictures(shown), *_words(result), _stages(result)]
    return write_plain_page(path, title or "Map to a torus", body)


def _words(result: TorusMap) -> list[Markup]:
    certificate = result.certificate
    along = np.linalg.norm(result.lattice, axis=1)
    angle = np.degrees(np.arccos(np.clip(result.lattice[0] @ result.lattice[1] / along.prod(), -1.0, 1.0)))
    verdict = "The map is one to one" if certificate.bijective else "The map is not one to one"
    lines = [
        f"{len(result.vertices)} vertices, {len(result.faces)} faces. {verdict}: {certificate}, decided exactly in the "
        "universal cover.",
        f"The torus repeats along vectors of length {along[0]:.6g} and {along[1]:.6g} at {angle:.2f} degrees; it has "
        "the surface's area.",
    ]
    return [element("p", line) for line in lines]


def _stages(result: TorusMap) -> Markup:
    given = result.report.get("stages")
    stages = [stage for stage in given if isinstance(stage, dict)] if isinstance(given, list) else []
    lines = []
    for name, words, form in FIGURES:
        values = [stage.get(name) for stage in stages]
        if any(value is not None for value in values):
            lines.append([words, *(_number(form, value) for value in values)])
    for kind in ("area", "angle"):
        found = [stage.get(kind) for stage in stages]
        means = [value.get("surface") if isinstance(value, dict) else None for value in found]
        lines.append([f"mean {kind} distortion (2 is none)", *(_number("{:.4f}", value) for value in means)])
    return table(["", *(str(stage.get("name", "")) for stage in stages)], lines)


def _number(form: str, value: object) -> str:
    """Write a value of a report, which may come from a file, as text."""
    if value is None:
        return ""
    try:
        return form.format(value)
    except (TypeError, ValueError):
        return str(value)


__all__ = ["write_torus_report"]
