"""Texture coordinates for a mesh's own triangles, without a cut through any of them."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from omtwarp.errors import OmtwarpError
from omtwarp.materials.base import Floats, Material
from omtwarp.materials.painted import PaintedMesh
from omtwarp.mesh.arrays import TINY
from omtwarp.texturing.atlas import CUBE_FRAMES
from omtwarp.texturing.textured import SphereMap, as_map, require_one_picture

MARGIN = 1.0 / 128.0
"""Free space around a chart, in heights of the picture: 8 texels at 1024, enough for three levels of mip maps."""

FARTHEST = np.deg2rad(87.0)
"""From the middle of a chart: what lies 90 degrees away lies on no plane in front of it."""

ASPECTS, MOST_MARGIN = (0.1, 10.0), 0.1
"""Widths of the picture over its height, and free room in heights of it: beyond these charts have next to no room."""


def unwrap_uv(
    result: SphereMap | tuple[ArrayLike, ArrayLike, ArrayLike], *, aspect: float = 1.0, margin: float = MARGIN
) -> PaintedMesh:
    """Lay a surface out on a picture through its map, as texture coordinates for the triangles that it has.

    Every triangle belongs as a whole to the face of the cube in which its centroid lies, a long one to the face that
    contains it best: no vertex is added, and charts have jagged borders, a triangle wide. The six charts lie in three
    by two cells, at one scale, apart from each other, and no triangle overlaps another. Angles from the middle of a
    chart are linear on the picture, so that its texels are of nearly the same size all over the sphere, and on the
    surface where the map preserves areas.

    Args:
        result: a :class:`~omtwarp.MapResult`, anything with ``vertices``, ``faces`` and ``sphere``, or the three as a
            tuple; a map that is one to one.
        aspect: width of the picture over its height; 1.5 leaves no part of the cells unused, 1 is what game engines
            expect.
        margin: free space around each chart, in heights of the picture.

    Returns:
        The mesh with its coordinates and one plain material; ``.export("name.obj")`` writes it.

    Raises:
        OmtwarpError: triangles that reach too far around the sphere, flipped triangles, or a margin that leaves no
            space.

    Example:
        >>> import omtwarp
        >>> surface = omtwarp.shapes.blob(seed=3, sphere=320)
        >>> result = omtwarp.map_to_sphere(surface, until="conformal", device="cpu")
        >>> mesh = omtwarp.unwrap_uv(result)
        >>> mesh.uv.shape == (len(surface.faces), 3, 2), bool(0 < mesh.uv.min() and mesh.uv.max() < 1)
        (True, True)
    """
    require_one_picture(result)
    vertices, faces, sphere = as_map(result)
    if not ASPECTS[0] <= aspect <= ASPECTS[1] or not 0.0 <= margin <= MOST_MARGIN:
        raise OmtwarpError(f"aspect {aspect}, margin {margin}: give 0.1 to 10, and 0 to 0.1")
    corners = sphere[faces]
    middle = corners.sum(axis=1)
    chart = np.argmax(middle @ CUBE_FRAMES[:, 0].T, axis=1)
    angle = _angles(corners, chart)
    far = np.abs(angle).max(axis=(1, 2)) > FARTHEST
    if far.any():  # a long triangle may fit better on a neighbouring chart
        at = np.flatnonzero(far)
        reach = [np.abs(_angles(corners[at], np.full(len(at), k))).max(axis=(1, 2)) for k in range(len(CUBE_FRAMES))]
        chart[at] = np.argmin(reach, axis=0)
        angle[at] = _angles(corners[at], chart[at])
        far = np.abs(angle).max(axis=(1, 2)) > FARTHEST
    if far.any():
        raise OmtwarpError(
            f"{far.sum()} of {len(faces)} faces reach more than {np.rad2deg(FARTHEST):.0f} degrees from the middle of "
            f"their chart, first face {int(np.argmax(far))}: quarter the mesh first, or use texture, which cuts faces"
        )
    plane = angle if (_signed_areas(angle) > 0).all() else np.tan(angle)
    # In gnomonic coordinates great circles are straight lines, so that no triangle flips that was not flipped.
    turned = _signed_areas(plane) <= 0
    if turned.any():
        raise OmtwarpError(
            f"{turned.sum()} of {len(faces)} faces are flipped or without area on the sphere, first face "
            f"{int(np.argmax(turned))}: remake the map"
        )
    return PaintedMesh(vertices, faces, _placed(plane, chart, aspect, margin), (Material("surface"),))


def _angles(corners: Floats, chart: NDArray[np.intp]) -> Floats:
    """Return the angles of corners from the middles of charts, to the right and upwards, shape [F, 3, 2]."""
    local = np.einsum("fkj,fij->fki", corners, CUBE_FRAMES[chart])
    return np.arctan2(local[..., 1:], local[..., :1])


def _signed_areas(plane: Floats) -> Floats:
    one, other = plane[:, 1] - plane[:, 0], plane[:, 2] - plane[:, 0]
    return one[:, 0] * other[:, 1] - one[:, 1] * other[:, 0]


def _placed(plane: Floats, chart: NDArray[np.intp], aspect: float, margin: float) -> Floats:
    """Return corners' coordinates on the picture: each chart lies in the middle of its cell, all at one scale."""
    low, high = np.zeros((6, 2)), np.zeros((6, 2))
    for k in np.unique(chart):
        points = plane[chart == k].reshape(-1, 2)
        low[k], high[k] = points.min(axis=0), points.max(axis=0)
    cell = np.array([aspect / 3.0, 0.5])
    inner = cell - 2.0 * margin
    if (inner <= 0).any():
        raise OmtwarpError(f"a margin of {margin} leaves no room for charts")
    scale = float((inner / np.maximum((high - low).max(axis=0), TINY)).min())
    corner = np.stack([chart % 3, 1 - chart // 3], axis=1)
    centre = (corner + 0.5) * cell
    moved = (plane - (0.5 * (low + high))[chart][:, None, :]) * scale + centre[:, None, :]
    return moved / (aspect, 1.0)


__all__ = ["unwrap_uv"]
