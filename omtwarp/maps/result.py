"""Finished maps: their arrays and stages, the records of these, and their files."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Generic, Self, TypedDict, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from omtwarp.errors import LacksArray, OmtwarpError, naming
from omtwarp.files.inputs import holds_array, open_input, read_arrays, write_arrays
from omtwarp.files.limits import LARGEST_MESH_FILE
from omtwarp.files.output import as_path
from omtwarp.maps import Displayable
from omtwarp.maps.torus_map import TorusCertificate, certify_torus, ring_torus
from omtwarp.mesh.arrays import Floats, Ints, Layout, fitting_arrays, real_numbers, require_unit_length, whole_numbers
from omtwarp.mesh.origins import Origins
from omtwarp.mesh.surface import SPHERE_AREA, Surface, triangle_areas
from omtwarp.mesh.validate import Topology
from omtwarp.metrics.certificate import Certificate, certify_triangles
from omtwarp.metrics.distortion import Aggregates, Distortion, measure_corners, measure_in_plane, measure_triangles
from omtwarp.options import ChosenOptions, Domain, Record
from omtwarp.topology.kind import boundary_half_edges

SEVERAL = "several"  # the domain of parts that went to different ones
STAGES = ("coordinates", "sphere", "conformal", "moser", "transported", "disk")
ON_SPHERE = ("sphere", "conformal", "moser", "transported", "source", "filled_sphere", "filled_conformal")
# Arrays that tell a map's file from a mesh's, even where one was lost, and a map to a torus from one to the sphere.
OF_TORUS_MAPS = ("coordinates", "wraps", "lattice")
OF_MAPS = ("sphere", "conformal", *OF_TORUS_MAPS)
ON_TORUS = ("vertices", "faces", *OF_TORUS_MAPS, "conformal", "vertex_origin", "face_origin", "split_edges")


class StageReport(Aggregates, total=False):
    """A stage in a report: its time, its steps, the quality of its map, and what else is known of it.

    Attributes:
        name: the stage, or the method where one system makes the whole map.
        seconds: how long it took.
        iterations: steps of the method of this stage.
        flips: triangles that are not positively oriented, in floating point.
        degree: how often the map covers the sphere.
        finite: whether every coordinate is finite.
        area: aggregates of the area distortion (see :class:`omtwarp.metrics.distortion.Distortion`).
        angle: the same of the angle distortion.
        transport_cost: M(g) of equation 6 from the map that transport starts from.
    """

    name: str
    seconds: float
    iterations: int
    transport_cost: float
    repaired: int
    converged: bool
    ended: str
    route: str
    reason: str
    axes: str
    gave_up: str
    weight: str | float | None
    shape_weight: float
    largest_area_error: float
    largest_ring_error: float
    area_error: float


class Warned(TypedDict, total=False):
    """A warning in a report: its kind, the worst place, its text, and the part of the surface where there are many."""

    kind: str
    where: int
    text: str
    part: int


class MeshReport(TypedDict, total=False):
    """The size of a mesh: its numbers of vertices and faces, the sides of its bounding box, vertices of the input."""

    input_vertices: int
    vertices: int
    faces: int
    extent: list[float]


class SurfaceReport(TypedDict, total=False):
    """Changes to a surface of another topology before it was mapped."""

    domain: str
    boundary_loops: int
    genus: int
    split_edges: int
    filled_loops: int
    cut_along: list[str]
    mapped_surface: MeshReport | None
    share_of_sphere: float
    centre: list[float]


class MapReport(ChosenOptions, total=False):
    """How a map was made, as plain values ready for JSON; that of a map to a torus has the unit of its coordinates.

    A report that was read from a file has the fields that the file has.
    """

    mesh: MeshReport
    structure: str
    volume_geometry: Mapping[str, object]
    versions: dict[str, str]
    device: str
    solver: str
    start: dict[str, str]
    seconds: float
    mass: dict[str, float]
    stages: list[StageReport]
    certificate: Mapping[str, int | float | None]
    optimality: Mapping[str, float | int | None]
    warnings: list[Warned]
    surface: SurfaceReport
    alignment: Mapping[str, object]
    registration: Mapping[str, object]
    parts: list[MapReport]
    domain: str
    quantum: float


Kind = TypeVar("Kind", bound=np.generic)


class Stored(Generic[Kind]):
    """An array of a map and of its file, under the attribute's name; None where the map, or the class, has none.

    Args:
        kind: of the numbers.
        shape: of the array, with letters for lengths that agree: V vertices and F faces; W and H of the surface with
            its holes filled; D the 3 dimensions of the sphere's space, or the 2 of a torus.
    """

    def __init__(self, kind: type[Kind], *shape: str | int):
        self.layout = kind, shape

    def __set_name__(self, owner: type[MapResult], name: str) -> None:
        self.name = name

    def __get__(self, result: MapResult | None, owner: type[MapResult]) -> NDArray[Kind] | None:
        return None if result is None else result.arrays.get(self.name)


class Needed(Stored[Kind]):
    """An array that every map to a domain has, and that no map to another one has."""

    def __get__(self, result: MapResult | None, owner: type[MapResult]) -> NDArray[Kind]:
        values = super().__get__(result, owner)
        if values is None and result is not None:
            raise LacksArray(f"the domain of this map is '{result.domain}': it has no '{self.name}'")
        return cast("NDArray[Kind]", values)


@dataclass(frozen=True, init=False, eq=False, repr=False)
class MapResult(Displayable):
    """A surface and its map to the unit sphere, to a part of it, or to a flat torus R² / Λ, in the order of the input.

    The arrays belong to the result: they are copies, and cannot be written to. Where the surface has holes, handles or
    several parts, they are of the surface as it is mapped: the input's faces, in their order, but where an edge had to
    be split or a handle to be cut; ``report["certificate"]`` is of the closed surface that was mapped, filled, cut or
    doubled. On a torus the corner ``k`` of triangle ``f`` lies at ``corners[f, k] @ lattice`` in the plane.

    An array that only maps to other domains have is an error where it is read.

    Attributes:
        vertices: the surface as given, float64, shape [V, 3].
        faces: int32, shape [F, 3].
        sphere: the final map, unit vectors, float64, shape [V, 3]; not of a map to a torus.
        conformal: the map transport started from (conformal, or its substitute: see ``report``), shape [V, 3]; on a
            torus as ``coordinates``, shape [V, 2].
        density: μ at the vertices, area on the surface over area on the sphere under ``conformal``, shape [V].
        face_density: μ of the triangles, shape [F].
        source: the points that transport starts from: where the conformal map puts the vertices, even where it flips
            triangles or shrinks them to nothing; shape [V, 3].
        moser: the initial mass-preserving map, shape [V, 3], where it was made.
        transported: the optimal map before refinement, shape [V, 3], where it was made.
        measure: the area that every triangle was to have, total 4π, where weights were given, shape [F]; of each part
            that is mapped by itself, and less by what fills holes.
        target: the density asked for at the images of the vertices, mean 1, where one was given, shape [V].
        vertex_origin: after a repair, a cut, quartering or the splitting of edges, the vertex of the input that every
            vertex is or is a copy of, -1 for new ones; int64, shape [V].
        face_origin: the face of the input that each face is or is a part of, int64, shape [F].
        vertex_of_file: the vertex that each vertex of the file was, where the file held copies along the seams of a
            texture and the command line joined them; int64, shape [N].
        history: one record per iteration of the transport flow: ``iteration``, ``cost``, ``curl``, ...
        report: how the map was made, ready for JSON.
        domain: ``sphere``, ``hemisphere``, ``disk``, ``cap``, ``torus``, or ``several`` where parts differ; for a disk,
            ``sphere`` is the hemisphere it came from.
        coordinates: the final map to a torus, in multiples of the lattice's vectors, float64, shape [V, 2].
        wraps: whole numbers that are added to the coordinates at the corners of triangles, int64, shape [F, 3, 2].
        lattice: the vectors that the torus repeats along, as rows, shape [2, 2]; the torus has the surface's area.
        disk: the map to the unit disk, float64, shape [V, 2], where that is the domain.
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
        arrays: all of these arrays that the map has, by name.

    Example:
        >>> import numpy as np, omtwarp
        >>> result = omtwarp.map_to_sphere(omtwarp.shapes.blob(seed=3, sphere=320), until="moser", device="cpu")
        >>> _ = result.save("blob.npz")
        >>> bool(np.array_equal(omtwarp.MapResult.load("blob.npz").sphere, result.sphere))
        True
        >>> import trimesh
        >>> ring = trimesh.creation.torus(1.0, 0.4, major_sections=12, minor_sections=6)
        >>> result = omtwarp.map_surface(ring, domain="torus")
        >>> result, result.certificate.flips, result.certificate.degree
        (MapResult(torus, 72 vertices, 144 faces, bijective), 0, 1)
    """

    arrays: Mapping[str, NDArray]
    domain: str
    history: list[Record]
    report: MapReport

    vertices = Needed(np.float64, "V", 3)
    faces = Needed(np.int32, "F", 3)
    sphere = Needed(np.float64, "V", 3)
    conformal = Needed(np.float64, "V", "D")
    density = Needed(np.float64, "V")
    face_density = Stored(np.float64, "F")
    source = Stored(np.float64, "V", 3)
    moser = Stored(np.float64, "V", 3)
    transported = Stored(np.float64, "V", 3)
    measure = Stored(np.float64, "F")
    target = Stored(np.float64, "V")
    vertex_origin = Stored(np.int64, "V")
    face_origin = Stored(np.int64, "F")
    vertex_of_file = Stored(np.int64, "N")
    disk = Stored(np.float64, "V", 2)
    split_edges = Stored(np.int64, "K", 2)
    part = Stored(np.int64, "F")
    cap_centres = Stored(np.float64, "P", 3)
    cap_shares = Stored(np.float64, "P")
    loops = Stored(np.int64, "M")
    loop_ends = Stored(np.int64, "L")
    loop_pairs = Stored(np.int64, "G", 2)
    filled_vertices = Stored(np.float64, "W", 3)
    filled_faces = Stored(np.int64, "H", 3)
    filled_sphere = Stored(np.float64, "W", 3)
    filled_conformal = Stored(np.float64, "W", 3)
    filled_loop = Stored(np.int64, "H")
    coordinates = Needed(np.float64, "V", 2)
    wraps = Needed(np.int64, "F", 3, 2)
    lattice = Needed(np.float64, 2, 2)

    def __init__(
        self,
        *in_order: object,
        arrays: Mapping[str, object] = MappingProxyType({}),
        domain: str = Domain.SPHERE,
        history: list[Record] | None = None,
        report: MapReport | None = None,
        **named: object,
    ) -> None:
        """Check the arrays of a map: given in their order, by name, or ``arrays``, of which others take the place.

        Raises:
            OmtwarpError: an array is missing, is none, does not fit the others, or is of maps to other domains.
        """
        given = {**arrays, **dict(zip(ARRAYS, in_order, strict=False)), **named}
        given = {name: values for name, values in given.items() if values is not None}
        if not isinstance(domain, str) or domain not in (*Domain, SEVERAL):
            raise OmtwarpError(f"there is no domain {str(domain)[:20]!r}")
        layout = layout_on(domain)
        if missing := [name for name in layout if name not in given and isinstance(ARRAYS[name], Needed)]:
            raise OmtwarpError(f"it has no '{missing[0]}'")
        if others := given.keys() - layout.keys():
            raise OmtwarpError(f"a map whose domain is '{domain}' has no '{min(others)}'")
        vertices = real_numbers(given["vertices"], "'vertices'", (None, 3))
        faces = whole_numbers(given["faces"], "'faces'", (None, 3), below=len(vertices))
        lengths = {"V": len(vertices), "F": len(faces), "D": 2 if domain == Domain.TORUS else 3}
        fitting = fitting_arrays(given, layout, lengths)
        below = dict.fromkeys(("part", "loop_ends", "loop_pairs"), len(vertices) + len(faces))
        below |= {"loops": len(vertices), "split_edges": len(vertices)}
        below["filled_faces"] = len(fitting.get("filled_vertices", vertices))
        for name in below.keys() & fitting.keys():
            whole_numbers(fitting[name], f"'{name}'", fitting[name].shape, below=below[name])
        for name in ON_SPHERE:
            if name in fitting and domain != Domain.TORUS:
                require_unit_length(fitting[name], f"'{name}'")
        vars(self).update(arrays=fitting, domain=str(domain), history=[] if history is None else history)
        vars(self)["report"] = {} if report is None else report

    def __repr__(self) -> str:
        known = [] if self.domain == Domain.SPHERE else [self.domain]
        known += [f"{len(self.vertices)} vertices", f"{len(self.faces)} faces"]
        if "method" in self.report:
            known.append(str(self.report["method"]))
        if "certificate" in vars(self) and self.bijective:  # nothing is measured for a line of text
            known.append("bijective")
        return f"MapResult({', '.join(known)})"

    @property
    def maps(self) -> dict[str, Floats]:
        """The maps of the stages that were run, by name; ``sphere``, ``disk`` or ``coordinates`` is the final one."""
        return {name: self.arrays[name] for name in STAGES if name in self.arrays}

    @property
    def origins(self) -> Origins | None:
        """What vertices and faces are in the input; None where they are the input's own."""
        if self.vertex_origin is None or self.face_origin is None:
            return None
        given = self.report.get("mesh", {}).get("input_vertices")
        origins = Origins(self.vertex_origin, self.face_origin, given=given if isinstance(given, int) else None)
        return origins if self.split_edges is None else replace(origins, split_edges=self.split_edges)

    def with_arrays(self, arrays: Mapping[str, object]) -> MapResult:
        """Return the map with other arrays, or another domain or report, in place of those of these names."""
        make: Callable[..., MapResult] = MapResult
        return make(**{**{each.name: getattr(self, each.name) for each in fields(self)}, **arrays})

    def rows(self, chosen: Mapping[str, NDArray | slice]) -> dict[str, NDArray]:
        """Return rows of the arrays that have one for every vertex, or face, by the arrays' names.

        Args:
            chosen: which, in their order, under the letters that stand first in the arrays' shapes: ``V`` for
                vertices, ``F`` for faces.
        """
        first = {name: str(ARRAYS[name].layout[1][0]) for name in self.arrays}
        return {name: self.arrays[name][chosen[letter]] for name, letter in first.items() if letter in chosen}

    def turned(self, frame: Floats) -> MapResult:
        """Return the map and those of its stages turned by a rotation or reflection, ``points @ frame``.

        Raises:
            OmtwarpError: the map is to a torus, or the frame is no such matrix.
        """
        frame = real_numbers(frame, "frame", (3, 3))
        known = {"sphere": self.sphere, **{name: self.arrays[name] for name in ON_SPHERE if name in self.arrays}}
        return self.with_arrays({name: points @ frame for name, points in known.items()})

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the map as ``.npz``: arrays of the attributes' names, and the report as JSON text under ``report``.

        Raises:
            OmtwarpError: the file cannot be written; nothing is left of it.
        """
        write_arrays(path, self.stored_arrays())

    def stored_arrays(self) -> dict[str, NDArray]:
        """Return the arrays of the file that :meth:`save` writes, the domain and the report among them."""
        arrays = {**self.arrays, "report": np.array(json.dumps(self.report | {"history": self.history}))}
        plain = self.part is None and self.loops is None
        told = plain and self.domain in (Domain.SPHERE, Domain.TORUS)  # by what arrays there are
        return arrays if told else arrays | {"domain": np.array(self.domain)}

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Self:
        """Read a map, to any domain, that was written by :meth:`save`; a report that is malformed is empty.

        Raises:
            OmtwarpError: the file is missing, or is no map.
        """
        with open_input(as_path(path), LARGEST_MESH_FILE, "map") as stream:
            try:
                known = read_arrays(stream, (*ARRAYS, "domain", "report"))
            except OmtwarpError as error:
                raise OmtwarpError(f"'{path}' is not a map: {error}; make one with map_to_sphere and save") from None
        try:
            report = json.loads(str(known.get("report", "{}")))
        except (ValueError, RecursionError):
            report = {}
        report = report if isinstance(report, dict) else {}
        history = report.pop("history", [])
        history = [entry for entry in history if isinstance(entry, dict)] if isinstance(history, list) else []
        on_torus = any(name in known for name in OF_TORUS_MAPS)
        domain = Domain.TORUS if on_torus else str(known.get("domain", Domain.SPHERE))
        arrays = {name: known[name] for name in layout_on(domain) if name in known}
        make: Callable[..., Self] = cls
        with naming(f"'{path}' is not a map{' to a torus' * on_torus}"):
            result = make(arrays=arrays, domain=domain, history=history, report=report)
        result.report["certificate"] = result.certificate.to_dict()  # anew: a file's statements are not trusted
        return result

    def distortion(self, stage: str | None = None) -> Distortion:
        """Measure the distortion of the map, or of a stage: one of the names in ``maps``.

        Without a name it is that of ``sphere``, or of ``coordinates`` on a torus. The stage ``disk`` is the map to the
        unit disk, where ``sphere`` is the one to the hemisphere. Areas are compared within each part, every part scaled
        to the area of its image, and all parts count alike; where parts lie side by side on one sphere, areas of all
        are compared, but for the stages before they were put there.

        Raises:
            OmtwarpError: the stage was not run.
        """
        on_torus = self.domain == Domain.TORUS
        stage = ("coordinates" if on_torus else "sphere") if stage is None else stage
        points = self.maps.get(stage) if isinstance(stage, str) else None
        if points is None:
            raise OmtwarpError(f"this map has no stage '{stage}'")
        if on_torus:
            corner = (points[self.faces] + self.wraps) @ self.lattice
            return measure_corners(self.vertices[self.faces], corner, abs(float(np.linalg.det(self.lattice))))
        if stage == "disk":
            return measure_in_plane(self.vertices, self.faces, points)
        if self.part is None or (self.cap_centres is not None and stage == "sphere"):
            return measure_triangles(self.vertices, self.faces, points)
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
            OmtwarpError: the map is not to the sphere alone, or its arrays do not fit.

        Example:
            >>> import omtwarp
            >>> ball = omtwarp.shapes.icosphere(8)
            >>> result = omtwarp.map_surface((ball.vertices, ball.faces[1:]), domain="sphere", device="cpu")
            >>> result, result.closed()
            (MapResult(642 vertices, 1279 faces, omt, bijective), MapResult(643 vertices, 1282 faces, omt))
        """
        if self.domain == Domain.TORUS:
            raise OmtwarpError("this is a map to a torus, where one to the sphere is needed, as domain='sphere' makes")
        if self.part is not None:
            raise OmtwarpError("several parts do not cover one sphere: map each part by itself")
        if self.domain != Domain.SPHERE:
            raise OmtwarpError(f"a map to a {self.domain} does not cover the sphere: map the mesh with domain='sphere'")
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
    def certificate(self) -> Certificate | TorusCertificate:
        """The certificate of the map of the filled surface, computed from its arrays at the first use.

        A boundary that is left, the rim of a hemisphere or of a cap, is closed by a fan to the point opposite to it;
        the disk is seen from the centre of the sphere, at height 1. Parts are certified one by one.
        """
        if self.domain == Domain.TORUS:
            return certify_torus(self.corners)
        filled = self.filled_faces is not None and self.filled_sphere is not None
        if self.domain == Domain.SPHERE and not filled and self.part is None:
            return certify_triangles(self.faces, self.sphere)
        faces = np.asarray(self.filled_faces if filled else self.faces, dtype=np.int32)
        points = np.asarray(self.filled_sphere if filled else self.sphere)
        if self.disk is not None and not filled:
            points = np.concatenate([self.disk, np.ones((len(self.disk), 1))], axis=1)
            points /= np.linalg.norm(points, axis=1)[:, None]
        _, labels = Topology(faces.astype(np.int64), len(points)).components
        certificates = [_certified(faces[labels == label], points) for label in np.unique(labels)]
        if len(certificates) == 1:
            return certificates[0]
        numbers = {name: sum(getattr(one, name) for one in certificates) for name in ("flips", "wound")}
        once = all(one.degree == 1 and one.ray_degree == 1 for one in certificates)
        return replace(certificates[0], **numbers, degree=int(once), ray_degree=int(once))

    def certified(self, certificate: Certificate) -> Self:
        """Give the map the certificate that was established of these very arrays, and return it."""
        object.__setattr__(self, "certificate", certificate)
        return self

    @property
    def bijective(self) -> bool:
        """Whether the final map is one to one and onto: see :attr:`certificate`."""
        return self.certificate.bijective

    @property
    def corners(self) -> Floats:
        """Corners of the triangles on a torus in multiples of the lattice's vectors, shape [F, 3, 2]; exact sums."""
        return self.coordinates[self.faces] + self.wraps

    def ring(self) -> Floats:
        """Map the vertices to a ring torus, with areas in proportion to those of the surface, shape [V, 3].

        The ring's radii are in the proportion of the lattice's vectors, the tube at most 0.8 of the ring.

        Raises:
            OmtwarpError: the map is not to a torus.
        """
        return ring_torus(self.coordinates, self.lattice)


ARRAYS = {name: each for name, each in vars(MapResult).items() if isinstance(each, Stored)}


def layout_on(domain: str) -> Layout:
    """Return type and shape of every array that maps to a domain have, by name."""
    names = ON_TORUS if domain == Domain.TORUS else [name for name in ARRAYS if name not in OF_TORUS_MAPS]
    return {name: ARRAYS[name].layout for name in names}


def is_map_file(path: Path) -> bool:
    """Return whether a file is that of a map, whole or not."""
    return path.suffix.lower() == ".npz" and holds_array(path, *OF_MAPS)


def origin_arrays(origins: Origins | None) -> dict[str, NDArray[np.int64] | None]:
    """Return the arrays of a map, by name, that say what its vertices and faces are in the input; None for none."""
    arrays = {name: getattr(origins, name, None) for name in ("vertex_origin", "face_origin", "split_edges")}
    return {name: values if values is not None and len(values) else None for name, values in arrays.items()}


def _certified(faces: Ints, points: Floats) -> Certificate:
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
