"""The page of a registration: features before and after, strain, and pictures of both."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from omtwarp.maps.result import MapResult
from omtwarp.mesh.arrays import Floats, Ints
from omtwarp.registration.register import Registration
from omtwarp.registration.strain import strain_at_vertices
from omtwarp.render import film, preview
from omtwarp.reporting.markup import Markup, element, figure, pictures, table, write_plain_page
from omtwarp.resampling import SpherePoints, resample

VIEWS = ("left", "right")


def write_registration_page(path: Path, found: Registration, moving: SpherePoints, target: SpherePoints) -> Path:
    """Write a page that needs no other file.

    Args:
        path: the file.
        found: the registration.
        moving: the map that was registered, with its surface where strain is to be drawn on that.
        target: what it was registered to.
    """
    ours, theirs = found.features
    grid = target.grid
    ball = grid.points[: grid.own_points], grid.own_triangles
    places = (found.start.sphere, moving.grid.own_triangles), (found.sphere, moving.grid.own_triangles)
    carried = [resample(place, target, device="cpu") for place in places] if moving.grid.own is None else []
    body = [_facts(found)]
    for name, values in theirs.items():
        known = values[: grid.own_points]
        ends = float(np.quantile(known, 0.02)), float(np.quantile(known, 0.98))
        drawn = [_figure(ball, known, "the target", f": {name}", ends)]
        for one, when in zip(carried, ("before", "after"), strict=False):
            agreement = f": {name}, correlation {found.correlations[name][when]:.3f}"
            drawn.append(_figure(ball, one.apply(ours[name]), when, agreement, ends))
        body += [element("h2", name), pictures(drawn)]
    surface = found.start.sphere if moving.vertices is None else moving.vertices[: moving.grid.own_points]
    shown = surface, moving.grid.own_triangles
    strains = {"ratios of areas": found.area_strain, "ratios of stretches": found.stretch_strain}
    drawn = []
    for name, strain in strains.items():
        values, bound = strain_at_vertices(found.start.sphere, shown[1], strain), found.most_strain
        words = f": log2, {np.percentile(np.abs(strain), 95):.2f} at the 95th percentile of triangles"
        drawn.append(_figure(shown, values, name, words, (-bound, bound)))
    return write_plain_page(path, "Registration", [*body, element("h2", "Strain"), pictures(drawn)])


def film_warp(path: Path, found: Registration, result: MapResult) -> Path:
    """Film a map from the rotation that its warp started from to where it is registered, and on to the sphere.

    Args:
        path: as of :func:`omtwarp.film`.
        found: the registration.
        result: the map that was registered.
    """
    registered = found.registered(result)
    return film(replace(registered, conformal=found.start.sphere), path, captions=False)


def _facts(found: Registration) -> Markup:
    """Return the table of agreement and strain, and what is to be known of the start."""
    certificate = found.certificate
    lines: list[tuple[str, str]] = [
        (f"correlation of {name}", f"{values['before']:.3f} before, {values['after']:.3f} after")
        for name, values in found.correlations.items()
    ]
    lines += [
        (f"{label}: degrees from its place", f"{apart['before']:.2f} before, {apart['after']:.2f} after")
        for label, apart in found.landmarks.items()
    ]
    start = f"score {found.start.score:.3f}, the next best rotation {found.start.runner_up:.3f}"
    lines += [
        ("largest strain, log2", f"{found.largest_strain:.2f} of {found.most_strain:g} allowed"),
        ("triangles turned over", str(certificate.flips)),
        ("degree", str(certificate.degree)),
        ("start", start + (f"; doubtful, the best of {len(found.starts)} was taken" if found.doubtful else "")),
    ]
    return table(("measure", "value"), lines)


def _figure(mesh: tuple[Floats, Ints], values: Floats, name: str, words: str, ends: tuple[float, float]) -> Markup:
    picture = preview(mesh, size=(360, 300), views=VIEWS, up="z", scalar=values, colormap="coolwarm", scalar_range=ends)
    return figure(picture, name, words)
