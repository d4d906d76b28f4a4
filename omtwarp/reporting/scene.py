"""The interactive view: vertices small enough for a page, the texture as a cube map, and its elements.

Everything is quantised without visible loss: positions, normals and directions to 16 bits (a 30,000th of the
surface's size, or 0.002 degrees), scalars to 8 bits of the range that the legend shows.
"""

import base64
import json
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from urllib.parse import quote

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from omtwarp.colors import colormap_table
from omtwarp.device.policy import resolve_device
from omtwarp.geometry.axes import fitted_rotation
from omtwarp.maps.result import MapResult
from omtwarp.mesh.arrays import Bytes, Floats, Ints, norms
from omtwarp.mesh.surface import SPHERE_AREA, Surface, sums_around, triangle_areas, vertex_normals
from omtwarp.render.camera import VIEWS, Camera, camera_axes
from omtwarp.render.films import fits_of
from omtwarp.render.scene import SurfaceView
from omtwarp.render.subject import posed
from omtwarp.reporting.markup import Markup, asset, data_block, data_uri, fill_page, html, join, script, source_hash
from omtwarp.reporting.stages import TORUS, Stage
from omtwarp.start.decimation import simplify
from omtwarp.texturing.adaptive import bake_bytes
from omtwarp.texturing.atlas import Cube
from omtwarp.texturing.baking import Look, Source

# Of log2(area on the sphere / area on the surface), both ways, and of log2(larger / smaller singular value), from 0;
# what lies outside has the colour at the end.
RANGE = 3.0
AREA_COLOURS, ANGLE_COLOURS = "coolwarm", "magma_r"
ANGLE_PART = 0.78  # the remainder of that colour map is too dark to show the surface's form
# Above this many faces the view, and only the view, shows a simplified mesh: a page has to stay light.
MOST_FACES = 150_000
FACE_TEXELS = 512  # of the texture along each face of the cube
# Degrees around the surface and above the horizon from which the view starts.
AZIMUTH, ELEVATION = VIEWS["three-quarter"]

# The faces of a cube texture as OpenGL has them, +x -x +y -y +z -z seen from inside (OpenGL 4.6, table 8.19): which of
# the atlas's each is, and by how many quarters it is turned to the left.
_GL_FACES = ((0, 1), (2, 3), (1, 2), (3, 0), (4, 1), (5, 1))


@dataclass(frozen=True)
class Scene:
    """The view's data as the page embeds it.

    Attributes:
        header: JSON text: where each array lies, ranges, stages, the texture's faces.
        data: the arrays, deflated, in base64.
        faces: how many triangles are shown.
    """

    header: str
    data: str
    faces: int


def make_scene(
    result: MapResult,
    stages: list[Stage],
    texture: Source,
    *,
    pose: SurfaceView | None = None,
    most_faces: int = MOST_FACES,
    texels: int = FACE_TEXELS,
    device: str = "auto",
) -> Scene:
    """Collect what the interactive view needs.

    Args:
        result: a finished map.
        stages: as :func:`~omtwarp.reporting.stages.stages_of` gives them.
        texture: a picture, or the name of a pattern.
        pose: the surface's axes, as of :func:`omtwarp.render.subject.posed`; guessed from its shape by default.
        most_faces: a surface of more triangles is simplified.
        texels: of the texture along each of its six faces.
        device: where the texture is baked.
    """
    vertices, faces = shown_mesh(result.vertices, result.faces, most_faces)
    used, corners = np.unique(faces, return_inverse=True)
    triangles = corners.reshape(-1, 3).astype(np.int32)
    axes = view_axes(pose or posed(SurfaceView(result.vertices, result.faces)))
    placed = placed_in_view(vertices, used, axes)
    normals = vertex_normals(vertices, np.asarray(result.faces))[used] @ axes.T
    several = any(stage.count > 1 for stage in stages)
    shown = stages if several else []
    places = {stage.key: domain_places(stage, result.faces, placed, triangles, used) for stage in shown}

    # A sphere of the surface's own area, unless folds make that too large for the view.
    covered = SPHERE_AREA * (0.5 if stages[-1].domain in ("hemisphere", "disk") else 1.0)  # of caps nearly all
    # Largest sphere, radius beside the surface's of 1: folds make a surface's area large
    radius = min(float(np.sqrt(triangle_areas(placed, triangles).sum() / covered)), 0.8)
    turn = alignment(stages[-1].sphere[used], placed)
    if several:
        turn = alignment(stages[-1].sphere[used], placed - places[stages[-1].key][:, :3])
        radius = max(float((np.linalg.norm(place[:, :3], axis=1) + place[:, 3]).max()) for place in places.values())
    header = {"radius": radius, "picture": cube_faces(texture, texels, device=device)}
    own = {f"place-{key}": place for key, place in places.items()}
    return packed_scene(stages, result.faces, used, (placed, normals, triangles), own, header, turn)


def view_axes(pose: SurfaceView) -> Floats:
    """Return as rows the axes of a surface that point right, up and towards the viewer, shape [3, 3]."""
    return camera_axes(Camera(azimuth=0.0, elevation=0.0), pose.up or "y", pose.front).T


def placed_in_view(vertices: Floats, used: NDArray[np.integer], axes: Floats) -> Floats:
    """Return vertices where the view has them: about the middle of the surface, the farthest at 1, shape [N, 3]."""
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    centred = (vertices - 0.5 * (low + high)) / max(float((high - low).max()), np.finfo(float).tiny)
    placed = centred[used] @ axes.T
    placed /= norms(placed).max()
    return placed


def packed_scene(
    stages: Sequence[Stage],
    faces: Ints,
    used: NDArray[np.integer],
    shown: tuple[Floats, Floats, Ints],
    own: Mapping[str, NDArray],
    header: Mapping[str, object],
    turn: Floats,
) -> Scene:
    """Pack the arrays of a view, and complete its header by what all views have.

    Args:
        stages: of the map.
        faces: of the map.
        used: the map's vertices that the view has, shape [N].
        shown: their places, their normals, shape [N, 3] each, and the triangles of the view.
        own: more arrays that this view has, by name.
        header: ``radius`` and ``picture``, and what else this view has.
        turn: the rotation of the domain, shape [3, 3].
    """
    placed, normals, triangles = shown
    index = triangles.astype(np.uint32).ravel()
    arrays: dict[str, NDArray] = {"position": signed(placed), "normal": signed(normals), "index": index, **own}
    for stage in stages:
        arrays[f"direction-{stage.key}"] = signed(stage.sphere[used])
        around = np.maximum(np.bincount(faces.ravel(), minlength=len(stage.sphere)), 1)
        for name, values, low in (("area", log2_area_ratio(stage), -RANGE), ("angle", log2_angle_ratio(stage), 0.0)):
            mean = sums_around(values, faces, len(stage.sphere)) / around
            arrays[f"{name}-{stage.key}"] = levels(mean[used], low, RANGE)
    blob, places = bytearray(), {}
    for name, array in arrays.items():
        blob += bytes(-len(blob) % 4)
        places[name] = [len(blob), array.size]
        blob += array.astype(array.dtype.newbyteorder("<")).tobytes()
    whole = {
        "arrays": places,
        "azimuth": AZIMUTH,
        "elevation": ELEVATION,
        # Column by column, as WebGL takes it.
        "turn": turn.T.ravel().round(6).tolist(),
        "area": {"range": RANGE, "colours": colour_ramp(AREA_COLOURS)},
        "angle": {"range": RANGE, "colours": colour_ramp(ANGLE_COLOURS, ANGLE_PART)},
        "stages": [{"key": stage.key, "label": stage.label, "flat": stage.disk is not None} for stage in stages],
        **header,
    }
    # Packing, level of zlib: on the bunny 1 % more bytes than at 9, in a fifth of the time
    packed = base64.b64encode(zlib.compress(bytes(blob), 3)).decode()
    return Scene(json.dumps(whole, separators=(",", ":")), packed, len(triangles))


def domain_places(
    stage: Stage, faces: Ints, placed: Floats, triangles: Ints, used: NDArray[np.integer]
) -> NDArray[np.float32]:
    """Return centre and radius of the domain that every vertex of the view goes to, next to its part, shape [N, 4].

    Args:
        stage: a map of parts.
        faces: of the map.
        placed: the vertices of the view, shape [N, 3].
        triangles: of the view, which joins no two parts.
        used: the map's vertices that the view has, shape [N].
    """
    own = np.zeros(len(stage.sphere), dtype=np.intp)
    own[faces] = stage.number[:, None]
    own = own[used]
    seen, kind = camera_axes(Camera(azimuth=AZIMUTH, elevation=ELEVATION)), stage.domain.rstrip("s")
    matrices, shifts = fits_of(placed, stage.sphere[used], triangles, own[triangles[:, 0]], kind, seen)
    return np.column_stack([shifts, norms(matrices[:, 0])])[own].astype(np.float32)


def shown_mesh(vertices: Floats, faces: Ints, most: int = MOST_FACES) -> tuple[Floats, Ints]:
    """Return the mesh to show: itself, or simplified to some of its vertices, which keep their numbers."""
    if len(faces) <= most:
        return vertices, faces
    for level in simplify(Surface(vertices, faces), resolve_device("cpu")).levels:
        if len(level.face_masses) <= most:
            tails = np.repeat(level.vertices, np.diff(level.offsets))
            # Every face is there once for each of its corners.
            once = (tails < level.heads) & (tails < level.thirds)
            return vertices, np.stack([tails, level.heads, level.thirds], axis=1)[once].astype(np.int32)
    return vertices, faces  # pragma: no cover (the last level is a tetrahedron)


def log2_area_ratio(stage: Stage) -> Floats:
    """Return log2 of the area on the sphere over the area on the surface, shape [F].

    It is bounded where a triangle has no area.
    """
    with np.errstate(all="ignore"):
        ratio = np.log2(stage.distortion.area_ratio)
    return np.clip(np.nan_to_num(ratio, nan=-60.0, posinf=60.0, neginf=-60.0), -60.0, 60.0)


def log2_angle_ratio(stage: Stage) -> Floats:
    """Return log2 of the larger over the smaller singular value, shape [F]: from their sum of ratios, s + 1 / s."""
    # Unbounded, in place of an infinite angle distortion, 2^60: the colours end at 2^3
    half = np.maximum(np.nan_to_num(stage.distortion.face_angle, nan=2.0, posinf=1e18), 2.0) / 2.0
    return np.minimum(np.arccosh(half) / np.log(2.0), 60.0)


def alignment(directions: Floats, placed: Floats) -> Floats:
    """Return the rotation [3, 3] that best aligns points of the sphere with the surface (Kabsch 1976)."""
    # Least radius, of a vertex at the centre, which no direction leads to
    return fitted_rotation(directions.T @ (placed / np.maximum(norms(placed)[..., None], 1e-12)))[0]


def cube_faces(texture: Source, size: int = FACE_TEXELS, *, device: str = "auto") -> list[str]:
    """Convert a texture to the six equiangular faces of an OpenGL cube map, as data URIs.

    Args:
        texture: equirectangular picture (path, PIL image, array), or the name of a pattern.
        size: texels along a face.
        device: where it is baked.
    """
    baked = bake_bytes(texture, Look(Cube(size, gutter=0), resolve_device(device)))[..., :3]
    kind = picture_kind(baked)
    uris = []
    for number, quarters in _GL_FACES:  # both have equiangular faces
        row, column = divmod(number, 3)
        cell = baked[row * size : (row + 1) * size, column * size : (column + 1) * size]
        uris.append(data_uri(Image.fromarray(np.ascontiguousarray(np.rot90(cell, quarters))), kind))
    return uris


def picture_kind(picture: Bytes) -> str:
    """Return how a picture [H, W, 3] is written: ``jpeg`` for a photograph, ``png`` for a pattern."""
    # Colours in a sixteenth of the texels: a pattern of flat colours and its blended borders has fewer, and a
    # photograph more.
    red, green, blue = np.moveaxis(picture[::4, ::4].astype(np.int32), -1, 0)
    return "jpeg" if len(np.unique(red << 16 | green << 8 | blue)) > 4096 else "png"


def colour_ramp(name: str, part: float = 1.0, count: int = 64) -> str:
    """Write the first part of a colour map as hexadecimal text, two digits per channel."""
    return colormap_table(name, round(count / part))[:count].tobytes().hex()


def signed(values: Floats) -> NDArray[np.int16]:
    """Write numbers from -1 to 1 as whole numbers of 16 bits."""
    # Int16: the largest of a coordinate that is written as int16
    return np.rint(np.clip(values, -1.0, 1.0) * 32767.0).astype(np.int16)


def levels(values: Floats, low: float, high: float) -> Bytes:
    """Write numbers between two bounds as whole numbers of 8 bits; those beyond are at the bounds."""
    return np.rint(np.clip((values - low) / (high - low), 0.0, 1.0) * 255.0).astype(np.uint8)


def page_with_view(template: str, scene: Scene, **values: object) -> str:
    """Put a page together: one HTML file that needs nothing else.

    Args:
        template: file of the package with a place for every value.
        scene: what the view draws.
        values: by the names of their places; see :func:`viewer_section` and :func:`verdict`.
    """
    three, viewer = script("three/three.min.js"), script("viewer.js")
    page = fill_page(
        template,
        scripts=html("{} {}", source_hash(three), source_hash(viewer)),
        style=asset("page.css"),
        icon=f"data:image/svg+xml,{quote(str(asset('icon.svg')).strip())}",
        scene=data_block(scene.header),
        data=data_block(scene.data),
        three=three,
        viewer=viewer,
        **values,
    )
    return str(page)


def verdict(bijective: bool, flips: int) -> Markup:
    """Say whether a map is one to one, or how many triangles it flips."""
    if bijective:
        return html('<p class="verdict">{} Certified one to one: no flipped triangle, degree 1</p>', asset("tick.svg"))
    if flips:
        words = f"{flips:,} flipped triangle{'s' * (flips > 1)}: not one to one"
        return html('<p class="verdict bad">{} {}</p>', asset("warning.svg"), words)
    return html('<p class="verdict bad">{} Not certified</p>', asset("warning.svg"))


def viewer_section(stages: Sequence[Stage], poster: str, poster_alt: str, texture: str) -> Markup:
    """Make the elements of the interactive view, over a picture that is shown until the view draws.

    Args:
        stages: of the map, the last one shown first.
        poster: the picture, as a data URI.
        poster_alt: what the picture shows.
        texture: name of the texture among the colourings.
    """
    last, domain = stages[-1].key, stages[-1].domain
    colourings = [("picture", texture), ("graticule", "Lattice" if domain == TORUS else "Graticule")]
    colourings += [(name, name.capitalize()) for name in ("area", "angle", "plain")]
    choices = _segments("Map", "stage", [(stage.key, stage.label) for stage in stages], last)
    return fill_page(
        "viewer.html",
        poster=poster,
        poster_alt=poster_alt,
        choices=choices + _segments("Colour", "colouring", colourings, "picture"),
        domain=domain,
        image=domain.capitalize(),
        areas=_stops(colour_ramp(AREA_COLOURS, count=12)),
        angles=_stops(colour_ramp(ANGLE_COLOURS, ANGLE_PART, count=12)),
        most=f"{2.0**RANGE:.0f}",
        half=f"{2.0 ** (RANGE / 2):.1f}",
    )


def _stops(colours: str) -> str:
    """Return the colours of a ramp, as those of a gradient."""
    return ",".join(f"#{colours[k : k + 6]}" for k in range(0, len(colours), 6))


def _segments(legend: str, name: str, options: Sequence[tuple[str, str]], chosen: str) -> Markup:
    labels = join(
        fill_page("choice.html", name=name, key=key, checked=" checked" if key == chosen else "", label=label)
        for key, label in options
    )
    return html('<fieldset><legend>{}</legend><div class="segments">{}</div></fieldset>', legend, labels)
