"""Maps of any surface to its natural domain: a sphere, hemisphere, disk or cap, a torus, or one for each part."""

from __future__ import annotations

import re
import warnings
from contextlib import suppress
from dataclasses import dataclass, replace
from math import fsum
from time import perf_counter
from typing import Unpack

import numpy as np
from numpy.typing import ArrayLike, NDArray

from omtwarp.errors import OmtwarpError, OmtwarpWarning
from omtwarp.geometry.space_order import in_space_order
from omtwarp.geometry.sphere_hierarchy import triangle_solid_angles
from omtwarp.mapping.joined import in_input_order, joined
from omtwarp.mapping.pipeline import map_closed, map_to_sphere
from omtwarp.mapping.verdict import accepted, judge
from omtwarp.maps.result import MapResult, MeshReport, StageReport, SurfaceReport, origin_arrays
from omtwarp.measures import face_weights, kept_mass
from omtwarp.mesh.arrays import Floats, edge_keys, normalised
from omtwarp.mesh.origins import Derived, Origins
from omtwarp.mesh.quarter import PARTS, quarter
from omtwarp.mesh.surface import SPHERE_AREA, MeshLike, Surface, triangle_areas
from omtwarp.mesh.validate import as_arrays, mesh_arrays, signed_volume
from omtwarp.metrics.distortion import measure_triangles
from omtwarp.open_surfaces import held
from omtwarp.open_surfaces.caps import disk_to_cap, hemisphere_to_disk, pack_caps
from omtwarp.open_surfaces.hemisphere import is_symmetric, mirror_frame, symmetric_map
from omtwarp.optimal.refinement import refinement_weight
from omtwarp.options import (
    AreaMatch,
    CutAlong,
    CutAlongLike,
    Domain,
    DomainLike,
    FillArea,
    FillAreaLike,
    MapKeywords,
    MapOptions,
    Progress,
    Stage,
    WeightsAt,
    WeightsAtLike,
    choose,
    takes_map_options,
)
from omtwarp.texturing.density import TargetLike
from omtwarp.topology.closing import Double, FilledSurface, double, fill_holes, quartered_double, split_chords
from omtwarp.topology.handles import cut_handles, cut_open, slit_open
from omtwarp.topology.kind import (
    Part,
    boundary_half_edges,
    boundary_loops,
    loop_length,
    options_for,
    parts_of,
    places_of,
)
from omtwarp.torus.mapping import map_to_torus


@takes_map_options
def map_surface(
    mesh: MeshLike,
    *,
    domain: DomainLike = Domain.AUTO,
    fill_area: FillAreaLike = FillArea.NATURAL,
    components: bool = True,
    together: bool = False,
    cut: bool = True,
    cut_along: CutAlongLike = CutAlong.AUTO,
    progress: Progress | None = None,
    weights: ArrayLike | None = None,
    weights_at: WeightsAtLike = WeightsAt.AUTO,
    target: TargetLike | None = None,
    **options: Unpack[MapKeywords],
) -> MapResult:
    """Map a surface with holes, with handles, or of several parts, to its natural domain.

    A closed surface of genus 0 goes to the sphere, as by :func:`omtwarp.map_to_sphere`; one with a single boundary loop
    to the hemisphere, the boundary on the equator; one with several holes to the sphere, the holes filled. A closed
    surface of genus 1 goes to a flat torus; other handles are cut open. Each part of a surface is mapped by itself, to
    a domain of its own.

    The map to the hemisphere is half of the map of the surface glued to its mirror copy along the boundary. Its
    boundary lies on the equator to the last bit, and no triangle is flipped.

    Args:
        mesh: a ``trimesh.Trimesh``, ``(vertices, faces)`` with shapes [V, 3] and [F, 3], or a :class:`omtwarp.Surface`;
            any unit, any position. Faces agree in their orientation.
        domain: ``auto`` for the choice above; ``sphere``, holes filled; ``hemisphere``, the longest boundary loop on
            the equator and other holes filled; ``disk``, the hemisphere laid flat by Lambert's equal-area projection;
            ``torus``, the flat torus that a surface of genus 1 is conformal to;
            ``cap``, a spherical cap of the area that the longest hole, filled, leaves.
        fill_area: of filled holes on the sphere: ``natural`` (where left out), that of a minimal surface in the hole;
            ``small``, at most a hundredth of the surface's area.
        components: whether a surface of several parts is taken, each mapped by itself.
        together: whether all parts lie side by side on one sphere, each on a spherical cap of its own, with areas in
            proportion to those of the parts; closed parts are slit open. ``domain`` is then left at ``auto``.
        cut: whether a surface with handles is cut along a loop for each, and both sides filled small.
        cut_along: ``handles``, the shortest loops around them; ``holes``, along them through the holes that they make,
            which closes these; ``auto``, those of either kind that leave thicker limbs.
        progress: called as ``progress(stage, done, total, details)``.
        weights: of vertices or triangles, see :func:`omtwarp.map_to_sphere`; not for a torus.
        weights_at: what they belong to, as there.
        target: the density on the sphere, see :func:`omtwarp.map_to_sphere`; for closed, connected surfaces of genus 0.
        options: those of :class:`omtwarp.options.MapOptions`.

    Returns:
        The map, whose ``domain`` says where it goes.

    Raises:
        OmtwarpError: the mesh has other defects, or is not of the kind that the domain takes.

    >>> import omtwarp
    >>> ball = omtwarp.shapes.icosphere(8)
    >>> bowl = ball.faces[ball.vertices[ball.faces, 2].max(axis=1) < 0.5]
    >>> used, faces = __import__("numpy").unique(bowl, return_inverse=True)
    >>> result = omtwarp.map_surface((ball.vertices[used], faces.reshape(-1, 3)), device="cpu")
    >>> result.domain, result.distortion().flips, bool(result.sphere[:, 2].min() >= 0.0)
    ('hemisphere', 0, True)
    """
    domain, fill_area = choose(Domain, domain), choose(FillArea, fill_area)
    chosen = MapOptions.parse(**options)
    loops = choose(CutAlong, cut_along)
    along = loops if cut else None
    vertices, faces = as_arrays(*mesh_arrays(mesh))
    parts, of_file = parts_of(vertices, faces), mesh.origins if isinstance(mesh, Surface) else None
    count = len(vertices)
    together = together and len(parts) > 1
    if len(parts) == 1 and parts[0].is_sphere and domain in ("auto", "sphere"):
        return map_to_sphere(
            mesh, weights=weights, weights_at=weights_at, target=target, progress=progress, **vars(chosen)
        )
    if target is not None:
        raise OmtwarpError("a target density is for closed, connected surfaces of genus 0")
    if len(parts) == 1 and parts[0].is_torus and domain in (Domain.AUTO, Domain.TORUS):
        if weights is not None:
            raise OmtwarpError("weights are for the sphere, the hemisphere, the disk and the cap: not for the torus")
        return in_file(_on_torus(parts[0], progress, chosen), of_file, count)
    _check_domain(domain, parts, components, together, along)
    shares = None if weights is None else face_weights(weights, faces, count, weights_at)
    given, parts = parts, [part.numbered_in_space() for part in parts]
    if together:
        parts, domain = [_slit(part) for part in parts], Domain.HEMISPHERE
    maps = [_map_part(part, domain, fill_area, along, progress, chosen, shares, of_file) for part in parts]
    caps: dict[str, Floats] = {}
    if together:
        maps, caps = _side_by_side(parts, maps, shares, chosen.exact)
    maps = _finished(maps, given, chosen.exact)
    return in_file(maps[0] if len(maps) == 1 else joined(maps, count, caps), of_file, count)


def in_file(result: MapResult, of_file: Origins | None, count: int) -> MapResult:
    """Return a map with origins in the file that the surface was made from, and the number of the file's vertices.

    Args:
        result: the map of the surface.
        of_file: what the surface's vertices and faces are in the file; None where they are its own.
        count: of the surface's vertices, which is that of the file's where it is not in ``of_file``.
    """
    if of_file is not None:
        made = of_file.compose(result.origins or Origins(np.arange(len(result.vertices)), np.arange(len(result.faces))))
        result = result.with_arrays({"vertex_origin": made.vertex_origin, "face_origin": made.face_origin})
        count = of_file.given or count
    result.report["mesh"]["input_vertices"] = count
    return result


def _check_domain(domain: Domain, parts: list[Part], components: bool, together: bool, along: CutAlong | None) -> None:
    """Refuse parts that cannot be mapped to the domain; the surface is neither one sphere nor one torus.

    Raises:
        OmtwarpError: the parts cannot be mapped to the domain.
    """
    if together and domain != Domain.AUTO:
        raise OmtwarpError("parts side by side go to caps: ask for no other domain")
    several = len(parts) > 1
    if domain == Domain.TORUS:
        kind = f"{len(parts)} parts" if several else parts[0].words
        options = options_for(parts)
        others = _or(options[:2] if several else options) if options else "map it to the sphere"
        raise OmtwarpError(f"the surface has {kind}, and only one of genus 1, closed, maps to a torus: {others}")
    if several and not components:
        raise OmtwarpError(f"the surface has {len(parts)} parts: components=True maps each by itself")
    for number, part in enumerate(parts):
        which = f"part {number + 1} of {len(parts)}, at face {part.face_origin[0]}," if several else "the surface"
        if part.genus and along is None:
            torus = "domain='torus' or " if part.is_torus and not several else ""
            raise OmtwarpError(f"{which} has {part.words}: {torus}cut=True would map it")
        if domain != Domain.SPHERE and len(part.faces) == 1:
            raise OmtwarpError(f"{which} is a single triangle: domain='sphere' would map it, with the hole filled")
        if domain not in (Domain.AUTO, Domain.SPHERE) and not part.loops:
            raise OmtwarpError(
                f"{which} is closed, without a boundary to put on the rim of a {domain}: "
                + ("domain='sphere' maps all parts to spheres" if several else "map it to the sphere")
            )


def _finished(maps: list[MapResult], given: list[Part], exact: bool) -> list[MapResult]:
    """Put the maps of parts into the order of the input, and their certificates into their reports.

    The caller of :func:`map_surface` is warned of what they do not keep.

    Raises:
        OmtwarpError: a map is not one to one.
    """
    maps = [in_input_order(each, part, exact=exact) for each, part in zip(maps, given, strict=True)]
    for each in maps:
        each.report["certificate"] = each.certificate.to_dict()
        if not each.certificate.bijective:
            raise OmtwarpError(f"no map to the {each.domain} that is one to one was found: {each.certificate}")
    for finding in (finding for each in maps for finding in each.report["warnings"]):
        warnings.warn(finding["text"], OmtwarpWarning, stacklevel=3)
    return maps


def _slit(part: Part) -> Part:
    """Slit a closed part open along a path, as long as its handles can still be cut; return others unchanged."""
    slits = (1.0, 0.5, 0.25)  # of a path across a closed part that is slit open; loops around handles avoid it
    if part.loops:
        return part
    for share in slits:
        cut = slit_open(part.vertices, part.faces, share)
        with suppress(OmtwarpError):
            cut_handles(cut.vertices, cut.faces, part.genus)
            break
    return part.remade(cut.vertices, cut.faces, cut)


def _side_by_side(
    parts: list[Part], maps: list[MapResult], weights: Floats | None, exact: bool
) -> tuple[list[MapResult], dict[str, Floats]]:
    """Carry the maps of parts to disjoint caps, with areas in proportion to the parts' masses.

    The arrangement does not depend on the order of the parts.

    Args:
        parts: what is mapped.
        maps: of the parts, to the hemisphere.
        weights: of the input's faces; None where all are 1.
        exact: whether the maps are of quartered meshes, and each original triangle keeps its share of all parts.

    Returns:
        The maps, and the arrays of the map of all that say where their caps lie, by name.

    Raises:
        OmtwarpError: triangles reach from one cap to another, or turn over.
    """
    # Where sides of large triangles reach from one cap into another, caps are made smaller by this factor, at most so
    # many times.
    rounds_apart, less_covered = 6, 0.85
    order, masses = places_of(parts), []
    for part in parts:
        areas = triangle_areas(part.vertices, part.faces)
        masses.append(float(areas.sum() if weights is None else areas @ weights[part.face_origin]))
    # A cap holds the fillings of the part's other holes, too.
    own = [triangle_areas(each.sphere, each.faces).sum() / triangle_areas(*_whole(each)[:2]).sum() for each in maps]
    wanted = np.array(masses) / np.array(own)
    total = wanted[order].sum()
    goals = [_wanted_areas(each) if exact else None for each in maps]
    wholes = [_whole(each)[:2] for each in maps if exact]
    rims = [hemisphere_to_disk(points[boundary_loops(faces, len(points))[0]]) for points, faces in wholes]
    centres, covered = pack_caps(wanted[order] / total)
    centres = centres[np.argsort(order)]
    for _ in range(rounds_apart):
        shares = covered * wanted / total
        shares = held.shares_of_polygons(rims, shares, wanted) if exact else shares
        capped = [_on_cap(each, share, wanted=goal)[0] for each, share, goal in zip(maps, shares, goals, strict=True)]
        placed = [_placed(each, centre, share) for each, share, centre in zip(capped, shares, centres, strict=True)]
        reach = np.array([_reach(each, centre) for each, centre in zip(placed, centres, strict=True)])
        apart = np.arccos(np.clip(centres @ centres.T, -1.0, 1.0)) - reach[:, None] - reach
        if apart[np.triu_indices(len(maps), 1)].min() > 0.0:
            return placed, {"cap_centres": centres, "cap_shares": shares}
        covered *= less_covered
    raise OmtwarpError("triangles at the rims of parts reach into other parts: use finer meshes, or map each by itself")


def _wanted_areas(each: MapResult) -> Floats:
    """Return the areas that the original triangles of a quartered map are to have up to a factor, fillings included."""
    points, faces, _ = _whole(each)
    image = triangle_areas(points, faces)
    own = triangle_areas(each.vertices, each.faces) if each.measure is None else each.measure
    image[: len(own)] = own * (image[: len(own)].sum() / own.sum())
    return image.reshape(-1, PARTS).sum(axis=1)


def _whole(each: MapResult) -> tuple[Floats, NDArray, Floats]:
    """Return the points on the sphere, the faces and the vertices of a map, with what fills its holes."""
    names = ("sphere", "faces", "vertices")
    points, faces, places = (each.arrays.get(f"filled_{name}", each.arrays[name]) for name in names)
    return points, faces, places


def _by_image(each: MapResult) -> Surface:
    """Return a mapped surface, its holes filled, whose triangles have the areas of their images on the sphere."""
    points, faces, places = _whole(each)
    return Surface(places, faces, triangle_solid_angles(*points[faces].transpose(1, 0, 2)))


def _placed(each: MapResult, centre: Floats, share: float) -> MapResult:
    """Turn a map to the cap around the north pole to another centre, along a great circle."""
    # Householder's reflection that exchanges pole and centre, after the one that turns x over: a rotation.
    across = np.array([0.0, 0.0, 1.0]) - centre
    length = float(across @ across)
    turn = np.eye(3) - (2.0 / length) * np.outer(across, across) if length > 0.0 else np.eye(3)
    frame = turn @ np.diag([-1.0, 1.0, 1.0]) if length > 0.0 else turn
    about: SurfaceReport = each.report["surface"] | {"share_of_sphere": share, "centre": centre.tolist()}
    return each.turned(frame.T).with_arrays({"domain": Domain.CAP, "report": each.report | {"surface": about}})


def _reach(each: MapResult, centre: Floats) -> float:
    """Return the largest angle from a cap's centre to a point of its triangles, whose sides at the rim are curved."""
    points, faces, _ = _whole(each)
    rim = points[boundary_half_edges(faces, len(points))]
    middle = normalised(rim.sum(axis=1))
    return float(np.arccos(np.clip(np.concatenate([rim[:, 0], middle]) @ centre, -1.0, 1.0)).max())


def _on_torus(part: Part, progress: Progress | None, options: MapOptions) -> MapResult:
    """Map a part of genus 1 to a flat torus."""
    ordered = part.numbered_in_space()
    surface = Surface(ordered.vertices, ordered.faces)
    surface.origins = ordered
    result = in_input_order(map_to_torus(surface, options, progress=progress), part, exact=options.exact)
    return result if options.exact else result.with_arrays(origin_arrays(None))


@dataclass(frozen=True, eq=False)
class _Opened(Derived):
    """A part prepared for mapping: cut, split, and filled except for the loop that becomes the equator.

    Attributes:
        loops: those that are filled.
        small: index of the first loop with a small filling; those of all later ones are small too.
        filled: the surface with its loops filled.
        cut_along: the kind of each cut, see :func:`omtwarp.topology.handles.cut_open`.
    """

    loops: list[NDArray[np.int64]]
    small: int
    filled: FilledSurface
    cut_along: list[str]


def _map_part(
    part: Part,
    domain: str,
    fill_area: str,
    along: CutAlong | None,
    progress: Progress | None,
    options: MapOptions,
    shares: Floats | None,
    of_file: Origins | None,
) -> MapResult:
    if domain == "auto":
        domain = "hemisphere" if len(part.loops) == 1 else "sphere"
    opened = _opened(part, fill_area, along or CutAlong.AUTO, to_rim=domain != "sphere")
    surface = _surface(opened, shares)
    names, count = opened.compose(opened.filled), len(opened.faces)
    surface.origins = names if of_file is None else of_file.compose(names)
    if domain == "sphere":
        closed = map_closed(surface, count, options, progress=progress)
        if options.exact:
            opened, closed = _quartered(opened, closed, surface)
        result = _restricted(part, opened, closed, domain)
    else:
        result = _on_hemisphere(part, opened, surface, domain, progress, options)
    parts = PARTS if options.exact else 1
    if shares is not None:
        result = result.with_arrays({"measure": np.repeat(surface.face_areas[:count] / parts, parts)})
    image = result.sphere if result.disk is None else np.pad(result.disk, ((0, 0), (0, 1)))
    areas = triangle_areas(image, result.faces).reshape(-1, parts).sum(axis=1)
    findings = judge(surface, _whole(result)[0], result.report["stages"], options, image=areas)
    mass = result.report["mass"] | kept_mass(areas, surface.face_areas[:count])
    report = result.report | {"mass": mass, "warnings": accepted(findings, options.strict)}
    return result.with_arrays({"report": report})


def _quartered(opened: _Opened, closed: MapResult, surface: Surface) -> tuple[_Opened, MapResult]:
    """Quarter the triangles of a prepared part like those of an exact map, and reorder the map.

    Args:
        opened: the surface prepared for mapping.
        closed: the exact map of the filled surface.
        surface: the filled surface as it was mapped.
    """
    whole, own = surface.vertex_count, PARTS * len(opened.faces)
    used = np.unique(closed.faces[:own])
    order = np.concatenate([used, np.setdiff1d(np.arange(len(closed.vertices)), used)])
    place = np.argsort(order)
    ends = surface.edges.astype(np.int64)
    given = opened.filled.vertices
    points = np.concatenate([given, 0.5 * given[ends[:, 0]] + 0.5 * given[ends[:, 1]]])[order]
    faces = place[closed.faces].astype(np.int32)
    keys, loops = edge_keys(ends, whole), []
    for loop in opened.loops:
        edge = np.searchsorted(keys, edge_keys(np.stack([loop, np.roll(loop, -1)], axis=1), whole))
        loops.append(np.stack([loop, place[whole + edge]], axis=1).ravel())
    number, parents = np.where(used < whole, used, -1), np.arange(own) // PARTS
    of_parts = Origins(number, parents, split_edges=ends[used[used >= whole] - whole], given=len(opened.vertices))
    cut = replace(
        opened,
        vertices=points[: len(used)],
        faces=faces[:own],
        **vars(opened.compose(of_parts)),
        loops=loops,
        filled=replace(opened.filled, vertices=points, faces=faces, patch=np.repeat(opened.filled.patch, PARTS)),
    )
    return cut, closed.with_arrays(closed.rows({"V": order}) | {"faces": faces})


def _own_half(closed: MapResult, glued: Double) -> MapResult:
    """Return the surface's own half of the map of a double."""
    own, number = slice(0, len(closed.faces) // 2), np.cumsum(~glued.copied) - 1
    arrays = closed.rows({"V": glued.half, "F": own}) | {"faces": number[closed.faces[own]].astype(np.int32)}
    return closed.with_arrays({**arrays, **origin_arrays(None)})


def _or(lines: list[str]) -> str:
    names = [re.sub(r":.*?( \(with [^)]*\))?$", r"\1", line) for line in lines]
    return " or ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names) + " would map it"


def _opened(part: Part, fill_area: str, along: CutAlong, to_rim: bool) -> _Opened:
    cut, kinds = cut_open(part.vertices, part.faces, part.genus, along)
    made: Derived = cut
    origins, loops = part.compose(cut), list(part.loops)
    if to_rim:
        longest = int(np.argmax([loop_length(cut.vertices, loop) for loop in loops]))
        made = split_chords(cut.vertices, cut.faces, loops.pop(longest))
        origins = origins.compose(made)
    small = len(loops) if fill_area == FillArea.NATURAL else 0  # the sides of cuts always
    loops += [side for pair in cut.sides for side in pair]  # the last ones
    vertices, faces = made.vertices, made.faces
    filled = fill_holes(vertices, faces, loops)
    return _Opened(
        **vars(origins), vertices=vertices, faces=faces, loops=loops, small=small, filled=filled, cut_along=kinds
    )


def _surface(opened: _Opened, weights: Floats | None = None) -> Surface:
    """Return the filled surface with weighted areas, and with the area that was chosen for the filling.

    The faces may be oriented inwards: a map depends on lengths only, and clockwise faces are counter-clockwise in a
    mirror image.
    """
    filled = opened.filled
    inwards = signed_volume(filled.vertices, filled.faces) < 0.0
    own = filled.vertices * np.array([-1.0, 1.0, 1.0]) if inwards else filled.vertices
    surface = Surface(own, filled.faces)
    filling, own = filled.patch >= opened.small, filled.patch < 0
    if weights is None and not filling.any():
        return surface
    # Areas and sums of them that are the same, to the bit, in any order of vertices and faces.
    ordered, areas = in_space_order(surface), np.empty(surface.face_count)
    areas[ordered.face_origin] = ordered.surface.face_areas
    if weights is not None:
        before = fsum(areas[own])
        areas[own] *= weights[opened.face_origin]
        areas[~own] *= fsum(areas[own]) / before  # a filling keeps its share
    if not filling.any():
        return surface.with_areas(areas)
    whole = fsum(areas[own])
    # Share of the surface's area that all small fillings together take. With a tenth of that, triangles on both sides
    # of the rim differ so much that refinement takes eighteen times as long.
    least = 1e-2 * whole / fsum(areas[filling])
    side = np.sqrt(4.0 / np.sqrt(3.0) * SPHERE_AREA / np.count_nonzero(own))
    for number in range(opened.small, len(opened.loops)):
        here = filled.patch == number
        # Where a coarse mesh has a large hole, its filling takes more, so that the sides around it have at least this
        # share of the mean side on the sphere: with less, halves of icospheres do not converge.
        around = 0.25 * side * len(opened.loops[number])  # of a cap with the share (around / 4π)² of the sphere
        areas[here] *= min(1.0, max(least, whole * (around / SPHERE_AREA) ** 2 / fsum(areas[here])))
    return surface.with_areas(areas)


def _restricted(part: Part, opened: _Opened, closed: MapResult, domain: str) -> MapResult:
    """Restrict the map of a closed surface to its first vertices and faces, which are those of the surface itself."""
    count, face_count = len(opened.vertices), len(opened.faces)
    stages = list(closed.report["stages"])
    measured = measure_triangles(opened.vertices, opened.faces, closed.sphere[:count]).to_dict()
    stages[-1] = {**stages[-1], **measured}  # the others are of the surface that was mapped
    mesh: MeshReport = {"vertices": count, "faces": face_count, "extent": np.ptp(part.vertices, axis=0).tolist()}
    about: SurfaceReport = {
        "domain": domain,
        "boundary_loops": len(part.loops),
        "genus": part.genus,
        "split_edges": len(opened.split_edges),
        "filled_loops": len(opened.loops),
        "mapped_surface": closed.report.get("mesh"),
    }
    if opened.cut_along:
        about["cut_along"] = opened.cut_along
    whole = slice(len(opened.filled.vertices))
    arrays = closed.rows({"V": slice(count), "F": slice(face_count)}) | {
        "vertices": opened.vertices,
        "faces": opened.faces,
        "measure": None,
        "report": closed.report | {"mesh": mesh, "stages": stages, "surface": about},
        "domain": domain,
        "vertex_origin": opened.vertex_origin,
        "face_origin": opened.face_origin,
        "split_edges": opened.split_edges,
    }
    if opened.loops:
        arrays |= {
            "loops": np.concatenate(opened.loops),
            "loop_ends": np.cumsum([len(loop) for loop in opened.loops], dtype=np.int64),
            "loop_pairs": np.arange(len(opened.loops))[-2 * part.genus :].reshape(-1, 2) if part.genus else None,
            "filled_vertices": opened.filled.vertices,
            "filled_faces": opened.filled.faces,
            "filled_sphere": closed.sphere[whole],
            "filled_conformal": closed.conformal[whole],
            "filled_loop": opened.filled.patch,
        }
    return closed.with_arrays(arrays)


def _on_hemisphere(
    part: Part, opened: _Opened, half: Surface, domain: str, progress: Progress | None, options: MapOptions
) -> MapResult:
    glued = double(opened.filled.vertices, opened.filled.faces)
    areas = np.concatenate([half.face_areas, half.face_areas]) if half.weighted else None
    surface = Surface(glued.vertices, glued.faces, areas)
    surface.origins = glued if half.origins is None else half.origins.compose(glued)
    closed = map_closed(surface, len(opened.faces), options, mirror=glued, progress=progress)
    refined = options.refine is not None
    if options.exact:
        cut = quartered_double(glued, quarter(surface))
        if not is_symmetric(cut, closed.sphere):
            raise OmtwarpError("the map of the doubled surface with exact areas is not symmetric: leave exact out")
        opened, closed = _quartered(opened, _own_half(closed, cut), half)
    elif not is_symmetric(glued, closed.sphere):
        frame = mirror_frame(glued, closed.sphere, surface.vertex_areas)
        symmetric = symmetric_map(glued, surface, closed.sphere @ frame, device=options.device)
        before = closed.transported
        if symmetric is not None:
            closed = closed.turned(frame).with_arrays({"sphere": symmetric})
        elif domain == Domain.DISK and refined and before is not None and is_symmetric(glued, before):
            closed = closed.with_arrays({"sphere": before})  # as the disk is refined in the plane
        else:
            raise OmtwarpError(
                "the map of the doubled surface is not one to one once it is symmetric: "
                + ("leave the refinement out or let area count more in it, " if refined else "")
                + "use a finer mesh, or fill the hole"
            )
    result = _restricted(part, opened, closed, domain)
    return result if domain == Domain.HEMISPHERE else _projected(part, half, result, options)


def _projected(part: Part, half: Surface, result: MapResult, options: MapOptions) -> MapResult:
    """Carry a map of the hemisphere to the disk or to a cap, and untangle triangles that this flips.

    Args:
        part: that is mapped.
        half: what was mapped, with its holes filled, and the areas that its triangles are to have.
        result: the map to the hemisphere, whose domain says where it goes.
        options: of the map: with ``exact`` its triangles are parts of those of ``half``, whose areas are kept.
    """
    begun, error, about = perf_counter(), None, result.report["surface"]
    wanted = half.face_areas if options.exact else None
    # Angles are kept on the way where the map is not one that keeps areas.
    conformal = options.stages == (Stage.CONFORMAL,)
    if result.domain == Domain.CAP:
        longest = max(part.loops, key=lambda loop: loop_length(part.vertices, loop))
        hole = fill_holes(part.vertices, part.faces, [longest])
        areas = triangle_areas(hole.vertices, hole.faces)
        share = float(areas[hole.patch < 0].sum() / areas.sum())
        about = about | {"share_of_sphere": share}
        result, error = _on_cap(result, share, conformal, wanted)
    else:
        laid, goal = hemisphere_to_disk(_whole(result)[0], conformal), half if wanted is None else _by_image(result)
        if isinstance(options.refine, AreaMatch):
            disk, flips = held.match_in_plane(laid, goal, len(result.faces), options.refine.area)
        else:
            weight = held.AREA_WEIGHT if options.refine is None else refinement_weight(options.refine)
            disk, flips = held.untangle_in_plane(laid, goal, None if conformal else weight)
        if flips and wanted is None:
            raise OmtwarpError(
                f"{flips} triangles at the rim turn over where the hemisphere is laid flat: use a finer mesh"
            )
        if wanted is not None:
            disk, error = held.exact_in_plane(disk, goal, wanted)
        result = result.with_arrays({"disk": disk[: len(result.vertices)]})
    measured = result.distortion("sphere" if result.disk is None else "disk").to_dict()
    projected: StageReport = {"name": result.domain, "seconds": perf_counter() - begun, "iterations": 0, **measured}
    if error is not None:
        projected["largest_area_error"] = error
    stages = [*result.report["stages"], projected]
    return result.with_arrays({"report": result.report | {"surface": about, "stages": stages}})


def _on_cap(
    result: MapResult, share: float, conformal: bool = False, wanted: Floats | None = None
) -> tuple[MapResult, float | None]:
    """Carry a map of the hemisphere to the cap with a share of the sphere around the north pole; angles or areas stay.

    Triangles that have other sides there and turn over are untangled, with the areas that they had on the hemisphere.

    Args:
        result: the map to the hemisphere.
        share: of the sphere, the cap's.
        conformal: whether angles stay.
        wanted: the areas up to a factor that the original triangles of a quartered map are to have, fillings included.

    Returns:
        The map, and the largest relative error of a wanted area.
    """
    surface, error = _by_image(result), None
    cap = disk_to_cap(hemisphere_to_disk(_whole(result)[0], conformal), share, conformal)
    points = held.untangle_on_cap(cap, surface)
    if wanted is not None:
        points, error = held.exact_on_cap(points, surface, wanted)
    filled = None if result.filled_sphere is None else points
    return result.with_arrays({"sphere": points[: len(result.vertices)], "filled_sphere": filled}), error
