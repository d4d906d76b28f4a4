"""The report page: one HTML file with everything in it, to be read without a network."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from omtwarp.errors import OmtwarpError
from omtwarp.files import as_path, check_output, staged
from omtwarp.render import Camera, ScalarField, SurfaceView
from omtwarp.render.pictures import draw_in_background
from omtwarp.render.upright import posed
from omtwarp.reporting import sections
from omtwarp.reporting.markup import Markup, asset, data_block, fill_page, html, join, script, source_hash
from omtwarp.reporting.record import shown_history, shown_report
from omtwarp.reporting.scene import (
    ANGLE_COLOURS,
    ANGLE_PART,
    ANGLE_RANGE,
    AREA_COLOURS,
    AREA_RANGE,
    Scene,
    colour_ramp,
    data_uri,
    log2_area_ratio,
    make_scene,
)
from omtwarp.reporting.stages import Stage, stages_of, view_on_domain
from omtwarp.reporting.torus_page import write_torus_report
from omtwarp.result import MapReport, MapResult
from omtwarp.texturing import read_image
from omtwarp.texturing.image import PictureLike
from omtwarp.texturing.patterns import Pattern
from omtwarp.texturing.patterns import pattern as pattern_by_name
from omtwarp.texturing.rasterizing import rasterize
from omtwarp.torus.torus_map import TorusMap

MOST_EDGES = 60_000  # faces: with more, edges would hide the surface between them
TEXTURES = {"circles": "Circles of equal size", "puzzle": "A jigsaw puzzle", "globe": "A globe", "checker": "A checker"}
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

PICTURE_WIDTH = 1536  # texels around the sphere of the texture of still pictures: three for each pixel of the surface
PICTURE_SAMPLES = 2  # along the side of a texel: pictures average over several texels besides


def write_report(
    result: MapResult | TorusMap,
    path: str | os.PathLike[str],
    *,
    title: str | None = None,
    image: PictureLike | None = None,
    pattern: str = "circles",
    up: str | None = None,
    picture_size: int = 720,
    device: str = "auto",
) -> Path:
    """Write the report page of a map: one HTML file that needs nothing else, no network and no other file.

    It holds an interactive view of the surface and its maps (a still picture where the browser cannot draw in 3D), the
    surface textured by the first and by the final map, the distribution of area and angle distortion at every stage
    (section 6 of the paper), the cost of the transport over its iterations, what each stage did, and the certificate.

    Args:
        result: a :class:`~omtwarp.result.MapResult`; or a :class:`omtwarp.TorusMap`, of which the page has still
            pictures only.
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
    if isinstance(result, TorusMap):
        return write_torus_report(
            result,
            target,
            title=title,
            image=image,
            pattern=pattern,
            up=up,
            picture_size=picture_size,
            device=device,
        )
    page = report_page(
        result, title=title, image=image, pattern=pattern, up=up, picture_size=picture_size, device=device
    )
    with staged(target) as file:
        file.write_text(page, "utf-8")
    return target


def report_page(
    result: MapResult,
    *,
    title: str | None = None,
    image: PictureLike | None = None,
    pattern: str = "circles",
    up: str | None = None,
    picture_size: int = 720,
    device: str = "auto",
) -> str:
    """Return the text of the page that :func:`write_report` writes, with the same arguments.

    Raises:
        OmtwarpError: as :func:`write_report`.
    """
    if not all(hasattr(result, name) for name in ("vertices", "faces", "sphere", "conformal", "distortion", "report")):
        raise OmtwarpError(f"cannot report on a {type(result).__name__}: give a result of map_to_sphere")
    texture = read_image(image) if image is not None else pattern_by_name(pattern)
    shown = "The picture" if image is not None else TEXTURES.get(pattern, "The pattern")
    stages = stages_of(result)
    pose = posed(SurfaceView(result.vertices, result.faces), up)
    background = ThreadPoolExecutor(1)
    try:
        stills = _stills(result, stages, texture, pose, picture_size, device, background)
        scene = make_scene(result, stages, texture, pose=pose, device=device)
        colouring = "Picture" if image is not None else pattern.capitalize()
        return _page(result, stages, scene, stills, title or "Map report", shown, colouring)
    finally:
        background.shutdown(wait=False, cancel_futures=True)


def _page(
    result: MapResult,
    stages: Sequence[Stage],
    scene: Scene,
    stills: Mapping[str, str],
    heading: str,
    shown: str,
    colouring: str,
) -> str:
    """Put the page together; ``shown`` names the texture in sentences, ``colouring`` among the view's colourings."""
    # The certificate was computed from the result's arrays: a file's statements are not trusted.
    report = shown_report(result) | {"certificate": result.certificate.to_dict()}
    content = [
        sections.figures(stages, report),
        sections.pictures(stages, stills, shown),
        sections.distributions(stages),
        sections.transport(report, shown_history(result), stages),
        sections.stage_table(stages, report),
        sections.certificate(report, scene.faces, stages[-1], getattr(result, "filled_faces", None) is not None),
    ]
    three, viewer = script("three/three.min.js"), script("viewer.js")
    return fill_page(
        asset("page.html"),
        version=report.get("versions", {}).get("omtwarp", ""),
        title=heading,
        scripts=html("{} {}", source_hash(three), source_hash(viewer)),
        icon=f"data:image/svg+xml,{_ICON.replace('<', '%3C').replace('>', '%3E').replace(' ', '%20')}",
        style=asset("page.css"),
        lead=_lead(result, report, stages[-1]),
        verdict=_verdict(report, stages),
        view=viewer_section(
            stages,
            stills[stages[-1].key],
            f"{shown} carried to the surface by the final map",
            colouring,
        ),
        sections=join(content, "\n"),
        footer=sections.footer(report),
        scene=data_block(scene.header),
        data=data_block(scene.data),
        three=three,
        viewer=viewer,
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
    done = [
        f"{count} {name}{'s' * (count > 1)} {what}"
        for count, name, what in ((holes, "hole", "filled"), (cuts, "handle", "cut open"))
        if count
    ]
    more = f" {' and '.join(done)}." if done else ""
    return f"{' '.join(parts).rstrip(',')}.{more}"


def _verdict(report: MapReport, stages: Sequence[Stage]) -> Markup:
    certificate = report.get("certificate", {})
    flips = certificate.get("flips")
    flips = stages[-1].distortion.flips if flips is None else flips
    if certificate.get("bijective"):
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
        ("graticule", "Graticule"),
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


class _Stills(Mapping[str, str]):
    """Pictures as data URIs, by key; each is waited for where it is asked for."""

    def __init__(self, begun: Mapping[str, Callable[[], str]]):
        self._begun = begun
        self._drawn: dict[str, str] = {}

    def __getitem__(self, key: str) -> str:
        if key not in self._drawn:
            self._drawn[key] = self._begun[key]()
        return self._drawn[key]

    def __iter__(self) -> Iterator[str]:
        return iter(self._begun)

    def __len__(self) -> int:
        return len(self._begun)


def _stills(
    result: MapResult,
    stages: Sequence[Stage],
    texture: Pattern | NDArray[np.generic],
    pose: SurfaceView,
    size: int,
    device: str,
    background: Executor,
) -> Mapping[str, str]:
    """Begin the pictures of the first and the last stage, by key: the surface, and ``sphere KEY``."""
    begun: dict[str, Callable[[], str]] = {}

    def begin(key: str, subject: SurfaceView) -> None:
        begun[key] = draw_in_background(
            background,
            subject,
            lambda drawn: data_uri(drawn, "webp"),
            size=(size, size * 3 // 4),
            camera=Camera(margin=0.03),
            transparent=True,
            color_bar=False,
            device=device,
        )

    shown = (stages[0], stages[-1])[: len(stages)]
    for stage in shown:
        bound = AREA_RANGE
        field = ScalarField(np.clip(log2_area_ratio(stage), -bound, bound), AREA_COLOURS, (-bound, bound))
        edges = len(result.faces) <= MOST_EDGES
        begin(f"sphere {stage.key}", replace(view_on_domain(result, stage, pose), scalar=field, edges=edges))
    picture: NDArray[np.generic]
    if isinstance(texture, Pattern):
        picture = rasterize(texture, PICTURE_WIDTH, supersample=PICTURE_SAMPLES, device=device)
    else:
        picture = texture
    for stage in shown:
        begin(stage.key, replace(pose, image=picture, sphere=stage.sphere))
    return _Stills(begun)
