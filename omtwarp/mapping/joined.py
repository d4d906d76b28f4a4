"""Joining of the maps of a surface's parts to one map in the input's order."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypedDict

import numpy as np
from numpy.typing import NDArray

from omtwarp.maps.result import MapReport
from omtwarp.maps.surface_map import SEVERAL, SurfaceMap

Floats = NDArray[np.float64]


def joined(
    maps: list[SurfaceMap], vertex_count: int, caps: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None
) -> SurfaceMap:
    """Join the maps of all parts, each on a sphere of its own; ``part`` says which part a face belongs to.

    The input's vertices and faces keep their order. Vertices that split edges, and copies made by cuts, follow.
    One function, as every array of the whole follows from the same numbering.

    Args:
        maps: of the parts, with vertices and faces of origins in the input.
        vertex_count: of the input.
        caps: where parts lie side by side on one sphere, centres and shares of their caps.
    """
    numbers, count = _numbers(maps, vertex_count)
    split = [number[_known(part.split_edges)] for number, part in zip(numbers, maps, strict=True)]
    faces = np.concatenate([number[part.faces] for number, part in zip(numbers, maps, strict=True)])
    face_origin = np.concatenate([_known(part.face_origin) for part in maps])
    order = np.argsort(face_origin, kind="stable")
    labels = np.repeat(np.arange(len(maps)), [len(part.faces) for part in maps])
    place = np.concatenate(numbers)

    def at_vertices(values: list[Floats]) -> Floats:
        stacked = np.concatenate(values)
        out = np.zeros((count, *stacked.shape[1:]), dtype=stacked.dtype)
        out[place] = stacked
        return out

    def where_all_have(values: list[Floats | None]) -> Floats | None:
        known = [value for value in values if value is not None]
        return at_vertices(known) if len(known) == len(maps) else None

    vertex_origin = np.full(count, -1, dtype=np.int64)
    vertex_origin[place] = np.concatenate([_known(part.vertex_origin) for part in maps])
    densities = [part.face_density for part in maps]
    measures = [part.measure for part in maps if part.measure is not None]
    domains = sorted({part.domain for part in maps})
    report = _report(maps)
    result = SurfaceMap(
        vertices=at_vertices([part.vertices for part in maps]),
        sphere=at_vertices([part.sphere for part in maps]),
        conformal=at_vertices([part.conformal for part in maps]),
        density=at_vertices([part.density for part in maps]),
        source=where_all_have([part.source for part in maps]),
        moser=where_all_have([part.moser for part in maps]),
        transported=where_all_have([part.transported for part in maps]),
        disk=where_all_have([part.disk for part in maps]),
        faces=faces[order].astype(np.int32),
        face_density=None if any(d is None for d in densities) else np.concatenate(densities)[order],  # type: ignore[arg-type]
        measure=np.concatenate(measures)[order] if len(measures) == len(maps) else None,
        report=report,
        domain=domains[0] if len(domains) == 1 else SEVERAL,
        vertex_origin=vertex_origin,
        face_origin=face_origin[order],
        split_edges=np.concatenate(split),
        part=labels[order],
        cap_centres=None if caps is None else caps[0],
        cap_shares=None if caps is None else caps[1],
        **_filling(maps, numbers, count, at_vertices),
    )
    report["stages"][0].update(result.distortion().to_dict())
    report["stages"][0]["transport_cost"] = 0.0
    report["certificate"] = result.certificate.to_dict()
    return result


def _numbers(maps: list[SurfaceMap], count: int) -> tuple[list[NDArray], int]:
    """Return the numbers that the vertices of each part have in the whole, and the number of all vertices.

    The input's vertices come first, then new ones.
    """
    numbers = []
    for part in maps:
        origin = _known(part.vertex_origin)
        first = np.zeros(len(origin), dtype=bool)
        given = np.flatnonzero(origin >= 0)
        first[given[np.unique(origin[given], return_index=True)[1]]] = True
        number = np.where(first, origin, -1)
        number[~first] = count + np.arange(int((~first).sum()))
        count += int((~first).sum())
        numbers.append(number)
    return numbers, count


def _known(values: NDArray | None) -> NDArray:
    assert values is not None
    return values


class _Filling(TypedDict, total=False):
    """The arrays of a :class:`SurfaceMap` about filled loops."""

    loops: NDArray[np.int64]
    loop_ends: NDArray[np.int64]
    loop_pairs: NDArray[np.int64] | None
    filled_vertices: Floats
    filled_sphere: Floats
    filled_conformal: Floats
    filled_faces: NDArray[np.int64]
    filled_loop: NDArray[np.int64]


def _filling(
    maps: list[SurfaceMap], numbers: list[NDArray], count: int, at_vertices: Callable[[list[Floats]], Floats]
) -> _Filling:
    """Join the arrays about filled loops; there are none where no loop was filled."""
    if all(part.loops is None for part in maps):
        return {}
    loops, ends, pairs, points, images, starts, faces, marks = [], [], [], [], [], [], [], []
    entries = numbered = 0
    for part, number in zip(maps, numbers, strict=True):
        own = len(part.vertices)
        if part.loops is None or part.filled_faces is None:
            faces.append(number[part.faces])
            marks.append(np.full(len(part.faces), -1))
            continue
        new = len(_known(part.filled_vertices)) - own
        place = np.concatenate([number, count + np.arange(new)])
        count += new
        points.append(_known(part.filled_vertices)[own:])
        images.append(_known(part.filled_sphere)[own:])
        starts.append(_known(part.filled_conformal)[own:])
        faces.append(place[part.filled_faces])
        marks.append(np.where(_known(part.filled_loop) >= 0, _known(part.filled_loop) + numbered, -1))
        loops.append(number[part.loops])
        ends.append(_known(part.loop_ends) + entries)
        if part.loop_pairs is not None:
            pairs.append(part.loop_pairs + numbered)
        entries += len(part.loops)
        numbered += len(_known(part.loop_ends))
    filled = np.concatenate(marks)
    order = np.argsort(filled >= 0, kind="stable")
    return {
        "loops": np.concatenate(loops),
        "loop_ends": np.concatenate(ends),
        "loop_pairs": np.concatenate(pairs) if pairs else None,
        "filled_vertices": np.concatenate([at_vertices([part.vertices for part in maps]), *points]),
        "filled_sphere": np.concatenate([at_vertices([part.sphere for part in maps]), *images]),
        "filled_conformal": np.concatenate([at_vertices([part.conformal for part in maps]), *starts]),
        "filled_faces": np.concatenate(faces)[order],
        "filled_loop": filled[order],
    }


def _report(maps: list[SurfaceMap]) -> MapReport:
    """Join the reports of the parts to one with a certificate for all."""
    first = maps[0].report
    seconds = sum(part.report["seconds"] for part in maps)
    return {
        "versions": first["versions"],
        "device": first["device"],
        "method": first["method"],
        "cost": first["cost"],
        "scheme": first["scheme"],
        "refine": first["refine"],
        "mesh": {
            "vertices": sum(part.report["mesh"]["vertices"] for part in maps),
            "faces": sum(part.report["mesh"]["faces"] for part in maps),
        },
        "seconds": seconds,
        "stages": [{"name": "parts", "seconds": seconds, "iterations": 0}],
        "warnings": [finding | {"part": k} for k, part in enumerate(maps) for finding in part.report["warnings"]],
        "parts": [part.report for part in maps],
    }
