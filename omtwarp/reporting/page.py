"""The report page: one HTML file with everything in it, to be read without a network."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from omtwarp.errors import OmtwarpError
from omtwarp.files.output import as_path, check_output, write_text
from omtwarp.maps.domains import is_torus_map
from omtwarp.maps.result import MapReport, MapResult, StageReport
from omtwarp.maps.torus_map import ring_torus, tube_radius
from omtwarp.mesh.arrays import Bytes, norms, whole_number
from omtwarp.mesh.surface import triangle_areas
from omtwarp.options import PatternLike
from omtwarp.render import Camera, ScalarField, SurfaceView, preview
from omtwarp.render.subject import posed, torus_view
from omtwarp.reporting import scene as views, sections
from omtwarp.reporting.markup import Markup, data_uri, element, figure, fill_page, html, join
from omtwarp.reporting.scene import AREA_COLOURS, RANGE, Scene, make_scene
from omtwarp.reporting.stages import KNOWN, TORUS, Stage, shown_history, shown_report, stages_of, view_on_domain
from omtwarp.texturing import read_image
from omtwarp.texturing.adaptive import rasterize
from omtwarp.texturing.image import PictureLike
from omtwarp.texturing.patterns import Pattern, pattern as pattern_by_name
from omtwarp.texturing.textured import texture_torus


def write_report(
    result: MapResult,
    path: str | os.PathLike[str],
    *,
    title: str | None = None,
    image: PictureLike | None = None,
    pattern: PatternLike = "circles",
    up: str | None = None,
    picture_size: int = 720,
    device: str = "auto",
) -> Path:
    """Write the report page of a map: one HTML file that needs nothing else, no network and no other file.

    It holds an interactive view of the surface and its maps (a still picture where the browser cannot draw in 3D), the
    surface textured by the first and by the final map, the distribution of area and angle distortion at every stage
    (section 6 of the paper), the cost of the transport over its iterations, what each stage did, and the certificate.

    Args:
        result: a :class:`omtwarp.MapResult`; of a map to a torus the view shows the ring torus.
        path: the file to write; it appears whole or not at all.
        title: heading of the page; "Map report" by default.
        image: equirectangular picture shown on the surface: a path, a PIL image or an array [H, W, 3].
        pattern: ``circles``, ``puzzle``, ``globe`` or ``checker``, shown where there is no image.
        up: the axis of the surface that points upwards: ``y``, ``z``, ``-x``, ...; guessed from its shape by default.
        picture_size: side of the still pictures in pixels.
        device: ``auto``, ``cpu`` or ``cuda:N``, for baking the texture and, without OpenGL, for drawing.

    Returns:
        The path.

    Raises:
        OmtwarpError: the map, image or an option cannot be used, or the file cannot be written.

    Example:
        >>> import omtwarp
        >>> result = omtwarp.map_to_sphere(omtwarp.shapes.blob(seed=3, sphere=320), until="conformal", device="cpu")
        >>> _ = omtwarp.write_report(result, "blob.html", title="A blob", device="cpu")
        >>> open("blob.html", encoding="utf-8").read().count("<title>A blob")
        1
    """
    target = as_path(path)
    check_output(target)
    page = report_page(
        result, title=title, image=image, pattern=pattern, up=up, picture_size=picture_size, device=device
    )
    write_text(target, page)
    return target


def report_page(
    result: MapResult,
    *,
    title: str | None = None,
    image: PictureLike | None = None,
    pattern: PatternLike = "circles",
    up: str | None = None,
    picture_size: int = 720,
    device: str = "auto",
) -> str:
    """Return the text of the page that :func:`write_report` writes, with the same arguments.

    Raises:
        OmtwarpError: as :func:`write_report`.
    """
    known = ("vertices", "faces", "sphere", "conformal", "distortion", "report")
    if not is_torus_map(result) and not all(hasattr(result, name) for name in known):
        raise OmtwarpError(f"cannot report on a {type(result).__name__}: give a result of map_to_sphere")
    side = whole_number(picture_size, "picture_size", least=2)
    pose, report = posed(SurfaceView(result.vertices, result.faces), up), shown_report(result)
    if is_torus_map(result):
        heading, shown, stages = "Map to a torus", "The pattern", torus_stages(result)
        scene = torus_scene(result, stages, image, pattern, pose)
        poster, drawn = _torus_pictures(result, image, pattern, pose, side, device)
        cost, certificate = html(""), _certificate(result)
        lead = f"{len(result.vertices):,} vertices and {len(result.faces):,} triangles, mapped to a flat torus."
    else:
        texture = read_image(image) if image is not None else pattern_by_name(pattern)
        shown = "The picture" if image is not None else pattern_by_name(pattern).title
        heading, stages = "Map report", stages_of(result)
        # The certificate was computed from the result's arrays: a file's statements are not trusted.
        report = report | {"certificate": result.certificate.to_dict()}
        stills = _stills(result, stages, texture, pose, side, device)
        poster, drawn = stills[stages[-1].key], sections.pictures(stages, stills, shown)
        scene = make_scene(result, stages, texture, pose=pose, device=device)
        cost, filled = sections.transport(report, shown_history(result), stages), getattr(result, "filled_faces", None)
        certificate = sections.certificate(report, scene.faces, stages[-1], filled is not None)
        lead = _lead(result, report, stages[-1])
    colouring = "Picture" if image is not None else pattern.capitalize()
    figures, distributions = sections.figures(stages, report), sections.distributions(stages)
    return views.page_with_view(
        "page.html",
        scene,
        title=title or heading,
        version=report.get("versions", {}).get("omtwarp", ""),
        lead=lead,
        verdict=views.verdict(result.certificate.bijective, result.certificate.flips),
        view=views.viewer_section(stages, poster, f"{shown} carried to the surface by the final map", colouring),
        sections=join([figures, drawn, distributions, cost, sections.stage_table(stages, report), certificate], "\n"),
        versions=", ".join(f"{name} {value}" for name, value in report.get("versions", {}).items()) or "omtwarp",
    )


def _lead(result: MapResult, report: MapReport, last: Stage) -> str:
    where = f"{last.count} {last.domain}, one for each part" if last.count > 1 else f"the unit {last.domain}"
    if last.domain in ("hemisphere", "cap"):
        where = f"a spherical {last.domain}" if last.domain == "cap" else "the hemisphere"
    if getattr(result, "cap_centres", None) is not None:
        where += ", all parts side by side"
    parts = [f"{len(result.vertices):,} vertices and {len(result.faces):,} triangles, mapped to {where},"]
    if "seconds" in report:
        parts.append(f"in {sections.seconds_text(report['seconds'])} {sections.where(report)}")
    loops, pairs = (getattr(result, name, None) for name in ("loop_ends", "loop_pairs"))
    cuts = 0 if pairs is None else len(pairs)
    holes = 0 if loops is None else len(loops) - 2 * cuts
    kinds = (holes, "hole", "filled"), (cuts, "handle", "cut open")
    done = [f"{count} {name}{'s' * (count > 1)} {what}" for count, name, what in kinds if count]
    more = f" {' and '.join(done)}." if done else ""
    return f"{' '.join(parts).rstrip(',')}.{more}"


def _stills(
    result: MapResult, stages: Sequence[Stage], texture: Pattern | NDArray, pose: SurfaceView, size: int, device: str
) -> dict[str, str]:
    """Draw the first and the last stage, as data URIs by key: the surface, and ``sphere KEY``."""
    stills: dict[str, str] = {}
    # Texels around the sphere of the texture of still pictures: three for each pixel of the surface. Along the side of
    # a texel two samples: pictures average over several texels besides.
    picture: NDArray[np.generic]
    picture = rasterize(texture, 1536, supersample=2, device=device) if isinstance(texture, Pattern) else texture
    # Most edges, faces: with more, edges would hide the surface between them
    edges = len(result.faces) <= 60_000
    for stage in (stages[0], stages[-1])[: len(stages)]:
        field = ScalarField(np.clip(views.log2_area_ratio(stage), -RANGE, RANGE), AREA_COLOURS, (-RANGE, RANGE))
        on_domain = replace(view_on_domain(result, stage, pose), scalar=field, edges=edges)
        on_surface = replace(pose, image=picture, sphere=stage.sphere)
        for key, shown in ((f"sphere {stage.key}", on_domain), (stage.key, on_surface)):
            stills[key] = data_uri(_still(shown, size, device), "webp")
    return stills


def _still(subject: SurfaceView, size: int, device: str) -> Image.Image | list[Image.Image]:
    """Draw a picture of a page."""
    sides, camera = (size, size * 3 // 4), Camera(margin=0.03)
    return preview(subject, size=sides, camera=camera, transparent=True, color_bar=False, device=device)


# Names of the record of the last stage, and its label and colour.
LAST = {key: look for _, key, *look in KNOWN[2:]} | {"exact": ["Exact areas", "--after"]}


def torus_stages(result: MapResult) -> list[Stage]:
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
        ("conformal", "conformal", result.conformal, ["Conformal", "--before"]),
        (name, "coordinates", result.coordinates, LAST[name]),
    ):
        points = ring_torus(places, result.lattice) / outside
        record: StageReport = records.get(key, {})
        stages.append(Stage(key, label, colour, points, result.distortion(stage), record, weights, TORUS, number))
    return stages


def torus_scene(
    result: MapResult, stages: list[Stage], image: PictureLike | None, pattern: str, pose: SurfaceView
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
    faces, used, uv = cut.split()
    axes = views.view_axes(pose)
    placed = views.placed_in_view(result.vertices, used, axes)
    shift = np.round(uv - result.coordinates[used])  # whole turns, the same for both maps
    maps = zip(stages, (result.conformal, result.coordinates), strict=True)
    own = {f"lattice-{stage.key}": (places[used] + shift).astype(np.float32) for stage, places in maps}
    share = tube_radius(result.lattice)
    ring = 1.0 / (1.0 + share)
    # A ring torus of the surface's own area, unless that is too large for the view.
    area = float(triangle_areas(placed, faces).sum())
    # Largest ring: radius of the ring torus with its tube; that of the surface is 1
    radius = min(float(np.sqrt(area / (4.0 * np.pi**2 * ring**2 * share))), 1.0)
    along = norms(result.lattice)
    shown = {"radius": ring, "lines": np.maximum(np.rint(lines * along / along.min()), 1.0).tolist()}
    header = {"radius": radius, "ring": shown, "picture": [_picture(cut.image)]}
    turn = views.alignment(stages[-1].sphere[used], placed)
    normals = cut.unit_normals()[used] @ axes.T
    return views.packed_scene(stages, result.faces, used, (placed, normals, faces), own, header, turn)


def _picture(image: Bytes) -> str:
    """Write a picture that repeats as a data URI, no wider than the view shows."""
    picture_width = 1024  # texels of a pattern along the first vector; a picture of more is made smaller
    drawn = Image.fromarray(image).convert("RGB")
    kind = views.picture_kind(np.asarray(drawn))
    if drawn.width > picture_width:
        height = max(round(drawn.height * picture_width / drawn.width), 1)
        drawn = drawn.resize((picture_width, height), Image.Resampling.BOX)
    return data_uri(drawn, kind)


# Of the report: the map, what it is drawn on, and words about it.
PICTURES = (
    ("optimal", "surface", "The surface through the optimal map: what is equal on the torus has equal areas."),
    ("conformal", "surface", "The surface through the conformal map: shapes are kept, areas are not."),
    ("optimal", "torus", "The ring torus that the surface covers, areas in proportion."),
)


def _torus_pictures(
    result: MapResult, image: PictureLike | None, pattern: str, pose: SurfaceView, size: int, device: str
) -> tuple[str, Markup]:
    """Draw a map to a torus; return the first picture, as a data URI, and the section with all of them."""
    drawn, shown = [], []
    for which, on, seen in PICTURES:
        subject = torus_view(result, image, which=which, on=on, pattern=pattern)
        if on == "surface":
            subject.up, subject.front = pose.up, pose.front
        drawn.append(_still(subject, size, device))
        shown.append(figure(drawn[-1], f"{which}, {on}. ", seen))
    words = "The pattern on the torus, carried to the surface by two maps."
    pair = element("div", *shown, class_="pair pictures")
    return data_uri(drawn[0], "webp"), sections.section("Before and after", words, pair)


def _certificate(result: MapResult) -> Markup:
    """Return the certificate of a map to a torus, and the torus."""
    words = "The map is one to one" if result.certificate.bijective else "The map is not one to one"
    along = norms(result.lattice)
    angle = np.degrees(np.arccos(np.clip(result.lattice[0] @ result.lattice[1] / along.prod(), -1.0, 1.0)))
    return fill_page(
        "torus_certificate.html", words=words, certificate=result.certificate, one=f"{along[0]:.6g}",
        other=f"{along[1]:.6g}", angle=f"{angle:.2f}",
    )  # fmt: skip
