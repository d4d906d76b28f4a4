"""Maps of surfaces that were numbered in space, put back into the order of the input.

Before it is mapped, each part of a surface is numbered by the places of its vertices
(:func:`omtwarp.topology.kind.numbered_in_space`), so that its map is the same bits however the input is numbered. Here
the input's vertices and faces get their order back. What cutting, splitting and quartering add follows, in an order
that depends on places alone.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from omtwarp.geometry.space_order import CORNERS
from omtwarp.maps.result import MapResult
from omtwarp.maps.torus_map import TorusMap
from omtwarp.mesh.origins import Origins
from omtwarp.mesh.quarter import PARTS
from omtwarp.topology.kind import Part

Places = NDArray[np.int64]


@dataclass(frozen=True)
class _Order:
    """The order of the vertices, faces and corners of a map, by their present numbers.

    Attributes:
        vertices: shape [V].
        faces: shape [F].
        corners: of every face in its new place, the present number of each of its corners, shape [F, 3].
    """

    vertices: Places
    faces: Places
    corners: Places

    @property
    def place(self) -> Places:
        """The number that every vertex gets, shape [V]."""
        return np.argsort(self.vertices)

    def of_corners(self, values: NDArray) -> NDArray:
        """Put rows for the corners of faces in order, shape [F, 3] or [F, 3, ...]."""
        return values[self.faces[:, None], self.corners]


def in_input_order(result: MapResult, given: Part, *, exact: bool) -> MapResult:
    """Put the map of a part that was numbered in space into the order of the input.

    Args:
        result: the map; its origins are numbers in the input.
        given: the part as it was before.
        exact: whether triangles were quartered.
    """
    assert result.vertex_origin is not None and result.face_origin is not None
    order = _order(result.faces, result.vertex_origin, result.face_origin, given, exact)
    place, count, own = order.place, len(result.vertices), len(result.faces)
    arrays = result.rows({"V": order.vertices, "F": order.faces})
    arrays["faces"] = place[order.of_corners(result.faces)].astype(np.int32)
    if result.split_edges is not None:
        arrays["split_edges"] = np.sort(place[result.split_edges], axis=1)
    if result.loops is not None:
        arrays["loops"] = place[result.loops]
    for name in ("filled_vertices", "filled_sphere", "filled_conformal"):
        values = getattr(result, name)
        if values is not None:
            arrays[name] = np.concatenate([values[order.vertices], values[count:]])
    if result.filled_faces is not None and result.filled_vertices is not None:
        whole = np.concatenate([place, np.arange(count, len(result.filled_vertices))])
        arrays["filled_faces"] = np.concatenate([arrays["faces"], whole[result.filled_faces[own:]]])
    return result.with_arrays(arrays)


def torus_in_input_order(result: TorusMap, ordered: Part, given: Part) -> TorusMap:
    """Put the map to a torus of a part that was numbered in space into the order of the input.

    Args:
        result: the map; its origins, where it has any, are numbers in the part that was mapped.
        ordered: that part, numbered in space.
        given: the same part as it was before.
    """
    exact, own = result.origins is not None, Origins(np.arange(len(result.vertices)), np.arange(len(result.faces)))
    origins = ordered.compose(result.origins or own)
    of_vertices, of_faces = origins.vertex_origin, origins.face_origin
    order = _order(result.faces, of_vertices, of_faces, given, exact)
    arrays = result.rows({"V": order.vertices, "F": order.faces})
    arrays["faces"] = order.place[order.of_corners(result.faces)].astype(np.int32)
    arrays["wraps"] = order.of_corners(result.wraps)
    if exact:
        arrays |= {"vertex_origin": of_vertices[order.vertices], "face_origin": of_faces[order.faces]}
    return result.with_arrays(arrays)


def _order(faces: NDArray, of_vertices: Places, of_faces: Places, given: Part, exact: bool) -> _Order:
    """Return the order of a map's vertices and faces in which those of the input lie as they do there.

    Args:
        faces: of the map, shape [F, 3], those of one face of the input after each other.
        of_vertices: the input's vertex that each vertex is or is a copy of, -1 for new ones, shape [V].
        of_faces: the input's face that each face is a part of, shape [F].
        given: the part in the order of the input.
        exact: whether triangles were quartered, see :class:`omtwarp.mesh.quarter.QuarteredSurface`.
    """
    known = np.flatnonzero(of_vertices >= 0)
    first = known[np.unique(of_vertices[known], return_index=True)[1]]
    added = np.ones(len(of_vertices), dtype=bool)
    added[first] = False
    parts = PARTS if exact else 1
    groups = of_faces.reshape(-1, parts)[:, 0]
    along = np.argsort(groups, kind="stable")
    # The corner of the input's face at which a triangle begins; 0 for pieces of split ones that begin at a new vertex.
    corners = given.vertex_origin[given.faces[np.searchsorted(given.face_origin, groups[along])]]
    begins = of_vertices[faces.reshape(-1, parts, CORNERS)[along, 0, 0]]
    back = (np.arange(CORNERS) - (corners == begins[:, None]).argmax(axis=1)[:, None]) % CORNERS
    if not exact:
        return _Order(np.concatenate([first, np.flatnonzero(added)]), along, back)
    # A part at a corner goes to another corner's place as it is; the middle one is turned.
    middle = np.full((len(along), 1), PARTS - 1)
    rows = (PARTS * along)[:, None] + np.concatenate([back, middle], axis=1)
    turned = np.broadcast_to(np.arange(CORNERS), (len(along), PARTS, CORNERS)).copy()
    turned[:, PARTS - 1] = back
    return _Order(np.concatenate([first, np.flatnonzero(added)]), rows.ravel(), turned.reshape(-1, CORNERS))
