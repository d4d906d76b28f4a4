"""A finished map, the record of its stages, and its file."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import NotRequired, TypedDict, cast

import numpy as np
from numpy.typing import NDArray

from omtwarp.errors import OmtwarpError
from omtwarp.files.inputs import open_input, read_arrays, write_arrays
from omtwarp.files.limits import LARGEST_MESH_FILE
from omtwarp.files.output import as_path
from omtwarp.maps.display import Shown
from omtwarp.mesh.arrays import fitting_arrays, owned, real_numbers, require_unit_length, whole_numbers
from omtwarp.metrics.certificate import Certificate, certify_triangles
from omtwarp.metrics.distortion import Distortion, measure_triangles
from omtwarp.options import ChosenOptions, Record

Array = NDArray[np.float64]

# What an .npz of a map holds. The first five are always there; the others where their stage was run.
REQUIRED = ("vertices", "faces", "sphere", "conformal", "density")
# Type and shape of every array, with V vertices and F faces.
LAYOUT: dict[str, tuple[type[np.generic], tuple[str | int, ...]]] = {
    "vertices": (np.float64, ("V", 3)),
    "faces": (np.int32, ("F", 3)),
    "sphere": (np.float64, ("V", 3)),
    "conformal": (np.float64, ("V", 3)),
    "density": (np.float64, ("V",)),
    "face_density": (np.float64, ("F",)),
    "source": (np.float64, ("V", 3)),
    "moser": (np.float64, ("V", 3)),
    "transported": (np.float64, ("V", 3)),
    "measure": (np.float64, ("F",)),
    "target": (np.float64, ("V",)),
    "vertex_origin": (np.int64, ("V",)),
    "face_origin": (np.int64, ("F",)),
    "vertex_of_file": (np.int64, ("N",)),
}
STAGES = ("sphere", "conformal", "moser", "transported")
OF_A_TORUS = "wraps"  # an array that only maps to a torus have
# Arrays that tell a map's file from a mesh's, even where one was lost, and a map to a torus from one to the sphere.
OF_MAPS = ("sphere", OF_A_TORUS, "conformal", "coordinates", "lattice")
OF_TORUS_MAPS = (OF_A_TORUS, "coordinates", "lattice")


class StageReport(TypedDict, total=False):
    """A stage in a report: a :class:`StageRecord` as plain values, and the stage's details."""

    name: str
    seconds: float
    iterations: int
    flips: int
    degree: float
    finite: bool
    area: dict[str, float]
    angle: dict[str, float]
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
    """The size of a mesh: its numbers of vertices and faces, and the sides of its bounding box."""

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


class _Arrays(TypedDict):
    """The arrays of a map, in the types of ``LAYOUT``."""

    vertices: Array
    faces: NDArray[np.int32]
    sphere: Array
    conformal: Array
    density: Array
    face_density: NotRequired[Array]
    source: NotRequired[Array]
    moser: NotRequired[Array]
    transported: NotRequired[Array]
    measure: NotRequired[Array]
    target: NotRequired[Array]
    vertex_origin: NotRequired[NDArray[np.int64]]
    face_origin: NotRequired[NDArray[np.int64]]
    vertex_of_file: NotRequired[NDArray[np.int64]]


@dataclass(frozen=True)
class StageRecord:
    """The record of a stage: its time, its history and the quality of its map.

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
        details: further results of this stage, ready for JSON: ``repaired``, ``converged``, ...
    """

    name: str
    seconds: float
    iterations: int
    flips: int
    degree: float
    finite: bool
    area: Mapping[str, float]
    angle: Mapping[str, float]
    transport_cost: float
    details: Mapping[str, str | float | None] = field(default_factory=dict)

    def to_dict(self) -> StageReport:
        """Convert the record, with its details, to plain values ready for JSON."""
        plain = {name: value for name, value in vars(self).items() if name != "details"}
        whole = plain | {"area": dict(self.area), "angle": dict(self.angle)} | dict(self.details)
        return cast(StageReport, whole)


@dataclass(frozen=True, eq=False, repr=False)
class MapResult(Shown):
    """A surface and its map to the unit sphere, in the order of the input.

    The arrays belong to the result: they are copies, and cannot be written to.

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
        vertex_origin: after a repair, quartering or the splitting of long edges, the index of every vertex in the mesh
            before it, -1 for new ones; int64 [V].
        face_origin: the same of the faces, int64 [F].
        vertex_of_file: the vertex that each vertex of the file was, where the file held copies along the seams of a
            texture and the command line joined them; int64, shape [N].
        history: one record per iteration of the transport flow: ``iteration``, ``cost``, ``curl``, ...
        report: how the map was made, ready for JSON.

    Example:
        >>> import numpy as np, omtwarp
        >>> result = omtwarp.map_to_sphere(omtwarp.shapes.blob(seed=3, sphere=320), until="moser", device="cpu")
        >>> _ = result.save("blob.npz")
        >>> bool(np.array_equal(omtwarp.MapResult.load("blob.npz").sphere, result.sphere))
        True
    """

    vertices: Array
    faces: NDArray[np.int32]
    sphere: Array
    conformal: Array
    density: Array
    face_density: Array | None = None
    source: Array | None = None
    moser: Array | None = None
    transported: Array | None = None
    measure: Array | None = None
    target: Array | None = None
    vertex_origin: NDArray[np.int64] | None = None
    face_origin: NDArray[np.int64] | None = None
    vertex_of_file: NDArray[np.int64] | None = None
    history: list[Record] = field(default_factory=list)
    report: MapReport = field(default_factory=lambda: cast(MapReport, {}))

    def __post_init__(self) -> None:
        for name, value in _fitting(vars(self)).items():
            object.__setattr__(self, name, owned(value, LAYOUT[name][0]))

    def __repr__(self) -> str:
        known = [f"{len(self.vertices)} vertices", f"{len(self.faces)} faces"]
        if "method" in self.report:
            known.append(str(self.report["method"]))
        if "certificate" in vars(self) and self.bijective:  # nothing is measured for a line of text
            known.append("bijective")
        return f"MapResult({', '.join(known)})"

    def distortion(self, stage: str = "sphere") -> Distortion:
        """Measure the distortion of the final map, or of a stage: ``conformal``, ``moser`` or ``transported``.

        Raises:
            OmtwarpError: the stage was not run.
        """
        points = getattr(self, stage, None) if isinstance(stage, str) and stage in STAGES else None
        if points is None:
            raise OmtwarpError(f"this map has no stage '{stage}'")
        return measure_triangles(self.vertices, self.faces, points)

    def closed(self) -> MapResult:
        """Return the map of the closed surface, which covers the sphere: this map, or the one with holes filled.

        Raises:
            OmtwarpError: a :class:`~omtwarp.SurfaceMap` covers a part of the sphere only, or several spheres.
        """
        return self

    @cached_property
    def certificate(self) -> Certificate:
        """The certificate of the final map, computed from its arrays at the first use."""
        return certify_triangles(self.faces, self.sphere)

    @property
    def bijective(self) -> bool:
        """Whether the final map is one to one and onto: see :attr:`certificate`."""
        return self.certificate.bijective

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the map as ``.npz``: arrays of the attributes' names, and the report as JSON text under ``report``.

        Raises:
            OmtwarpError: the file cannot be written; nothing is left of it.
        """
        write_arrays(path, self._stored_arrays())

    def _stored_arrays(self) -> dict[str, NDArray]:
        """Return the arrays of the file that :meth:`save` writes, the report among them, by their names there."""
        arrays = {name: getattr(self, name) for name in LAYOUT if getattr(self, name) is not None}
        return arrays | {"report": np.array(json.dumps(self.report | {"history": self.history}))}

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> MapResult:
        """Read a map written by :meth:`save`.

        Raises:
            OmtwarpError: the file is missing, or is no map.
        """
        source = as_path(path)
        arrays = _read_arrays(source)
        report, history = _read_report(arrays)
        try:
            result = cls(**_fitting(arrays), history=history, report=report)
        except OmtwarpError as error:
            raise OmtwarpError(f"'{source}' is not a map: {error}") from None
        # The certificate is computed anew: a file's statements are not trusted.
        report["certificate"] = result.certificate.to_dict()
        return result


def renumbered(result: MapResult, numbers: Mapping[str, NDArray[np.int64]], arrays: Mapping[str, NDArray]) -> MapResult:
    """Return the same map for vertices and faces that are numbered in another way.

    Args:
        result: a map of V vertices and F faces.
        numbers: the new numbers of vertices and faces, under ``V`` and ``F``, of those lengths.
        arrays: arrays of the new map, by name, that hold numbers of vertices or faces: at least ``faces``.
    """
    found: dict[str, object] = {}
    for name, (_, (letter, *_)) in LAYOUT.items():
        values = getattr(result, name)
        if values is not None and letter in numbers and name not in arrays:
            placed = np.empty_like(values)
            placed[numbers[str(letter)]] = values
            found[name] = placed
    return MapResult(**_fitting(found | dict(arrays)), history=result.history, report=result.report)


def _read_arrays(source: Path) -> dict[str, NDArray[np.generic]]:
    """Read the arrays of a map's file, and check them."""
    with open_input(source, LARGEST_MESH_FILE, "map") as stream:
        try:
            arrays = read_arrays(stream, (*LAYOUT, "report", OF_A_TORUS))
        except OmtwarpError as error:
            words = f"'{source}' is not a map: {error}; make one with 'omtwarp map MESH -o MAP.npz'"
            raise OmtwarpError(words) from None
    if arrays.pop(OF_A_TORUS, None) is not None:
        raise OmtwarpError(f"'{source}' is a map to a torus, where one to the sphere is needed, as --cut makes")
    return arrays


def _fitting(arrays: Mapping[str, object]) -> _Arrays:
    """Convert the arrays of a map to their types; missing ones are left out.

    Raises:
        OmtwarpError: an array is missing, not of numbers, out of range, or does not fit the others; the first is named.
    """
    missing = [name for name in REQUIRED if arrays.get(name) is None]
    if missing:
        raise OmtwarpError(f"it has no '{missing[0]}'")
    vertices = real_numbers(arrays["vertices"], "'vertices'", (None, 3))
    faces = whole_numbers(arrays["faces"], "'faces'", (None, 3), below=len(vertices))
    fitting = fitting_arrays(arrays, LAYOUT, {"V": len(vertices), "F": len(faces)})
    for name in (*STAGES, "source"):
        if name in fitting:
            require_unit_length(fitting[name], f"'{name}'")
    return cast(_Arrays, fitting)


def _read_report(arrays: Mapping[str, NDArray[np.generic]]) -> tuple[MapReport, list[Record]]:
    """Read the report and the history of a map's file; each is empty where it is missing or malformed."""
    try:
        report = json.loads(str(arrays["report"])) if "report" in arrays else {}
    except (ValueError, RecursionError):
        report = {}
    report = report if isinstance(report, dict) else {}
    history = report.pop("history", [])
    entries = history if isinstance(history, list) else []
    return cast(MapReport, report), [entry for entry in entries if isinstance(entry, dict)]
