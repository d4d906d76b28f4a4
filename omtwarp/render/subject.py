"""What is drawn, and how it stands: a file, a trimesh mesh or a finished map as a :class:`SurfaceView` with its axes.

Files have y or z upwards. That along which the shape is its own mirror image is across it or ahead, not upwards; else
y is, unless the shape stands firmly along z and not along y. The axis across is that of the best mirror plane. The
front has more detail than the back, feet reach forward, and of a body much longer than wide the head is at the end that
rises higher. What lies long is seen from the side. Where the shape does not determine a front, the default axes are
kept: z towards the viewer where y is upwards, -y where z is.
"""

from __future__ import annotations

import os
import warnings
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from omtwarp.colors import to_srgb
from omtwarp.errors import OmtwarpError, OmtwarpWarning
from omtwarp.maps.domains import is_torus_map
from omtwarp.mesh.arrays import Bytes, FinishedMap, Floats, HasTriangles, Ints, cross, norms
from omtwarp.render.camera import axis_vector
from omtwarp.render.scene import SurfaceMaterial, SurfaceView
from omtwarp.texturing.export import WHITE
from omtwarp.texturing.image import PictureLike

if TYPE_CHECKING:
    import trimesh

    from omtwarp.maps.result import MapResult
    from omtwarp.texturing.painted import PaintedMesh


Picture: TypeAlias = PictureLike
Subject: TypeAlias = "str | os.PathLike[str] | HasTriangles | SurfaceView | tuple[ArrayLike, ArrayLike]"


def as_surface_view(subject: Subject, image: Picture | None = None) -> SurfaceView:
    """Make a view of a file, a ``trimesh.Trimesh``, a ``MapResult``, ``PaintedMesh``, (vertices, faces) or a view.

    Args:
        subject: what to look at. Textures, texture coordinates and colours of files and trimesh meshes are kept.
        image: equirectangular picture (file, PIL image or array) for a subject that has points on the sphere.

    Raises:
        OmtwarpError: the subject cannot be read or is nothing that can be drawn.
    """
    if isinstance(subject, (str, os.PathLike)):
        path = Path(subject)
        if path.suffix.lower() == ".npz":
            from omtwarp.maps.result import MapResult

            subject = MapResult.load(path)
        else:
            from omtwarp.texturing.read import read_painted_mesh

            subject = read_painted_mesh(path)
            for note in subject.notes:
                if "is not there" in note or note.startswith("left out"):
                    warnings.warn(f"{path}: {note}", OmtwarpWarning, stacklevel=2)
    if isinstance(subject, SurfaceView):
        view = subject
    elif is_torus_map(subject):
        return torus_view(subject, image)
    elif isinstance(subject, FinishedMap):
        return map_view(subject, image)
    elif hasattr(subject, "visual") and hasattr(subject, "faces"):
        view = _from_trimesh(cast("trimesh.Trimesh", subject))
    elif hasattr(subject, "face_material"):
        view = painted_view(cast("PaintedMesh", subject))
    elif isinstance(subject, (tuple, list)) and len(subject) == 2:
        view = SurfaceView(*subject)
    elif isinstance(subject, HasTriangles):
        view = SurfaceView(subject.vertices, subject.faces)
    else:
        raise OmtwarpError(
            f"cannot draw a {type(subject).__name__}: "
            "give a mesh file, a trimesh mesh, a map, (vertices, faces) or a SurfaceView"
        )
    if image is not None:
        if view.sphere is None:
            raise OmtwarpError(
                "an image was given, but this subject has no points on the sphere to look it up: give a map"
            )
        view = replace(view, image=image, uv=None, colors=None, scalar=None)
    return view


def map_view(
    result: FinishedMap, image: Picture | None = None, *, which: str = "optimal", on: str = "surface", caption: str = ""
) -> SurfaceView:
    """Return a view of a finished map: the surface or its sphere, with an image carried over by the map.


    Args:
        result: has ``vertices``, ``faces``, ``sphere`` and ``conformal``.
        image: equirectangular picture; None draws a checker of 24 by 12 cells, tinted by longitude.
        which: ``"optimal"`` (the final map) or ``"conformal"``.
        on: ``"surface"`` or ``"sphere"``.
        caption: text for a sheet.

    Raises:
        OmtwarpError: a choice is unknown, or the map has no such stage.
    """
    if which not in ("optimal", "conformal") or on not in ("surface", "sphere"):
        raise OmtwarpError(f"unknown view ('{which}', '{on}'): use optimal or conformal, and surface or sphere")
    # Both are read, so that a map to a torus, which has a conformal map too, says that it has no sphere.
    sphere = {"optimal": result.sphere, "conformal": result.conformal}[which]
    if sphere is None:
        raise OmtwarpError(f"this map has no {which} stage to show")
    picture = checker_image() if image is None else image
    if on == "sphere":
        return SurfaceView(sphere, result.faces, image=picture, sphere=sphere, up="z", front="+x", caption=caption)
    return SurfaceView(result.vertices, result.faces, image=picture, sphere=sphere, caption=caption)


def torus_view(
    result: MapResult,
    image: Picture | None = None,
    *,
    which: str = "optimal",
    on: str = "surface",
    pattern: str = "circles",
) -> SurfaceView:
    """Return a view of a map to a torus: the surface, or the ring torus, with a picture that repeats both ways.

    Args:
        result: the map.
        image: the picture; a pattern where there is none.
        which: ``"optimal"`` (the final map) or ``"conformal"``.
        on: ``"surface"`` or ``"torus"``, the ring torus.
        pattern: ``circles`` or ``checker``.

    Raises:
        OmtwarpError: a choice is unknown.
    """
    if which not in ("optimal", "conformal") or on not in ("surface", "torus"):
        raise OmtwarpError(f"unknown view ('{which}', '{on}'): use optimal or conformal, and surface or torus")
    shown = result if which == "optimal" else result.with_arrays({"coordinates": result.conformal})
    from omtwarp.texturing.textured import texture_torus

    cut = texture_torus(shown, image, None if image is not None else pattern)
    places = cut.vertices if on == "surface" else shown.ring()
    return SurfaceView(places, cut.faces, image=cut.image, uv=cut.uv, up=None if on == "surface" else "z")


def checker_image() -> Bytes:
    """Return an equirectangular checker whose dark cells go around the colour wheel with longitude, uint8 [H, W, 3]."""
    columns, rows, cell = 24, 12, 64  # fields around the equator and from pole to pole, and texels along each
    column, row = (np.arange(count * cell) // cell for count in (columns, rows))
    turn = 2.0 * np.pi * column / columns
    dark = np.stack([0.33 + 0.22 * np.cos(turn + shift) for shift in (0.4, -1.9, 2.6)], axis=-1)
    light = np.array([0.96, 0.94, 0.90])
    chosen = ((row[:, None] + column[None, :]) % 2)[..., None]
    return np.rint(255.0 * np.where(chosen == 1, light, dark[None])).astype(np.uint8)


def painted_view(mesh: PaintedMesh) -> SurfaceView:
    """Return a view of a mesh with materials; of colours at the vertices alone where no material has an appearance."""
    if all(material.picture is None and material.color == WHITE for material in mesh.materials):
        return SurfaceView(mesh.vertices, mesh.faces, colors=mesh.vertex_colors)
    materials = []
    for number, material in enumerate(mesh.materials):
        image, uv = material.picture, mesh.uv
        known = uv is not None and np.isfinite(uv[mesh.material_of == number]).all()
        color = None if material.color[:3] == WHITE[:3] else material.color[:3]
        colors = mesh.vertex_colors if image is None and color is None else None
        materials.append(SurfaceMaterial(image if known else None, color, colors))
    uv = None if mesh.uv is None else np.nan_to_num(mesh.uv)
    uv = uv if any(material.image is not None for material in materials) else None
    return SurfaceView(mesh.vertices, mesh.faces, uv=uv, materials=materials, face_material=mesh.material_of)


def _from_trimesh(mesh: trimesh.Trimesh) -> SurfaceView:
    from trimesh.visual import ColorVisuals, TextureVisuals  # heavy, and loaded by whoever has a mesh of trimesh's

    vertices, faces, visual = np.asarray(mesh.vertices), np.asarray(mesh.faces), mesh.visual
    kind = getattr(visual, "kind", None)
    if kind == "texture" and isinstance(visual, TextureVisuals):
        material, uv = visual.material, visual.uv
        picture = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
        factor = getattr(material, "baseColorFactor", None)
        # A factor of glTF is linear; white changes nothing.
        color = None if factor is None or (factor[:3] == 255).all() else to_srgb(factor[:3] / 255.0)
        if picture is not None and uv is not None and len(uv) == len(vertices):
            return SurfaceView(vertices, faces, image=picture, uv=np.asarray(uv)[:, :2], color=color)
        return SurfaceView(vertices, faces, color=color)
    if kind in ("vertex", "face") and isinstance(visual, ColorVisuals):
        return SurfaceView(vertices, faces, colors=np.asarray(getattr(visual, f"{kind}_colors")))
    return SurfaceView(vertices, faces)


def posed(view: SurfaceView, up: str | None = None, front: str | None = None) -> SurfaceView:
    """Complete a view by the axes that point up and to the viewer, as given or guessed from the shape.

    Args:
        view: a surface; axes that it has itself are taken before guesses.
        up: the axis upwards, such as ``"z"`` or ``"-y"``.
        front: the axis towards the viewer.

    Raises:
        OmtwarpError: one of these is no axis.
    """
    for axis in (up, front):
        axis_vector("z" if axis is None else axis)
    if front is None and (up is None or up == view.up):
        front = view.front  # otherwise the subject's own may lie along the new upward axis
    up = view.up if up is None else up
    if up is None or (front is None and view.up is None):
        vertices, faces = np.asarray(view.vertices), np.asarray(view.faces)
        guessed_up, guessed_front = upright(vertices, faces)
        if up is None:
            away = front is None or abs(axis_vector(guessed_up) @ axis_vector(front)) < 0.5
            up = guessed_up if away else next(axis for axis in "yz" if axis not in str(front))
        if front is None and up.lstrip("+") == guessed_up:
            front = guessed_front
    return replace(view, up=up, front=front)


def upright(vertices: Floats, faces: Ints) -> tuple[str, str | None]:
    """Guess the axis upwards, and the front axis, None where the shape does not determine it.

    Args:
        vertices: shape [V, 3], finite.
        faces: shape [F, 3].

    Example:
        >>> from omtwarp.mesh import shapes
        >>> from omtwarp.render.subject import upright
        >>> creature = shapes.demo_shape(4000)
        >>> upright(creature.vertices, creature.faces)
        ('z', 'x')
    """
    long_side = 2.0  # length over height and width from which a body is seen from the side
    # weights of how far they are ahead, in lengths, beside the logarithm of the ratio of details
    head, feet = 0.8, 0.5
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    extent = max(float((high - low).max()), np.finfo(float).tiny)
    places = (vertices - low) / extent
    corner = places[faces]
    normal = cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    area = norms(normal)
    # Flat, of the extent: a flat sheet, which has no front of its own, is seen from +z
    if not area.sum() > 0.0 or (high - low).min() < 0.01 * extent:
        return "y", None
    normal /= np.maximum(area, np.finfo(float).tiny)[:, None]
    middle = corner.mean(axis=1)
    centre = area @ middle / area.sum()
    off = _asymmetry(corner, area, centre)
    used = places[np.unique(faces)]
    spread = np.ptp(used, axis=0)
    up = _upward(used, centre, off)
    one, other = (axis for axis in range(3) if axis != up)
    across = _more_symmetric(off, one, other)
    ahead = 3 - up if across is None else 3 - up - across  # by default z or y
    if spread[ahead] > long_side * np.delete(spread, ahead).max():
        return "xyz"[up], "xyz"[3 - up - ahead]
    if across is None:
        return "xyz"[up], None
    score = float(np.log(_detail(places, faces, normal, area, ahead)))
    height = (middle[:, up] - used[:, up].min()) / spread[up]

    def reach(part: NDArray[np.bool_]) -> float:
        share = area[part].sum()
        return float(area[part] @ middle[part, ahead] / share - centre[ahead]) / spread[ahead] if share > 0.0 else 0.0

    score += feet * reach(height < 0.1)
    # Long: length over width of bodies with a head at one end
    if spread[ahead] > 1.5 * spread[across]:
        score += head * reach(height > 0.7)
    return "xyz"[up], ("" if score >= 0.0 else "-") + "xyz"[ahead]


def _upward(points: Floats, centre: Floats, off: Floats) -> int:
    """Return the upward axis, y or z: that without symmetry, else the one along which the surface stands."""
    firm, firmer = 0.15, 2.5  # least share of the footprint between the feet along z, and over that along y
    level = _more_symmetric(off, 1, 2)
    if level is not None:
        return 3 - level
    along_y, along_z = (_standing(points, centre, axis) for axis in (1, 2))
    return 2 if along_z > max(firm, firmer * along_y) else 1


def _more_symmetric(off: Floats, one: int, other: int) -> int | None:
    """Return which of two axes the surface is symmetric along, where it is clearly less along the other."""
    sampled = 1e-3  # least distance, as a share of the extent, that is no error of the samples: a ball's is 6e-5
    better, worse = (one, other) if off[one] < off[other] else (other, one)
    # Mean distance between a surface and its mirror image, as a share of its extent, where it counts as symmetric, and
    # that of the best plane over the next one's. Of ten heads, figures and animals, scanned or modelled, eight have 0
    # to 0.011.
    return better if off[better] < min(0.015, 0.55 * (off[worse] - sampled)) else None


def _asymmetry(corner: Floats, area: Floats, centre: Floats) -> Floats:
    """Return the mean distance between a surface and its mirror image along every axis, in its extent, shape [3].

    What points of the surface itself are apart from those that stand for it is taken off.
    """
    from scipy.spatial import cKDTree

    rng, sums = np.random.default_rng(0), np.cumsum(area)

    def sampled(count: int) -> Floats:
        at = np.searchsorted(sums, (np.arange(count) + 0.5) / count * sums[-1])  # evenly, in the order of faces
        share = rng.dirichlet((1.0, 1.0, 1.0), count)
        return np.einsum("nk,nkj->nj", share, corner[np.minimum(at, len(corner) - 1)])

    count = 3000  # points by which symmetry is measured; 13 times as many stand for the surface
    # Twice as fast as the default for points far from the surface, as most mirrored ones are
    tree = cKDTree(sampled(13 * count), leafsize=48, compact_nodes=False, balanced_tree=False)
    points = sampled(count)
    mirrored = np.where(np.eye(3, dtype=bool)[:, None], 2.0 * centre - points, points)
    return np.maximum(tree.query(mirrored)[0].mean(axis=1) - tree.query(points)[0].mean(), 0.0)


def _standing(points: Floats, centre: Floats, up: int) -> float:
    """Return the area between a surface's feet over that of its outline from above, 0 where it would fall over."""
    from scipy.spatial import ConvexHull, QhullError

    flat = np.delete(points, up, axis=1)
    try:
        # Ground, of the extent: points at most this far above the lowest one touch the ground
        feet = ConvexHull(flat[points[:, up] < points[:, up].min() + 0.03])
        whole = ConvexHull(flat)
    except (QhullError, ValueError):  # fewer than three feet, or all in line
        return 0.0
    falls = (feet.equations[:, :2] @ np.delete(centre, up) + feet.equations[:, 2]).max() >= 0.0
    return 0.0 if falls else float(feet.volume / whole.volume)


def _detail(places: Floats, faces: Ints, normal: Floats, area: Floats, axis: int) -> float:
    """Return how much more the surface bends, per area, where it faces along an axis than against it."""
    # added to both sides' bends and areas, in extents, so that a side without a face can be compared
    least_detail = 1e-9
    ends = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    keys = ends[:, 0].astype(np.int64) * len(places) + ends[:, 1]
    order = np.argsort(keys, kind="stable")
    pair = np.flatnonzero(keys[order][1:] == keys[order][:-1])
    one, other = order[pair] // 3, order[pair + 1] // 3
    ends = ends[order[pair]]
    angle = np.arccos(np.clip(np.einsum("ij,ij->i", normal[one], normal[other]), -1.0, 1.0))
    bend = angle * norms(places[ends[:, 0]] - places[ends[:, 1]])
    sides = []
    for sign in (1.0, -1.0):
        facing = sign * normal[:, axis] > 0.5
        edges = sign * (normal[one, axis] + normal[other, axis]) > 1.0
        sides.append((bend[edges].sum() + least_detail) / (area[facing].sum() + least_detail))
    return float(sides[0] / sides[1])
