"""The page about a map to a torus: the interactive view, pictures, figures of its stages and the certificate."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from omtwarp.maps.result import StageReport
from omtwarp.maps.torus_map import TorusMap, ring_torus, tube_radius
from omtwarp.mesh.surface import triangle_areas
from omtwarp.render import Camera, SurfaceView, preview
from omtwarp.render.subject import torus_view
from omtwarp.render.upright import posed
from omtwarp.reporting import sections
from omtwarp.reporting.markup import Markup, element, figure, html, join
from omtwarp.reporting.scene import (
    ANGLE_RANGE,
    AREA_RANGE,
    Scene,
    alignment,
    data_uri,
    levels,
    packed_scene,
    picture_kind,
    placed_in_view,
    signed,
    vertex_scalars,
    view_axes,
)
from omtwarp.reporting.stages import TORUS, Stage, shown_report
from omtwarp.reporting.viewer import page_with_view, verdict, viewer_section
from omtwarp.texturing.image import PictureLike
from omtwarp.texturing.textured import texture_torus

Floats = NDArray[np.float64]

# Names of the record of the last stage, and its label and colour.
LAST = {
    "omt": ("Optimal transport", "--transport"),
    "exact": ("Exact areas", "--after"),
    "refine": ("Refined", "--after"),
}


def torus_stages(result: TorusMap) -> list[Stage]:
    """Return the conformal and the final map as stages, whose points lie on the ring torus, at most 1 from its centre.

    Args:
        result: the map.
    """
    records = {record.get("name"): record for record in shown_report(result).get("stages", ())}
    name = next((name for name in reversed(records) if name in LAST), "omt")
    areas = triangle_areas(result.vertices, result.faces)
    weights = areas / max(float(areas.sum()), np.finfo(float).tiny)
    number = np.zeros(len(result.faces), dtype=np.intp)
    outside = 1.0 + tube_radius(result.lattice)
    stages = []
    for key, stage, places, (label, colour) in (
        ("conformal", "conformal", result.conformal, ("Conformal", "--before")),
        (name, "torus", result.coordinates, LAST[name]),
    ):
        points = ring_torus(places, result.lattice) / outside
        record: StageReport = records.get(key, {})
        stages.append(Stage(key, label, colour, points, result.distortion(stage), record, weights, TORUS, number))
    return stages


def torus_scene(
    result: TorusMap, stages: list[Stage], image: PictureLike | None, pattern: str, pose: SurfaceView
) -> Scene:
    """Collect what the interactive view of a map to a torus needs; it shows every triangle.

    Args:
        result: the map.
        stages: as :func:`torus_stages` gives them.
        image: a picture that repeats both ways.
        pattern: of the torus, where there is no image.
        pose: the surface's axes.
    """
    lines = 12  # of the lattice along its shorter vector
    cut = texture_torus(result, image, None if image is not None else pattern)
    used, axes = cut.welded, view_axes(pose)
    placed = placed_in_view(result.vertices, used, axes)
    arrays: dict[str, NDArray] = {
        "position": signed(placed),
        "normal": signed(cut.normals @ axes.T),
        "index": cut.faces.astype(np.uint32).ravel(),
    }
    shift = np.round(cut.uv - result.coordinates[used])  # whole turns, the same for both maps
    for stage, places in zip(stages, (result.conformal, result.coordinates), strict=True):
        area, angle = vertex_scalars(result.faces, stage)
        arrays[f"direction-{stage.key}"] = signed(stage.sphere[used])
        arrays[f"lattice-{stage.key}"] = (places[used] + shift).astype(np.float32)
        arrays[f"area-{stage.key}"] = levels(area[used], -AREA_RANGE, AREA_RANGE)
        arrays[f"angle-{stage.key}"] = levels(angle[used], 0.0, ANGLE_RANGE)
    share = tube_radius(result.lattice)
    ring = 1.0 / (1.0 + share)
    # A ring torus of the surface's own area, unless that is too large for the view.
    own = float(triangle_areas(placed, cut.faces).sum())
    # Largest ring: radius of the ring torus with its tube; that of the surface is 1
    radius = min(float(np.sqrt(own / (4.0 * np.pi**2 * ring**2 * share))), 1.0)
    along = np.linalg.norm(result.lattice, axis=1)
    header: dict[str, object] = {
        "stages": [{"key": stage.key, "label": stage.label, "flat": False} for stage in stages],
        "radius": radius,
        "ring": {"radius": ring, "lines": np.maximum(np.rint(lines * along / along.min()), 1.0).tolist()},
        "picture": [_picture(cut.image)],
    }
    return packed_scene(arrays, header, alignment(stages[-1].sphere[used], placed), len(cut.faces))


def _picture(image: NDArray[np.uint8]) -> str:
    """Write a picture that repeats as a data URI, no wider than the view shows."""
    picture_width = 1024  # texels of a pattern along the first vector; a picture of more is made smaller
    from PIL import Image as pil

    drawn = pil.fromarray(image).convert("RGB")
    kind = picture_kind(np.asarray(drawn))
    if drawn.width > picture_width:
        drawn = drawn.resize(
            (picture_width, max(round(drawn.height * picture_width / drawn.width), 1)), pil.Resampling.BOX
        )
    return data_uri(drawn, kind)


# Of the report: the map, what it is drawn on, and words about it.
PICTURES = (
    ("optimal", "surface", "The surface through the optimal map: what is equal on the torus has equal areas."),
    ("conformal", "surface", "The surface through the conformal map: shapes are kept, areas are not."),
    ("optimal", "torus", "The ring torus that the surface covers, areas in proportion."),
)


def torus_page(
    result: TorusMap,
    title: str | None,
    image: PictureLike | None,
    pattern: str,
    up: str | None,
    size: int,
    device: str,
) -> str:
    """Return the text of the page about a map to a torus; arguments as of :func:`omtwarp.write_report`."""
    pose = posed(SurfaceView(result.vertices, result.faces), up)
    drawn = []
    for which, on, _ in PICTURES:
        view = torus_view(result, image, which=which, on=on, pattern=pattern)
        if on == "surface":
            view.up, view.front = pose.up, pose.front
        drawn.append(
            preview(view, size=(size, size * 3 // 4), camera=Camera(margin=0.03), transparent=True, device=device)
        )
    shown = [
        figure(picture, f"{which}, {on}. ", words) for picture, (which, on, words) in zip(drawn, PICTURES, strict=True)
    ]
    stages = torus_stages(result)
    report = shown_report(result)
    certificate = result.certificate
    return page_with_view(
        torus_scene(result, stages, image, pattern, pose),
        title=title or "Map to a torus",
        version=report.get("versions", {}).get("omtwarp", ""),
        lead=f"{len(result.vertices):,} vertices and {len(result.faces):,} triangles, mapped to a flat torus.",
        verdict=verdict(certificate.bijective, certificate.flips),
        view=viewer_section(
            stages,
            data_uri(drawn[0], "webp"),
            "The pattern carried to the surface by the final map",
            "Picture" if image is not None else pattern.capitalize(),
        ),
        sections=join(
            [
                sections.figures(stages, report),
                sections.section(
                    "Before and after",
                    "The pattern on the torus, carried to the surface by two maps.",
                    element("div", *shown, class_="pair pictures"),
                ),
                sections.distributions(stages),
                sections.stage_table(stages, report),
                sections.section("Certificate", _certified(result), _torus(result)),
            ],
            "\n",
        ),
        footer=sections.footer(report),
    )


def _certified(result: TorusMap) -> Markup:
    certificate = result.certificate
    verdict = "The map is one to one" if certificate.bijective else "The map is not one to one"
    return html("{}: {}, decided exactly in the universal cover.", verdict, certificate)


def _torus(result: TorusMap) -> Markup:
    along = np.linalg.norm(result.lattice, axis=1)
    angle = np.degrees(np.arccos(np.clip(result.lattice[0] @ result.lattice[1] / along.prod(), -1.0, 1.0)))
    return element(
        "p",
        f"The torus repeats along vectors of length {along[0]:.6g} and {along[1]:.6g} at {angle:.2f} degrees; it has "
        "the surface's area.",
    )
