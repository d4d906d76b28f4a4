"""The kind of surface that a mesh is: its parts, their holes and handles, and the options that would map it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from omtwarp.errors import OmtwarpError
from omtwarp.geometry.space_order import in_space_order, order_along_curve
from omtwarp.mesh.arrays import Floats, in_range, marked, norms
from omtwarp.mesh.origins import Derived, Origins
from omtwarp.mesh.surface import Surface
from omtwarp.mesh.validate import Topology, as_arrays, check, describe, number

MAPPABLE = ("open-boundary", "several-components", "genus")
"""Defects of :func:`omtwarp.mesh.validate.check` that only say that a surface is no sphere."""


def boundary_half_edges(faces: NDArray, vertex_count: int) -> NDArray[np.int64]:
    """Return the directed edges (tail, head) of faces that no other face runs through the other way, shape [B, 2].

    Args:
        faces: vertex indices of an oriented mesh, shape [F, 3].
        vertex_count: V.
    """
    tail = np.asarray(faces, dtype=np.int64).ravel()
    head = np.roll(np.asarray(faces, dtype=np.int64), -1, axis=1).ravel()
    alone = ~np.isin(tail * vertex_count + head, head * vertex_count + tail)
    return np.stack([tail[alone], head[alone]], axis=1)


def on_boundary(faces: NDArray, vertex_count: int) -> NDArray[np.bool_]:
    """Return a mask of the vertices on the boundary, shape [V]; arguments as of :func:`boundary_half_edges`."""
    return marked(vertex_count, boundary_half_edges(faces, vertex_count))


def boundary_loops(faces: NDArray, vertex_count: int) -> list[NDArray[np.int64]]:
    """Return the closed loops of boundary vertices, each in the direction in which the faces run through them.

    The loops are ordered by their smallest vertex, and each begins there, so that the same mesh gives the same loops.

    Args:
        faces: vertex indices of an oriented manifold mesh, shape [F, 3].
        vertex_count: V.

    Raises:
        OmtwarpError: two loops, or one loop twice, run through the same vertex.
    """
    half = boundary_half_edges(faces, vertex_count)
    tails, counts = np.unique(half[:, 0], return_counts=True)
    if (counts > 1).any():
        vertex = int(tails[np.argmax(counts > 1)])
        raise OmtwarpError(f"the boundary runs through vertex {vertex} more than once: split it in a mesh editor")
    following = dict(sorted(half.tolist()))
    loops = []
    while following:
        loop = [next(iter(following))]
        while loop[-1] in following:
            loop.append(following.pop(loop[-1]))
        loops.append(np.array(loop[:-1], dtype=np.int64))
    return loops


def loop_length(vertices: Floats, loop: NDArray[np.int64]) -> float:
    """Return the length of a closed loop of vertices, in the units of the input."""
    points = vertices[loop]
    return float(norms(np.roll(points, -1, axis=0) - points).sum())


@dataclass(frozen=True, eq=False)
class Part(Derived):
    """A connected piece of a surface with vertices numbered anew.

    Attributes:
        genus: number of handles, holes counted as filled.
    """

    genus: int

    @cached_property
    def loops(self) -> list[NDArray[np.int64]]:
        """The boundary loops, see :func:`omtwarp.topology.kind.boundary_loops`."""
        return boundary_loops(self.faces, len(self.vertices))

    @property
    def is_sphere(self) -> bool:
        """Whether it is closed and without handles."""
        return not self.loops and self.genus == 0

    @property
    def is_torus(self) -> bool:
        """Whether it is closed and has one handle."""
        return not self.loops and self.genus == 1

    @property
    def words(self) -> str:
        """What it is in words: ``genus 1, 2 holes``."""
        holes = number(len(self.loops), "hole") if self.loops else "closed"
        return f"genus {self.genus}, {holes}"

    def numbered_in_space(self) -> Part:
        """Return the part with vertices and faces numbered by their places, see :mod:`omtwarp.geometry.space_order`.

        What is computed from it is the same, to the bit, however the input is numbered. Its origins say where it is
        there.
        """
        ordered = in_space_order(Surface(self.vertices, self.faces))
        return self.remade(ordered.surface.vertices, ordered.surface.faces, ordered)

    def remade(self, vertices: Floats, faces: NDArray[np.integer], made: Origins) -> Part:
        """Return the part as another surface that was made from its own: numbered anew, or cut where it was closed."""
        return replace(self, vertices=vertices, faces=faces, **vars(self.compose(made)))


def parts_of(vertices: ArrayLike, faces: ArrayLike, name: str = "") -> list[Part]:
    """Return the connected pieces of an oriented manifold mesh, in the order of their first faces.

    Args:
        vertices: coordinates, shape [V, 3].
        faces: vertex indices, shape [F, 3].
        name: what to call the mesh in a message.

    Raises:
        OmtwarpError: the mesh has defects other than holes, handles and several parts.
    """
    points, triangles = as_arrays(vertices, faces)
    if defects := [d for d in check(points, triangles) if d.kind not in (*MAPPABLE, "inward-orientation")]:
        raise OmtwarpError(describe(defects, name))
    _, labels = Topology(triangles, len(points)).components
    _, first = np.unique(labels, return_index=True)
    parts = []
    for label in labels[np.sort(first)]:
        own = np.flatnonzero(labels == label)
        used, numbered = np.unique(triangles[own], return_inverse=True)
        numbered = numbered.reshape(-1, 3)
        genus = Topology(numbered, len(used)).genus
        parts.append(Part(used, own, points[used], numbered.astype(np.int32), genus, given=len(points)))
    return parts


def places_of(parts: list[Part]) -> NDArray[np.int64]:
    """Return the parts' numbers in the order of their first vertices along a curve through all of them, shape [P]."""
    place = np.argsort(order_along_curve(in_range(np.concatenate([part.vertices for part in parts]))))
    ends = np.cumsum([len(part.vertices) for part in parts])
    return np.argsort([own.min() for own in np.split(place, ends[:-1])])


def options_for(parts: list[Part]) -> list[str]:
    """List the arguments of ``map_surface`` that a mesh needs, with one line on what each does."""
    if len(parts) == 1 and parts[0].is_sphere:
        return []
    lines = []
    loops, genus = sum(len(part.loops) for part in parts), sum(part.genus for part in parts)
    several = len(parts) > 1
    cut = " (with cut=True)" if genus else ""
    doubled = all(len(part.faces) > 1 for part in parts if part.loops)  # the double of one triangle is no surface
    if several and doubled:
        lines.append(f"components=True: map each of the {len(parts)} parts by itself{cut}")
        lines.append(f"together=True: map all parts side by side to one sphere, in proportion to their areas{cut}")
    needed = ["components=True"] * several + ["cut=True"] * bool(genus)
    more = f" (with {' and '.join(needed)})" if needed else ""
    if doubled and all(part.loops for part in parts):
        of_each, others = " of each part" * several, ", other holes filled" * (loops > len(parts))
        lines.append(f"domain='hemisphere': the longest boundary loop{of_each} on the equator{others}{more}")
        places = "the same in the unit disk, or on a cap as large as the hole leaves"
        lines.append(f"domain='disk', domain='cap': {places}{more}")
    if loops:
        way, holes = "domain='sphere', fill_area='natural' or 'small'", number(loops, "hole")
        lines.append(f"{way}: {holes} filled, the rest of the sphere covered{more}")
    if len(parts) == 1 and parts[0].is_torus:
        lines.append("domain='torus': map the surface to the flat torus that it is conformal to")
    if genus:
        handles = number(genus, "handle")
        way = f"cut=True: cut {handles} open along short loops, fill the cuts small, and map to the sphere"
        lines.append(way + " (with components=True)" * several)
    return lines
