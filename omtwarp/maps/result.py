"""Finished maps: their arrays and stages, the records of these, and their files."""

from __future__ import annotations

import copy
import json
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import ClassVar, Self, TypedDict, cast

import numpy as np
from numpy.typing import NDArray

from omtwarp.errors import OmtwarpError
from omtwarp.files.inputs import holds_array, open_input, read_arrays, write_arrays
from omtwarp.files.limits import LARGEST_MESH_FILE
from omtwarp.files.output import as_path
from omtwarp.maps import Displayable
from omtwarp.mesh.arrays import Floats, Ints, Layout, fitting_arrays, real_numbers, require_unit_length, whole_numbers
from omtwarp.mesh.origins import Origins
from omtwarp.mesh.surface import SPHERE_AREA, Surface, triangle_areas
from omtwarp.mesh.validate import Topology
from omtwarp.metrics.certificate import Certificate, certify_triangles
from omtwarp.metrics.distortion import Aggregates, Distortion, measure_in_plane, measure_triangles
from omtwarp.options import ChosenOptions, Domain, Record
from omtwarp.topology.kind import boundary_half_edges

SEVERAL = "several"  # the domain of parts that went to different ones
STAGES = ("sphere", "conformal", "moser", "transported")
ON_SPHERE = (*STAGES, "source", "filled_sphere", "filled_conformal")  # arrays of unit vectors
# Arrays that tell a map's file from a mesh's, even where one was lost, and a map to a torus from one to the sphere.
OF_TORUS_MAPS = ("wraps", "coordinates", "lattice")
OF_MAPS = ("sphere", "conformal", *OF_TORUS_MAPS)


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
    """How a map was made, as plain values ready for JSON.

    A report that was read from a file has the fields that the file has.
    """

    mesh: MeshReport
    structure: str
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


def stored(kind: type[np.generic], *shape: str | int) -> dict[str, object]:
    """Return what a field of a map says of its array: its type, and its shape with letters for lengths that agree.

    Args:
        kind: of the numbers.
        shape: V vertices and F faces; W and H of the surface with its holes filled.
    """
    return {"layout": (kind, shape)}


def layout_of(kind: type) -> Layout:
    """Return type and shape of every array that a class of maps has, by name."""
    return {each.name: each.metadata["layout"] for each in fields(kind) if "layout" in each.metadata}


class StoredMap(Displayable):
    """What maps to the sphere and to a torus have in common: checked arrays of their own, and a file.

    Attributes:
        layout: type and shape of every array, with letters for lengths that have to agree.
        required: names of the arrays that are always there.
        kind: what a file of it is called in messages.
    """

    layout: ClassVar[Layout]
    required: ClassVar[tuple[str, ...]]
    kind: ClassVar[str]
    history: list[Record]

    def __post_init__(self) -> None:
        arrays = vars(self)
        self._require(arrays)
        vertices = real_numbers(arrays["vertices"], "'vertices'", (None, 3))
        faces = whole_numbers(arrays["faces"], "'faces'", (None, 3), below=len(vertices))
        fitting = fitting_arrays(arrays, self.layout, {"V": len(vertices), "F": len(faces)})
        for name, value in fitting.items():
            object.__setattr__(self, name, value)
        below = dict.fromkeys(("part", "loop_ends", "loop_pairs"), len(vertices) + len(faces))
        below |= {"loops": len(vertices), "split_edges": len(vertices)}
        for name in below.keys() & fitting.keys():
            whole_numbers(fitting[name], f"'{name}'", fitting[name].shape, below=below[name])

    @classmethod
    def _require(cls, arrays: Mapping[str, object]) -> None:
        """Make sure that no array is missing.

        Raises:
            OmtwarpError: one is; the first is named.
        """
        missing = [name for name in cls.required if arrays.get(name) is None]
        if missing:
            raise OmtwarpError(f"it has no '{missing[0]}'")

    @property
    def origins(self) -> Origins | None:
        """What vertices and faces are in the input; None where they are the input's own."""
        known = vars(self)
        if known["vertex_origin"] is None or known["face_origin"] is None:
            return None
        edges, given = known["split_edges"], known["report"].get("mesh", {}).get("input_vertices")
        origins = Origins(known["vertex_origin"], known["face_origin"], given=given if isinstance(given, int) else None)
        return origins if edges is None else replace(origins, split_edges=edges)

    def with_arrays(self, arrays: Mapping[str, object]) -> Self:
        """Return the map with other arrays, or another domain or report, in place of those of these names."""
        other = copy.copy(self)
        vars(other).pop("certificate", None)
        for name, value in arrays.items():
            object.__setattr__(other, name, value)
        other.__post_init__()
        return other

    def rows(self, chosen: Mapping[str, NDArray | slice]) -> dict[str, NDArray]:
        """Return rows of the arrays that have one for every vertex, or face, by the arrays' names.

        Args:
            chosen: which, in their order, under the letters that stand first in the shapes of ``layout``: ``V`` for
                vertices, ``F`` for faces.
        """
        known = vars(self)
        return {
            name: known[name][chosen[str(letter)]]
            for name, (_, (letter, *_)) in self.layout.items()
            if letter in chosen and known[name] is not None
        }

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the map as ``.npz``: arrays of the attributes' names, and the report as JSON text under ``report``.

        Raises:
            OmtwarpError: the file cannot be written; nothing is left of it.
        """
        write_arrays(path, self.stored_arrays())

    def stored_arrays(self) -> dict[str, NDArray]:
        """Return the arrays of the file that :meth:`save` writes, the report among them, by their names there."""
        known = vars(self)
        arrays = {name: known[name] for name in self.layout if known[name] is not None}
        return arrays | {"report": np.array(json.dumps(known["report"] | {"history": self.history}))}

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Self:
        """Read a map written by :meth:`save`.

        Raises:
            OmtwarpError: the file is missing, or is no map of this kind.
        """
        return cls.from_arrays(read_map_arrays(path, cls), path)

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray], path: str | os.PathLike[str]) -> Self:
        """Make a map from the arrays of a file, of which ``path`` is the name for messages.

        A report that is malformed is empty.

        Raises:
            OmtwarpError: the arrays are not those of a map of this kind.
        """
        try:
            report = json.loads(str(arrays.get("report", "{}")))
        except (ValueError, RecursionError):
            report = {}
        report = report if isinstance(report, dict) else {}
        history = report.pop("history", [])
        history = [entry for entry in history if isinstance(entry, dict)] if isinstance(history, list) else []
        stored = {name: arrays[name] for name in cls.layout if name in arrays}
        make: Callable[..., Self] = cls
        try:
            cls._require(stored)
            words = {"domain": str(arrays["domain"])} if "domain" in arrays else {}
            return make(**stored, **words, history=history, report=report)
        except OmtwarpError as error:
            raise OmtwarpError(f"'{path}' is not {cls.kind}: {error}") from None


def is_map_file(path: Path) -> bool:
    """Return whether a file is that of a map, whole or not."""
    return path.suffix.lower() == ".npz" and holds_array(path, *OF_MAPS)


def read_map_arrays(path: str | os.PathLike[str], *kinds: type[StoredMap]) -> dict[str, NDArray]:
    """Read the arrays that a map of any of these kinds may have, and those by which another kind is told.

    Raises:
        OmtwarpError: the file is missing, or is no ``.npz``.
    """
    names = dict.fromkeys((*(name for kind in kinds for name in kind.layout), *OF_TORUS_MAPS, "domain", "report"))
    with open_input(as_path(path), LARGEST_MESH_FILE, "map") as stream:
        try:
            return read_arrays(stream, names)
        except OmtwarpError as error:
            words = f"'{path}' is not a map: {error}; make one with map_to_sphere and save"
            raise OmtwarpError(words) from None


@dataclass(frozen=True, eq=False, repr=False)
class MapResult(StoredMap):
    """A surface and its map to the unit sphere, or to a part of it, in the order of the input.

    The arrays belong to the result: they are copies, and cannot be written to. Where the surface has holes, handles or
    several parts, they are of the surface as it is mapped: the input's faces, in their order, but where an edge had to
    be split or a handle to be cut; ``report["certificate"]`` is of the closed surface that was mapped, filled, cut or
    doubled.

    Attributes:
        vertices: the surface as given, float64, shape [V, 3].
        faces: int32, shape [F, 3].
        sphere: the final map, unit vectors, float64, shape [V, 3].
        conformal: the map transport started from (conformal, or its substitute: see ``report``), shape [V, 3].
        density: μ at the vertices, area on the surface over area on the sphere under ``conformal``, shape [V].
        face_density: μ of the triangles, shape [F].
        source: the points that transport starts from: where the conformal map puts the vertices, even where it flips
            triangles or shrinks them to nothing; shape [V, 3].
        moser: the initial mass-preserving map, shape [V, 3], where it was made.
        transported: the optimal map before refinement, shape [V, 3], where it was made.
        measure: the area that every triangle was to have, total 4π, where weights were given, shape [F].
        target: the density asked for at the images of the vertices, mean 1, where one was given, shape [V].
        vertex_origin: after a repair, a cut, quartering or the splitting of edges, the vertex of the input that every
            vertex is or is a copy of, -1 for new ones; int64, shape [V].
        face_origin: the face of the input that each face is or is a part of, int64, shape [F].
        vertex_of_file: the vertex that each vertex of the file was, where the file held copies along the seams of a
            texture and the command line joined them; int64, shape [N].
        history: one record per iteration of the transport flow: ``iteration``, ``cost``, ``curl``, ...
        report: how the map was made, ready for JSON.
        domain: ``sphere``, ``hemisphere``, ``disk``, ``cap``, or ``several`` where parts differ; for a disk, ``sphere``
            is the hemisphere it came from.
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

    Example:
        >>> import numpy as np, omtwarp
        >>> result = omtwarp.map_to_sphere(omtwarp.shapes.blob(seed=3, sphere=320), until="moser", device="cpu")
        >>> _ = result.save("blob.npz")
        >>> bool(np.array_equal(omtwarp.MapResult.load("blob.npz").sphere, result.sphere))
        True
    """

    vertices: Floats = field(metadata=stored(np.float64, "V", 3))
    faces: Ints = field(metadata=stored(np.int32, "F", 3))
    sphere: Floats = field(metadata=stored(np.float64, "V", 3))
    conformal: Floats = field(metadata=stored(np.float64, "V", 3))
    density: Floats = field(metadata=stored(np.float64, "V"))
    face_density: Floats | None = field(default=None, metadata=stored(np.float64, "F"))
    source: Floats | None = field(default=None, metadata=stored(np.float64, "V", 3))
    moser: Floats | None = field(default=None, metadata=stored(np.float64, "V", 3))
    transported: Floats | None = field(default=None, metadata=stored(np.float64, "V", 3))
    measure: Floats | None = field(default=None, metadata=stored(np.float64, "F"))
    target: Floats | None = field(default=None, metadata=stored(np.float64, "V"))
    vertex_origin: NDArray[np.int64] | None = field(default=None, metadata=stored(np.int64, "V"))
    face_origin: NDArray[np.int64] | None = field(default=None, metadata=stored(np.int64, "F"))
    vertex_of_file: NDArray[np.int64] | None = field(default=None, metadata=stored(np.int64, "N"))
    history: list[Record] = field(default_factory=list)
    report: MapReport = field(default_factory=lambda: cast(MapReport, {}))

    domain: str = "sphere"
    disk: Floats | None = field(default=None, metadata=stored(np.float64, "V", 2))
    split_edges: NDArray[np.int64] | None = field(default=None, metadata=stored(np.int64, "K", 2))
    part: NDArray[np.int64] | None = field(default=None, metadata=stored(np.int64, "F"))
    cap_centres: Floats | None = field(default=None, metadata=stored(np.float64, "P", 3))
    cap_shares: Floats | None = field(default=None, metadata=stored(np.float64, "P"))
    loops: NDArray[np.int64] | None = field(default=None, metadata=stored(np.int64, "M"))
    loop_ends: NDArray[np.int64] | None = field(default=None, metadata=stored(np.int64, "L"))
    loop_pairs: NDArray[np.int64] | None = field(default=None, metadata=stored(np.int64, "G", 2))
    filled_vertices: Floats | None = field(default=None, metadata=stored(np.float64, "W", 3))
    filled_faces: NDArray[np.int64] | None = field(default=None, metadata=stored(np.int64, "H", 3))
    filled_sphere: Floats | None = field(default=None, metadata=stored(np.float64, "W", 3))
    filled_conformal: Floats | None = field(default=None, metadata=stored(np.float64, "W", 3))
    filled_loop: NDArray[np.int64] | None = field(default=None, metadata=stored(np.int64, "H"))

    required = ("vertices", "faces", "sphere", "conformal", "density")
    kind = "a map"

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ON_SPHERE:
            if getattr(self, name) is not None:
                require_unit_length(getattr(self, name), f"'{name}'")
        if self.filled_faces is not None:
            points = self.vertices if self.filled_vertices is None else self.filled_vertices
            whole_numbers(self.filled_faces, "'filled_faces'", (None, 3), below=len(points))
        if not isinstance(self.domain, str) or self.domain not in (*Domain, SEVERAL):
            raise OmtwarpError(f"there is no domain {str(self.domain)[:20]!r}")

    def __repr__(self) -> str:
        known = [] if self.domain == Domain.SPHERE else [str(self.domain)]
        known += [f"{len(self.vertices)} vertices", f"{len(self.faces)} faces"]
        if "method" in self.report:
            known.append(str(self.report["method"]))
        if "certificate" in vars(self) and self.bijective:  # nothing is measured for a line of text
            known.append("bijective")
        return f"MapResult({', '.join(known)})"

    def turned(self, frame: Floats) -> MapResult:
        """Return the map and those of its stages turned by a rotation or reflection, ``points @ frame``."""
        known = {name: getattr(self, name) for name in ON_SPHERE}
        return self.with_arrays({name: points @ frame for name, points in known.items() if points is not None})

    @property
    def maps(self) -> dict[str, Floats]:
        """The maps of the stages that were run, by name; ``sphere`` is the final one, or ``disk`` on the disk."""
        known = {name: getattr(self, name) for name in (*STAGES, "disk")}
        return {name: points for name, points in known.items() if points is not None}

    def distortion(self, stage: str = "sphere") -> Distortion:
        """Measure the distortion of the map, or of a stage: ``conformal``, ``moser``, ``transported`` or ``disk``.

        The stage ``disk`` is the map to the unit disk, where ``sphere`` is the one to the hemisphere. Areas are
        compared within each part, every part scaled to the area of its image, and all parts count alike; where parts
        lie side by side on one sphere, areas of all are compared, but for the stages before they were put there.

        Raises:
            OmtwarpError: the stage was not run.
        """
        points = self.maps.get(stage) if isinstance(stage, str) else None
        if points is None:
            raise OmtwarpError(f"this map has no stage '{stage}'")
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
            OmtwarpError: the map is to a hemisphere, a disk or a cap, or of several parts; or its arrays do not fit.

        Example:
            >>> import omtwarp
            >>> ball = omtwarp.shapes.icosphere(8)
            >>> result = omtwarp.map_surface((ball.vertices, ball.faces[1:]), domain="sphere", device="cpu")
            >>> result, result.closed()
            (MapResult(642 vertices, 1279 faces, omt, bijective), MapResult(643 vertices, 1282 faces, omt))
        """
        if self.part is not None:
            raise OmtwarpError("several parts do not cover one sphere: map each part by itself")
        if self.domain != Domain.SPHERE:
            words = f"a map to a {self.domain} does not cover the sphere: map the mesh with domain='sphere'"
            raise OmtwarpError(words)
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

    def stored_arrays(self) -> dict[str, NDArray]:
        """Return the arrays of the file that :meth:`save` writes, the domain and the report among them."""
        whole = self.domain == Domain.SPHERE and self.part is None and self.loops is None
        return super().stored_arrays() | ({} if whole else {"domain": np.array(self.domain)})

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray], path: str | os.PathLike[str]) -> Self:
        """Make a map from the arrays of a file, of which ``path`` is the name for messages.

        Raises:
            OmtwarpError: the arrays are not those of a map to the sphere or to a part of it.
        """
        if any(name in arrays for name in OF_TORUS_MAPS):
            raise OmtwarpError(f"'{path}' is a map to a torus, where one to the sphere is needed, as cut=True makes")
        result = super().from_arrays(arrays, path)
        result.report["certificate"] = result.certificate.to_dict()  # anew: a file's statements are not trusted
        return result


MapResult.layout = layout_of(MapResult)


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
