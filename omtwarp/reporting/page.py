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
from omtwarp.files.output import as_path, check_output, staged
from omtwarp.maps.result import MapReport, MapResult
from omtwarp.maps.torus_map import TorusMap
from omtwarp.options import PatternLike
from omtwarp.render import Camera, ScalarField, SurfaceView
from omtwarp.render.pictures import draw_in_background
from omtwarp.render.upright import posed
from omtwarp.reporting import sections
from omtwarp.reporting.markup import Markup, join
from omtwarp.reporting.scene import AREA_COLOURS, AREA_RANGE, Scene, data_uri, log2_area_ratio, make_scene
from omtwarp.reporting.stages import Stage, shown_history, shown_report, stages_of, view_on_domain
from omtwarp.reporting.torus_page import torus_page
from omtwarp.reporting.viewer import page_with_view, verdict, viewer_section
from omtwarp.texturing import read_image
from omtwarp.texturing.adaptive import rasterize
from omtwarp.texturing.image import PictureLike
from omtwarp.texturing.patterns import Pattern
from omtwarp.texturing.patterns import pattern as pattern_by_name


def write_report(
    result: MapResult | TorusMap,
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
        result: a :class:`~omtwarp.maps.result.MapResult`; or a :class:`omtwarp.TorusMap`, of which the view shows the
            ring torus.
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
    with staged(target) as file:
        file.write_text(page, "utf-8")
    return target


def report_page(
    result: MapResult | TorusMap,
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
    if isinstance(result, TorusMap):
        return torus_page(result, title, image, pattern, up, picture_size, device)
    if not all(hasattr(result, name) for name in ("vertices", "faces", "sphere", "conformal", "distortion", "report")):
        raise OmtwarpError(f"cannot report on a {type(result).__name__}: give a result of map_to_sphere")
    texture = read_image(image) if image is not None else pattern_by_name(pattern)
    shown = "The picture" if image is not None else pattern_by_name(pattern).title
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
    return page_with_view(
        scene,
        title=heading,
        version=report.get("versions", {}).get("omtwarp", ""),
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
    return verdict(bool(certificate.get("bijective")), stages[-1].distortion.flips if flips is None else int(flips))


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
    # texels around the sphere of the texture of still pictures: three for each pixel of the surface
    picture_width = 1536
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
        # Most edges, faces: with more, edges would hide the surface between them
        edges = len(result.faces) <= 60_000
        begin(f"sphere {stage.key}", replace(view_on_domain(result, stage, pose), scalar=field, edges=edges))
    picture: NDArray[np.generic]
    if isinstance(texture, Pattern):
        # Picture samples, along the side of a texel: pictures average over several texels besides
        picture = rasterize(texture, picture_width, supersample=2, device=device)
    else:
        picture = texture
    for stage in shown:
        begin(stage.key, replace(pose, image=picture, sphere=stage.sphere))
    return _Stills(begun)
