"""Registration of one subject's surfaces in the order of time: correspondences that do not drift, and growth."""

from __future__ import annotations

import os
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from omtwarp.errors import OmtwarpError, OmtwarpWarning
from omtwarp.files.inputs import write_arrays
from omtwarp.files.output import as_path, folder_of_results
from omtwarp.location import Locator
from omtwarp.maps.result import MapResult
from omtwarp.mesh.arrays import Floats, norms
from omtwarp.mesh.data import VertexData, write_data
from omtwarp.mesh.surface import Surface
from omtwarp.metrics.certificate import certify_triangles
from omtwarp.options import MAX_STRAIN, STIFFNESS, Progress, tell
from omtwarp.registration.folding import LEAST_AREA, vertex_areas
from omtwarp.registration.group import STEPS, Files, Kept, Member, Options, key_of, members, write_facts
from omtwarp.registration.register import Registration, area_penalty, register, within_bounds
from omtwarp.registration.sides import Side
from omtwarp.registration.strain import area_changes, octaves, strain_at_vertices
from omtwarp.resampling import SpherePoints, as_points

MEASURES = ("area", "stretch")


@dataclass(frozen=True, eq=False)
class SequenceRegistration:
    """Surfaces in the order of time, registered to the first.

    Attributes:
        names: of the T maps.
        area: log2 of the ratio of the surface's area there and on the first surface, at the first's V vertices, shape
            [T, V]; 0 for the first.
        stretch: log2 of the ratio of the larger to the smaller stretch of the surface since the first, shape [T, V].
        table: for every map but the first by its name its registration's :meth:`Registration.facts`, ``drift``, how far
            its registration to the first is from that to the one before, root mean square in degrees, and ``edge``, the
            mean length of its edges on the sphere in degrees.
    """

    names: tuple[str, ...]
    area: Floats
    stretch: Floats
    table: dict[str, dict[str, float]]


def register_sequence(
    maps: Sequence[str | os.PathLike[str]],
    folder: str | os.PathLike[str],
    *,
    features: Mapping[str, Files] | None = None,
    stiffness: float = STIFFNESS,
    max_strain: float = MAX_STRAIN,
    keep_areas: float | str = 0.0,
    progress: Progress | None = None,
) -> SequenceRegistration:
    """Register maps of one subject's surfaces in the order of time, and measure how the surface changes.

    Each map is registered to the one before, which it resembles most, and from there to the first, so that errors do
    not add up; the way between the two is the ``drift``. What is done is kept: an interrupted run goes on where it was.

    Args:
        maps: files of maps with their surfaces, of different names, in the order of time; their meshes may differ.
        folder: gets every map registered, under its own name, the first as it is; ``strain.npz`` with ``area``,
            ``stretch`` and ``names``, where nibabel is installed also ``area.shape.gii`` and ``stretch.shape.gii``, and
            ``table.csv``.
        features: by name, a file of data at the vertices for every map, in their order; they take the place of the
            folds.
        stiffness, max_strain, keep_areas: as of :func:`omtwarp.register`, for both warps together.
        progress: called as ``progress("sequence", step, steps, {})`` after every map.

    Returns:
        The strains of the surface, and how well every map was registered.

    Raises:
        OmtwarpError: fewer than two maps, two of one name, a file that is no map with a surface, or a folder that
            cannot be written.

    Warns:
        OmtwarpWarning: a map drifted by more than an edge: correspondences with the first are less certain than that.
    """
    files = members(maps, features, folder, "strain")
    options: dict[str, object] = {"stiffness": stiffness, "max_strain": max_strain, "keep_areas": keep_areas}
    (first_name, start), *others = files.items()
    first = MapResult.load(start.path)
    if as_points(first).vertices is None:
        raise OmtwarpError(f"'{start.path}' has no surface that could change")
    target = as_path(folder)
    results = ("strain.npz", "table.csv", *(f"{name}.shape.gii" for name in MEASURES))
    table: dict[str, dict[str, float]] = {}
    strains = [{name: np.zeros(len(first.vertices)) for name in MEASURES}]
    with folder_of_results(target, *results, *(f"{name}.npz" for name in files)), folder_of_results(target / STEPS):
        kept = Kept(target / STEPS)
        before, key = replace(start, path=target / f"{first_name}.npz"), key_of(start.digest, options)
        first.save(before.path)
        for done, (name, one) in enumerate(others, 1):
            key, output = key_of(key, one.digest), target / f"{name}.npz"
            step = kept.result(str(done), key, partial(_step, one, before, start, options, output), output)
            strains.append({measure: step.pop(measure) for measure in MEASURES})
            table[name] = {what: float(value) for what, value in step.items()}
            _warn_of_drift(name, table[name])
            before = replace(one, path=output)
            tell(progress, "sequence", done, len(others), {})
        area, stretch = (np.stack([one[measure] for one in strains]) for measure in MEASURES)
        sequence = SequenceRegistration(tuple(files), area, stretch, table)
        _write(sequence, target, first)
        kept.remove()
    return sequence


def _step(one: Member, before: Member, first: Member, options: Options, output: Path) -> dict[str, float | Floats]:
    """Register a map to the one before and then to the first, and write it; return facts, and the surface's strains."""
    side, start = one.side(), first.side()
    here = side.points

    def registered(points: SpherePoints, to: Side) -> Registration:
        given = {"features": side.own, "to_features": to.own, "feature_weights": one.weights}
        return register(points, to.points, **given, **options)  # type: ignore[arg-type]

    chained = registered(here, before.side())
    registration = registered(here.moved(chained.closed_sphere), start)
    joined = _joined(here, chained, registration, options["keep_areas"])
    joined.registered(MapResult.load(one.path)).save(output)
    ends = here.grid.points[here.grid.own_triangles]
    edges = norms(ends - np.roll(ends, 1, axis=1))
    way = norms(joined.sphere - chained.sphere @ registration.start.rotation.T)
    facts = {"drift": np.degrees(np.sqrt((way**2).mean())), "edge": np.degrees(edges.mean())}
    return {**joined.facts(), **facts, **growth(start.points, here.moved(joined.closed_sphere))}


def _joined(here: SpherePoints, chained: Registration, registration: Registration, keep_areas: object) -> Registration:
    """Return two registrations, one after the other, as one within the bound of strain."""
    rotation = registration.start.rotation @ chained.start.rotation
    turned, faces, own = here.grid.points @ rotation.T, here.grid.own_triangles, here.grid.own_points
    surface = Surface(turned, here.grid.triangles)
    sphere = within_bounds(surface, registration.closed_sphere, registration.most_strain, area_penalty(keep_areas))
    by_area, by_stretch = octaves(turned, sphere, faces)
    start = replace(chained.start, rotation=rotation, sphere=turned[:own])
    return replace(
        registration, sphere=sphere[:own], closed_sphere=sphere, start=start,
        doubtful=chained.doubtful, starts=chained.starts, area_strain=by_area, stretch_strain=by_stretch,
        area_changes=area_changes(turned, sphere, surface.faces),
        certificate=certify_triangles(here.grid.triangles, sphere, device="cpu"),
    )  # fmt: skip


def growth(first: SpherePoints, later: SpherePoints) -> dict[str, Floats]:
    """Return log2 of the ratios of areas and of stretches of a surface since the first, at the first's own vertices.

    Areas are those around vertices over their areas on the sphere: positions that are interpolated in another mesh
    would cut corners, and lose area.

    Args:
        first, later: registered surfaces, whose points are at the same place of the sphere.
    """
    faces, own = first.grid.triangles, first.grid.own_points
    place = Locator(later.grid.points, later.grid.triangles, device="cpu").find(first.grid.points)
    corners, (here, there) = later.grid.triangles[place.faces], map(_positions, (first, later))
    moved = np.einsum("vk,vkd->vd", place.coordinates, there[corners])
    stretch = strain_at_vertices(here, faces, octaves(here, moved, faces)[1])
    area = np.einsum("vk,vk->v", place.coordinates, _density(later)[corners]) - _density(first)
    return dict(zip(MEASURES, (area[:own], stretch[:own]), strict=True))


def _positions(points: SpherePoints) -> Floats:
    """Return the vertices of a surface, which is there."""
    assert points.vertices is not None
    return points.vertices


def _density(points: SpherePoints) -> Floats:
    """Return log2 of the areas around the vertices of a surface over those on its sphere, shape [N]."""
    ends = (vertex_areas(place, points.grid.triangles) for place in (_positions(points), points.grid.points))
    surface, sphere = (np.maximum(areas, LEAST_AREA * areas.mean()) for areas in ends)
    return np.asarray(np.log2(surface / sphere))


def _warn_of_drift(name: str, facts: Mapping[str, float]) -> None:
    """Warn of a map whose registrations to the one before and to the first are further apart than its triangles."""
    if facts["drift"] > facts["edge"]:
        words = f"'{name}' drifted by {facts['drift']:.1f} degrees, and its edges are {facts['edge']:.1f}"
        warnings.warn(f"{words}: give surfaces in between, or less stiffness", OmtwarpWarning, stacklevel=3)


def _write(sequence: SequenceRegistration, folder: Path, first: MapResult) -> None:
    """Write the strains and the table."""
    strains = {"area": sequence.area, "stretch": sequence.stretch}
    write_arrays(folder / "strain.npz", {**strains, "names": np.array(sequence.names)})
    structure = first.report.get("structure")
    for name, values in strains.items() if find_spec("nibabel") is not None else ():
        write_data(folder / f"{name}.shape.gii", VertexData(values.T, sequence.names, structure=structure))
    write_facts(folder / "table.csv", sequence.table)
