"""Maps of surfaces that need not be closed, connected or of genus 0, and their files."""

from __future__ import annotations

import os
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import TypedDict, cast

import numpy as np
from numpy.typing import NDArray

from omtwarp.errors import OmtwarpError
from omtwarp.files.inputs import holds_array, open_input, read_arrays
from omtwarp.files.limits import LARGEST_MESH_FILE
from omtwarp.files.output import as_path
from omtwarp.maps.result import MapResult
from omtwarp.mesh.arrays import fitting_arrays, owned, require_unit_length, whole_numbers
from omtwarp.mesh.surface import SPHERE_AREA, Surface, triangle_areas
from omtwarp.metrics.certificate import Certificate, certify_triangles
from omtwarp.metrics.distortion import Distortion, measure_in_plane, measure_triangles
from omtwarp.options import Domain
from omtwarp.topology.boundary import boundary_half_edges
from omtwarp.topology.kind import connected_components

Array = NDArray[np.float64]

SEVERAL = "several"  # the domain of parts that went to different ones


@dataclass(frozen=True, eq=False, repr=False)
class SurfaceMap(MapResult):
    """The map of a surface with holes, handles or several parts to the sphere, or to a part of it.

    Attributes that a :class:`~omtwarp.MapResult` has too are of the surface as it is mapped: the input's faces,
    in their order, but where an edge had to be split or a handle to be cut. ``report["certificate"]`` is of the closed
    surface that was mapped, filled, cut or doubled.

    Attributes:
        domain: ``sphere``, ``hemisphere``, ``disk``, ``cap``, or ``several`` where parts differ; for a disk, ``sphere``
            is the hemisphere it came from.
        disk: the map to the unit disk, float64, shape [V, 2], where that is the domain.
        vertex_origin: the input's vertex that each vertex is or is a copy of, -1 where one splits an edge, shape [V].
        face_origin: the input's face that each face is a part of, shape [F].
        split_edges: the two vertices that each vertex of origin -1 lies halfway between, in their order, shape [K, 2].
        part: the part of the surface, each on a sphere of its own, that each face belongs to, shape [F].
        cap_centres: where parts lie side by side on one sphere, the centre of each part's cap, shape [P, 3].
        cap_shares: the share of the sphere that each of these caps has, shape [P].
        loops: vertices of the boundary loops that were filled, one loop after the other, shape [N].
        loop_ends: where each loop ends in ``loops``, shape [L].
        loop_pairs: the two sides of each cut, as numbers of loops, shape [G, 2].
        filled_vertices: vertices of the surface as filled, those of the map first, shape [W, 3].
        filled_faces: faces of the surface as filled, those of the map first, shape [H, 3].
        filled_sphere: the map of ``filled_vertices``, shape [W, 3].
        filled_conformal: the map of ``filled_vertices`` that transport started from, shape [W, 3].
        filled_loop: the loop that each face of ``filled_faces`` fills, -1 for the surface's own, shape [H].

    Example:
        >>> import omtwarp
        >>> ball = omtwarp.shapes.icosphere(8)
        >>> result = omtwarp.map_surface((ball.vertices, ball.faces[1:]), domain="sphere", device="cpu")
        >>> type(result).__name__, str(result.domain), len(result.loop_ends)
        ('SurfaceMap', 'sphere', 1)
    """

    domain: str = "sphere"
    disk: Array | None = None
    split_edges: NDArray[np.int64] | None = None
    part: NDArray[np.int64] | None = None
    cap_centres: Array | None = None
    cap_shares: Array | None = None
    loops: NDArray[np.int64] | None = None
    loop_ends: NDArray[np.int64] | None = None
    loop_pairs: NDArray[np.int64] | None = None
    filled_vertices: Array | None = None
    filled_faces: NDArray[np.int64] | None = None
    filled_sphere: Array | None = None
    filled_conformal: Array | None = None
    filled_loop: NDArray[np.int64] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        counts = {"V": len(self.vertices), "F": len(self.faces)}
        fitting = fitting_arrays(vars(self), OWN_LAYOUT, counts)
        for name, value in fitting.items():
            object.__setattr__(self, name, owned(value, OWN_LAYOUT[name][0]))
        if self.filled_faces is not None:
            points = self.vertices if self.filled_vertices is None else self.filled_vertices
            whole_numbers(self.filled_faces, "'filled_faces'", (None, 3), below=len(points))
        for name in ("filled_sphere", "filled_conformal"):
            if name in fitting:
                require_unit_length(fitting[name], f"'{name}'")
        for name in ("part", "loops", "loop_ends", "loop_pairs", "split_edges"):
            if name in fitting and fitting[name].size and fitting[name].min() < 0:
                raise OmtwarpError(f"'{name}': {int(fitting[name].min())} is out of range, at least 0")
        if not isinstance(self.domain, str) or self.domain not in (*Domain, SEVERAL):
            raise OmtwarpError(f"there is no domain {str(self.domain)[:20]!r}")

    def __repr__(self) -> str:
        return f"SurfaceMap({self.domain}, {len(self.vertices)} vertices, {len(self.faces)} faces)"

    def distortion(self, stage: str = "sphere") -> Distortion:
        """Measure the distortion of the map, or of a stage: ``conformal``, ``moser``, ``transported`` or ``disk``.

        The stage ``disk`` is the map to the unit disk, where ``sphere`` is the one to the hemisphere. Areas are
        compared within each part, every part scaled to the area of its image, and all parts count alike; where parts
        lie side by side on one sphere, areas of all are compared, but for the stages before they were put there.

        Raises:
            OmtwarpError: the stage was not run.
        """
        if isinstance(stage, str) and stage == "disk" and self.disk is not None:
            return measure_in_plane(self.vertices, self.faces, self.disk)
        if self.part is None or (self.cap_centres is not None and stage == "sphere"):
            return super().distortion(stage)
        points = getattr(self, stage, None) if stage in ("sphere", "conformal", "moser", "transported") else None
        if points is None:
            raise OmtwarpError(f"this map has no stage '{stage}'")
        on_surface, on_sphere = triangle_areas(self.vertices, self.faces), triangle_areas(points, self.faces)
        ratio = np.bincount(self.part, on_sphere) / np.bincount(self.part, on_surface)
        scale = np.ones(len(self.vertices))
        scale[self.faces] = np.sqrt(ratio[self.part])[:, None]
        return measure_triangles(self.vertices * scale[:, None], self.faces, points)

    def closed(self) -> MapResult:
        """Return the map of the surface with its holes filled, or with both sides of its cuts, which covers the sphere.

        Its first vertices and faces are those of this map. Its density is that of the filling's own area, also where
        the filling is small on the sphere.

        Raises:
            OmtwarpError: the map is to a hemisphere, a disk or a cap, or of several parts; or its arrays do not fit.

        Example:
            >>> import omtwarp
            >>> ball = omtwarp.shapes.icosphere(8)
            >>> result = omtwarp.map_surface((ball.vertices, ball.faces[1:]), domain="sphere", device="cpu")
            >>> result, result.closed()
            (SurfaceMap(sphere, 642 vertices, 1279 faces), MapResult(643 vertices, 1282 faces, omt))
        """
        if self.part is not None:
            raise OmtwarpError("several parts do not cover one sphere: map each part by itself")
        if self.domain != Domain.SPHERE:
            raise OmtwarpError(
                f"a map to a {self.domain} does not cover the sphere: map the mesh with --fill-area natural "
                "(domain='sphere' in Python)"
            )
        if self.filled_faces is None or self.filled_vertices is None or self.filled_sphere is None:
            return self
        if self.filled_conformal is None:
            raise OmtwarpError("the map does not have the conformal map of what fills its holes: map the mesh again")
        if not np.array_equal(self.filled_faces[: len(self.faces)], self.faces):
            raise OmtwarpError("'filled_faces' has to begin with the map's faces: map the mesh again")
        whole = Surface(self.filled_vertices, self.filled_faces.astype(np.int32))
        image = triangle_areas(self.filled_conformal, whole.faces)
        return MapResult(
            vertices=self.filled_vertices,
            faces=whole.faces,
            sphere=self.filled_sphere,
            conformal=self.filled_conformal,
            density=3.0 * whole.vertex_areas / whole.sum_to_vertices(image * (SPHERE_AREA / image.sum())),
            report=self.report,
        )

    @cached_property
    def certificate(self) -> Certificate:
        """The certificate of the map of the filled surface, computed from its arrays at the first use.

        A boundary that is left, the rim of a hemisphere or of a cap, is closed by a fan to the point opposite to it;
        the disk is seen from the centre of the sphere, at height 1. Parts are certified one by one.
        """
        filled = self.filled_faces is not None and self.filled_sphere is not None
        faces = np.asarray(self.filled_faces if filled else self.faces, dtype=np.int32)
        points = np.asarray(self.filled_sphere if filled else self.sphere)
        if self.disk is not None and not filled:
            points = np.concatenate([self.disk, np.ones((len(self.disk), 1))], axis=1)
            points /= np.linalg.norm(points, axis=1)[:, None]
        _, labels = connected_components(faces, len(points))
        found = [_certified(faces[labels == label], points) for label in np.unique(labels)]
        if len(found) == 1:
            return found[0]
        numbers = {name: sum(getattr(one, name) for one in found) for name in ("flips", "wound")}
        once = all(one.degree == 1 and one.ray_degree == 1 for one in found)
        return replace(found[0], **numbers, degree=int(once), ray_degree=int(once))

    def _stored_arrays(self) -> dict[str, NDArray]:
        """Return the arrays of the file that :meth:`save` writes: a :class:`MapResult`'s, and those of this class."""
        own = {name: getattr(self, name) for name in OWN_LAYOUT if getattr(self, name) is not None}
        return super()._stored_arrays() | {"domain": np.array(self.domain)} | own

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> SurfaceMap:
        """Read a map written by :meth:`save`; one of a closed surface has the domain ``sphere``.

        Raises:
            OmtwarpError: the file is missing, or is no map.
        """
        base = MapResult.load(path)
        with open_input(as_path(path), LARGEST_MESH_FILE, "map") as stream:
            arrays = read_arrays(stream, (*OWN_LAYOUT, "domain"))
        domain = str(arrays.pop("domain", "sphere"))
        known = {item.name: getattr(base, item.name) for item in fields(MapResult)}
        try:
            result = cls(**known, domain=domain, **cast(_Arrays, arrays))
        except OmtwarpError as error:
            raise OmtwarpError(f"'{path}' is not a map: {error}") from None
        result.report["certificate"] = result.certificate.to_dict()
        return result


def read_map(path: str | os.PathLike[str]) -> MapResult:
    """Read a map to the sphere or to a part of it: a :class:`SurfaceMap` where the file says to which domain.

    Raises:
        OmtwarpError: the file is missing, or is no map to the sphere.
    """
    file = as_path(path)
    return (SurfaceMap if file.is_file() and holds_array(file, "domain") else MapResult).load(file)


class _Arrays(TypedDict, total=False):
    """The arrays that a map of a surface has in addition to those of :class:`MapResult`, typed as in ``OWN_LAYOUT``."""

    disk: Array
    split_edges: NDArray[np.int64]
    part: NDArray[np.int64]
    loops: NDArray[np.int64]
    loop_ends: NDArray[np.int64]
    loop_pairs: NDArray[np.int64]
    filled_vertices: Array
    filled_faces: NDArray[np.int64]
    filled_sphere: Array
    filled_conformal: Array
    filled_loop: NDArray[np.int64]


def _certified(faces: NDArray[np.int32], points: Array) -> Certificate:
    """Return the certificate of one part, its vertices numbered anew and its boundary closed."""
    used, own = np.unique(faces, return_inverse=True)
    own, places = own.reshape(-1, 3).astype(np.int32), points[used]
    rim = boundary_half_edges(own, len(used))
    if len(rim):
        fan = np.stack([rim[:, 1], rim[:, 0], np.full(len(rim), len(used))], axis=1).astype(np.int32)
        across = np.cross(places[rim[:, 0]], places[rim[:, 1]]).sum(axis=0)
        opposite = -across / max(float(np.linalg.norm(across)), np.finfo(float).tiny)
        own, places = np.concatenate([own, fan]), np.concatenate([places, [opposite]])
    return certify_triangles(np.asarray(own, dtype=np.int32), places)


# Type and shape of every array that a MapResult lacks, with V vertices and F faces, W and H of the filled surface.
OWN_LAYOUT: dict[str, tuple[type[np.generic], tuple[str | int, ...]]] = {
    "disk": (np.float64, ("V", 2)),
    "split_edges": (np.int64, ("K", 2)),
    "part": (np.int64, ("F",)),
    "cap_centres": (np.float64, ("P", 3)),
    "cap_shares": (np.float64, ("P",)),
    "loops": (np.int64, ("N",)),
    "loop_ends": (np.int64, ("L",)),
    "loop_pairs": (np.int64, ("G", 2)),
    "filled_vertices": (np.float64, ("W", 3)),
    "filled_faces": (np.int64, ("H", 3)),
    "filled_sphere": (np.float64, ("W", 3)),
    "filled_conformal": (np.float64, ("W", 3)),
    "filled_loop": (np.int64, ("H",)),
}
