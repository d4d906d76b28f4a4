"""Maps put into the input's order: those of surfaces numbered in space, and those of parts, joined to one."""

from collections.abc import Mapping
from typing import cast

import numpy as np
from numpy.typing import NDArray

from omtwarp.maps.result import SEVERAL, MapReport, MapResult, layout_on
from omtwarp.mesh.arrays import Floats
from omtwarp.mesh.origins import Origins
from omtwarp.mesh.quarter import PARTS
from omtwarp.topology.kind import Part

PLACED = ("vertices", "sphere", "conformal")  # arrays at vertices that a filled surface has, too


def joined(maps: list[MapResult], vertex_count: int, caps: Mapping[str, Floats]) -> MapResult:
    """Join the maps of all parts, each on a sphere of its own; ``part`` says which part a face belongs to.

    The input's vertices and faces keep their order. Vertices that split edges, and copies made by cuts, follow.

    Args:
        maps: of the parts, with vertices and faces of origins in the input.
        vertex_count: of the input.
        caps: where parts lie side by side on one sphere, the arrays of their caps.
    """
    numbers, count = _numbers(maps, vertex_count)
    order = np.argsort(np.concatenate([part.arrays["face_origin"] for part in maps]), kind="stable")
    chosen = {"V": np.argsort(np.concatenate(numbers)), "F": order}
    rows: dict[str, NDArray] = {}
    for name, (_, (letter, *_)) in layout_on(maps[0].domain).items():
        values = [getattr(part, name) for part in maps]
        if letter in chosen and all(value is not None for value in values):
            rows[name] = np.concatenate(values)[chosen[str(letter)]]
    domains = sorted({part.domain for part in maps})
    report = _report(maps)
    arrays = rows | {
        "arrays": {},
        "faces": np.concatenate([number[part.faces] for number, part in zip(numbers, maps, strict=True)])[order],
        "split_edges": np.concatenate([n[part.arrays["split_edges"]] for n, part in zip(numbers, maps, strict=True)]),
        "part": np.repeat(np.arange(len(maps)), [len(part.faces) for part in maps])[order],
        **caps,
        **_filling(maps, numbers, count, rows),
        "domain": domains[0] if len(domains) == 1 else SEVERAL,
        "history": [],
        "report": report,
    }
    result = maps[0].with_arrays(arrays)
    report["stages"][0].update(result.distortion().to_dict())
    report["stages"][0]["transport_cost"] = 0.0
    report["certificate"] = result.certificate.to_dict()
    return result


def _numbers(maps: list[MapResult], count: int) -> tuple[list[NDArray], int]:
    """Return the numbers that the vertices of each part have in the whole, and the number of all vertices.

    The input's vertices come first, then new ones, as in each part.
    """
    numbers = []
    for part in maps:
        assert part.origins is not None
        known = np.flatnonzero(part.origins.places() >= 0)
        new = len(part.vertices) - len(known)
        numbers.append(np.r_[known, count + np.arange(new)])
        count += new
    return numbers, count


def _filling(
    maps: list[MapResult], numbers: list[NDArray], count: int, at_vertices: Mapping[str, NDArray]
) -> dict[str, NDArray]:
    """Join the arrays about filled loops; there are none where no loop was filled."""
    if all(part.loops is None for part in maps):
        return {}
    joint = {f"filled_{name}": [at_vertices[name]] for name in PLACED}
    joint["filled_faces"] = [number[part.faces] for part, number in zip(maps, numbers, strict=True)]
    joint["filled_loop"] = [np.full(len(part.faces), -1) for part in maps]
    entries = numbered = 0
    for part, number in zip(maps, numbers, strict=True):
        if part.loops is None:
            continue
        given, own, new = part.arrays, len(part.faces), len(part.arrays["filled_vertices"]) - len(number)
        rows = {f"filled_{name}": given[f"filled_{name}"][len(number) :] for name in PLACED} | {
            "filled_faces": np.concatenate([number, count + np.arange(new)])[given["filled_faces"][own:]],
            "filled_loop": given["filled_loop"][own:] + numbered,
            "loops": number[part.loops],
            "loop_ends": given["loop_ends"] + entries,
            "loop_pairs": given.get("loop_pairs", np.zeros((0, 2), dtype=np.int64)) + numbered,
        }
        for name, values in rows.items():
            joint.setdefault(name, []).append(values)
        count, entries, numbered = count + new, entries + len(part.loops), numbered + len(given["loop_ends"])
    return {name: np.concatenate(several) for name, several in joint.items() if any(map(len, several))}


def _report(maps: list[MapResult]) -> MapReport:
    """Join the reports of the parts to one with a certificate for all."""
    first: Mapping[str, object] = maps[0].report
    seconds = sum(part.report["seconds"] for part in maps)
    alike = ("versions", "device", "method", "cost", "scheme", "refine")
    of_all = {
        "mesh": {name: sum(part.report["mesh"][name] for part in maps) for name in ("vertices", "faces")},
        "seconds": seconds,
        "stages": [{"name": "parts", "seconds": seconds, "iterations": 0}],
        "warnings": [finding | {"part": k} for k, part in enumerate(maps) for finding in part.report["warnings"]],
        "parts": [part.report for part in maps],
    }
    return cast(MapReport, {name: first[name] for name in alike} | of_all)


def in_input_order(result: MapResult, given: Part, *, exact: bool) -> MapResult:
    """Put the map of a part that was numbered in space into the order of the input.

    Args:
        result: the map; its origins are numbers in the input.
        given: the part as it was before.
        exact: whether triangles were quartered.
    """
    assert result.origins is not None
    order, face_order, corners = _order(result.faces, result.origins, given, exact)
    place, count, own = np.argsort(order), len(result.vertices), len(result.faces)
    whole = np.r_[order, np.arange(count, len(result.arrays.get("filled_vertices", order)))]
    arrays = result.rows({"V": order, "F": face_order, "W": whole})
    turned = face_order[:, None], corners
    arrays["faces"] = place[result.faces[turned]].astype(np.int32)
    if "wraps" in result.arrays:
        arrays["wraps"] = result.wraps[turned]
    if result.split_edges is not None:
        arrays["split_edges"] = np.sort(place[result.split_edges], axis=1)
    if result.loops is not None:
        arrays["loops"] = place[result.loops]
        filling = np.argsort(whole)[result.arrays["filled_faces"][own:]]
        arrays["filled_faces"] = np.concatenate([arrays["faces"], filling])
    return result.with_arrays(arrays)


def _order(
    faces: NDArray, origins: Origins, given: Part, exact: bool
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Return the order of a map's vertices and faces in which those of the input lie as they do there.

    Args:
        faces: of the map, shape [F, 3], those of one face of the input after each other.
        origins: what its vertices and faces are in the input.
        given: the part in the order of the input.
        exact: whether triangles were quartered, see :class:`omtwarp.mesh.quarter.QuarteredSurface`.

    Returns:
        By their present numbers, the vertices, shape [V]; the faces, shape [F]; and of every face in its new place,
        the corners, shape [F, 3].
    """
    first, parts = origins.places(), PARTS if exact else 1
    first = first[first >= 0]
    vertices = np.r_[first, np.setdiff1d(np.arange(len(origins.vertex_origin)), first)]
    groups = origins.face_origin.reshape(-1, parts)[:, 0]
    along = np.argsort(groups, kind="stable")
    # The corner of the input's face at which a triangle begins; 0 for pieces of split ones that begin at a new vertex.
    corners = given.vertex_origin[given.faces[np.searchsorted(given.face_origin, groups[along])]]
    begins = origins.vertex_origin[faces.reshape(-1, parts, 3)[along, 0, 0]]
    back = (np.arange(3) - (corners == begins[:, None]).argmax(axis=1)[:, None]) % 3
    if not exact:
        return vertices, along, back
    # A part at a corner goes to another corner's place as it is; the middle one is turned.
    middle = np.full((len(along), 1), PARTS - 1)
    rows = (PARTS * along)[:, None] + np.concatenate([back, middle], axis=1)
    turned = np.broadcast_to(np.arange(3), (len(along), PARTS, 3)).copy()
    turned[:, PARTS - 1] = back
    return vertices, rows.ravel(), turned.reshape(-1, 3)
