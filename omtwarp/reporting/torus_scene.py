"""Data of the interactive view of a map to a torus: the surface, its ring torus, and the picture that repeats."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from omtwarp.maps.result import StageReport
from omtwarp.maps.torus_map import TorusMap
from omtwarp.maps.torus_pictures import ring_torus, tube_radius
from omtwarp.mesh.surface import triangle_areas
from omtwarp.render.scene import SurfaceView
from omtwarp.reporting.record import shown_report
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
from omtwarp.reporting.stages import TORUS, Stage
from omtwarp.texturing.image import PictureLike

Floats = NDArray[np.float64]

# Names of the record of the last stage, and its label and colour.
LAST = {
    "omt": ("Optimal transport", "--transport"),
    "exact": ("Exact areas", "--after"),
    "refine": ("Refined", "--after"),
}
PICTURE_WIDTH = 1024  # texels of a pattern along the first vector; a picture of more is made smaller
LINES = 12  # of the lattice along its shorter vector


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
    found = []
    for key, stage, places, (label, colour) in (
        ("conformal", "conformal", result.conformal, ("Conformal", "--before")),
        (name, "torus", result.coordinates, LAST[name]),
    ):
        points = ring_torus(places, result.lattice) / outside
        record: StageReport = records.get(key, {})
        found.append(Stage(key, label, colour, points, result.distortion(stage), record, weights, TORUS, number))
    return found


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
    cut = result.textured(image, pattern=None if image is not None else pattern)
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
        "ring": {"radius": ring, "lines": np.maximum(np.rint(LINES * along / along.min()), 1.0).tolist()},
        "picture": [_picture(cut.image)],
    }
    return packed_scene(arrays, header, alignment(stages[-1].sphere[used], placed), len(cut.faces))


def _picture(image: NDArray[np.uint8]) -> str:
    """Write a picture that repeats as a data URI, no wider than the view shows."""
    from PIL import Image as pil

    drawn = pil.fromarray(image).convert("RGB")
    kind = picture_kind(np.asarray(drawn))
    if drawn.width > PICTURE_WIDTH:
        drawn = drawn.resize(
            (PICTURE_WIDTH, max(round(drawn.height * PICTURE_WIDTH / drawn.width), 1)), pil.Resampling.BOX
        )
    return data_uri(drawn, kind)


__all__ = ["torus_scene", "torus_stages"]
