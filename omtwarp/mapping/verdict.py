"""Warnings about a map or a mesh: measures, their limits, the worst place, and what would help, in one line each."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from omtwarp.errors import OmtwarpError
from omtwarp.geometry.limbs import thinnest_ring, vertices_needed
from omtwarp.geometry.sphere_hierarchy import triangle_solid_angles
from omtwarp.maps.result import StageReport, Warned
from omtwarp.measures import area_distortions
from omtwarp.mesh.arrays import Floats, cross, dots, normalised, norms
from omtwarp.mesh.origins import named
from omtwarp.mesh.surface import SPHERE_AREA, Surface, triangle_areas
from omtwarp.optimal.refinement import not_matched
from omtwarp.options import AreaMatch, MapOptions, Refinement, Stage

# Mean of r + 1/r, r the area of a triangle's image over the area wanted. Smooth shapes of a few hundred triangles are
# below 2.04, where flat triangles are a coarse picture of the sphere, and fine ones at 2.001.
MAX_AREA_DISTORTION = 2.05
# With so few faces shorter ones matter too: an ellipsoid of 80 is at 2.20, and one of 180 at 2.001.
FEW_FACES, LONG_OF_FEW, SHARE_OF_FEW = 150, 3.0, 0.5
# Of so few triangles those that are long and folded in the mean may be too many although few are at either limit above:
# of 80 to 132 faces, shapes above both numbers are at 2.05 to 2.14, and those at them at 2.04.
MEAN_LONG, MEAN_FOLD = 2.3, 60.0
NEEDLES = "needle"  # kind of the warning about them
EVENLY = "remesh with more triangles, evenly shaped"
REFINE = ", or use refine='area'"  # the end of a remedy


@dataclass(frozen=True)
class Finding:
    """A warning about a map or a mesh.

    Attributes:
        kind: a short, stable name: ``area-distortion``, ``vertex-areas``, ``not-converged`` or ``not-matched`` of a
            map; ``large-face``, ``coarse-limb``, ``long-triangles``, ``folded-triangles``, ``few-triangles``,
            ``needle`` or ``thin-sheet`` of a mesh.
        where: index of the worst face or vertex, as the message says; -1 where there is none to name.
        message: the measure and the worst place.
        remedy: what would help.
    """

    kind: str
    where: int
    message: str
    remedy: str

    def __str__(self) -> str:
        return f"{self.message}; {self.remedy}"

    def to_dict(self) -> Warned:
        """Return the finding as plain values, ready for JSON."""
        return {"kind": self.kind, "where": self.where, "text": str(self)}


def foretell(surface: Surface) -> list[Finding]:
    """List properties of a valid mesh that may keep its map from keeping areas.

    Of 200 generated meshes, all whose maps reach an area distortion above 2.05 are named, beside some that stay below.
    Whether a solver converges is foretold for needles alone.
    """
    # Triangles count as long where the longest edge is so many times the height over it, and matter where they have
    # this share of the area, as on flat sides that are triangulated without a vertex inside, and where radii are noise:
    # on spheres with log-normal radii of 0.2, 0.32 and 0.5 the share is 0.08, 0.23 and 0.65, the distortion 2.04, 2.08,
    # 2.11.
    long_triangle, long_share = 5.0, 0.2
    findings = []
    share = surface.own_areas / SPHERE_AREA
    worst = int(np.argmax(share))
    # An equilateral triangle with its corners on the sphere has the largest area, 3 sqrt(3) / 4: this share of 4π. With
    # a share of 0.086 the map of a small sphere is at 2.16.
    if share[worst] > 0.05:
        text = f"{{}} has {share[worst]:.1%} of the area"
        findings.append(_finding(surface, "large-face", "face", worst, text, "split large triangles"))
    ring = thinnest_ring(surface)
    if ring is not None:
        # Vertices around a limb for those of an even mesh. Tubes whose edges were flipped at random reach 2.04 at 1.3,
        # 2.12 at 1.2.
        needed = 1.3 * vertices_needed(ring.share, surface.face_count)
        if ring.around < needed:
            limb = f"about {ring.around:.1f} vertices around a limb with {ring.share:.1%} of the area"
            text = f"{limb}, at {{}}, where {needed:.1f} are needed"
            remedy = f"remesh with more vertices around the limb{REFINE}"
            findings.append(_finding(surface, "coarse-limb", "vertex", ring.vertex, text, remedy))
    long = elongation(surface)
    limits = [(long_triangle, long_share), (LONG_OF_FEW, SHARE_OF_FEW)][: 1 + (surface.face_count <= FEW_FACES)]
    for limit, most in limits:
        share_long = float(share[long > limit].sum())
        if share_long > most:
            worst = int(np.argmax(np.where(long > limit, share, 0.0)))
            remedy = "remesh the long triangles into even ones"
            text = f"triangles {limit:.0f} times as long as high have {share_long:.0%} of the area, the largest is {{}}"
            findings.append(_finding(surface, "long-triangles", "face", worst, text, remedy))
            break
    return [*findings, *_coarse_findings(surface, long)]


def _coarse_findings(surface: Surface, long: Floats) -> Iterator[Finding]:
    """Find triangles that are large for how the surface bends or how thick it is; ``long`` is their elongation."""
    # Triangles count as folded where a neighbour turns away by more degrees than this. Bodies with limbs that were
    # decimated to 80 to 300 faces reach 2.05 where 0.19 of the area is folded, and 2.1 to 2.3 at 0.3 to 0.5; on scans
    # it is below 0.03.
    fold, folded_share = 100.0, 0.18
    share = surface.own_areas / SPHERE_AREA
    corners = surface.scaled_vertices[surface.faces]
    across = cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = normalised(across)
    bend = np.clip(dots(normals[:, None], normals[surface.face_neighbours]).min(axis=1), -1.0, 1.0)
    folded = bend < np.cos(np.radians(fold))
    if share[folded].sum() > folded_share:
        worst = int(np.argmax(np.where(folded, share, 0.0)))
        remedy = "remesh with more triangles where the surface bends"
        bent = f"triangles folded by more than {fold:.0f} degrees against a neighbour"
        text = f"{bent} have {share[folded].sum():.0%} of the area, the largest is {{}}"
        yield _finding(surface, "folded-triangles", "face", worst, text, remedy)
    # Among so few triangles one that is so many times as long as high may keep the solver from converging: spheres of
    # 82 faces with a needle of 3,800 to 8.5e8 did not in 9 cases of 16, those with 280 or less and those of 320 faces
    # did.
    if surface.face_count <= FEW_FACES and long.max() > 1e3:
        text, remedy = f"{{}} is {long.max():.0e} times as long as high", "flip an edge of the needle, or collapse it"
        yield _finding(surface, NEEDLES, "face", int(np.argmax(long)), text, remedy)
    mean_long = float(share @ long)
    mean_fold = float(np.degrees(np.arccos(min(share @ bend, 1.0))))
    if surface.face_count <= FEW_FACES and mean_long > MEAN_LONG and mean_fold > MEAN_FOLD:
        text = (
            f"{surface.face_count} triangles are on average {mean_long:.2g} times as long as high and folded by "
            f"{mean_fold:.0f} degrees against a neighbour"
        )
        yield Finding("few-triangles", -1, text, EVENLY)
    thickness = 2.0 * abs(float((corners[:, 0] * across).sum())) / 6.0 / SPHERE_AREA
    side = float(np.sqrt(4.0 / np.sqrt(3.0) * SPHERE_AREA / surface.face_count))
    # Mean side of triangles over the mean thickness, twice the volume by the area. Plates are at 2.01 where it is 1.5,
    # at 2.05 for 1.9, and at 2.1 to 2.2 for 3; thin plates of larger triangles may come out at any of these.
    # A surface glued to its mirror copy encloses nothing but rounding errors, and is no sheet.
    if thickness > 1e-9 and side > 1.8 * thickness:
        text = f"the mean side of triangles is {side / thickness:.3g} times the mean thickness"
        yield Finding("thin-sheet", -1, text, "remesh with triangles smaller than the sheet is thick")


def elongation(surface: Surface) -> Floats:
    """Return the ratio of every triangle's longest edge to the height above it, shape [F]; 1.15 if equilateral."""
    corners = surface.scaled_vertices[surface.faces]
    edges = norms(corners - np.roll(corners, -1, axis=1))
    return edges.max(axis=1) ** 2 / np.maximum(2.0 * surface.own_areas, np.finfo(np.float64).tiny)


def judge(
    goal: Surface,
    sphere: Floats,
    records: Sequence[StageReport],
    options: MapOptions,
    *,
    uniform: bool = True,
    image: Floats | None = None,
    parts: int = 1,
) -> list[Finding]:
    """List the warnings about a map; those about areas only where the options ask for a map that keeps them, or some.

    Args:
        goal: the surface, with the area that each of its triangles is to have on the sphere.
        sphere: the map, unit vectors, shape [V, 3].
        records: of its stages.
        options: how it was made.
        uniform: whether the sphere is to be filled evenly, so that areas around vertices are judged if not exact ones.
        image: the areas of the first triangles in the map that is returned, where others only fill holes; those of all
            on the sphere by default.
        parts: faces in a row that are one triangle of the input.
    """
    if Stage.OMT not in options.stages:
        return []
    image = triangle_areas(sphere, goal.faces) if image is None else image
    mean, distorted = _area_distortion(goal, image, parts)
    unmatched, findings, uniform = [], [], uniform and not options.exact
    if isinstance(options.refine, AreaMatch) and (missed := not_matched(options.refine.area, mean)):
        unmatched = [Finding("not-matched", -1, *missed)]
    if options.refine in (None, Refinement.AREA):
        around = _areas_around(goal, sphere, np.unique(goal.faces[: len(image)])) if uniform else []
        findings = around + [distorted] * (not mean < MAX_AREA_DISTORTION)
    findings += _unfinished(records)
    remedy = _remedy(goal, options.refine is None and uniform) if findings else ""
    return [replace(each, remedy=remedy) for each in findings] + unmatched


def _unfinished(records: Sequence[StageReport]) -> Iterator[Finding]:
    """Make the warnings about stages that did not converge."""
    # The optimal map of the mesh as it was is only where that of its quarters began.
    exact = any(record["name"] == "exact" and record.get("converged") for record in records)
    for record in records:
        if record.get("converged") is False and record["name"] != "refine" and not exact:
            text = f"the stage {record['name']} did not converge: {record.get('ended') or 'most steps taken'}"
            text += f", {record['gave_up']}" if record.get("gave_up") else ""
            yield Finding("not-converged", -1, text, "")


def _remedy(goal: Surface, refinable: bool) -> str:
    """Return what would help a map that is not as good as it should be; a refinement where that was not made."""
    causes = foretell(goal)
    remedy = causes[0].remedy if causes else EVENLY + REFINE
    remedy = remedy if refinable else remedy.removesuffix(REFINE)
    return f"{remedy} ({causes[0].message})" if causes else remedy


def accepted(findings: Sequence[Finding], strict: bool) -> list[Warned]:
    """Return warnings as plain values; where they are not accepted, raise the first, with the kinds of the others."""
    if findings and strict:
        others = ", ".join(finding.kind for finding in findings[1:])
        raise OmtwarpError(f"not accepted with strict=True: {findings[0]}" + (f" (also: {others})" if others else ""))
    return [finding.to_dict() for finding in findings]


def _area_distortion(goal: Surface, image: Floats, parts: int) -> tuple[float, Finding]:
    """Return the area distortion of a map, and the warning about it; arguments are as of :func:`judge`."""
    wanted = goal.face_areas[: len(image)].reshape(-1, parts).sum(axis=1)
    ratio, distortion = area_distortions(image.reshape(-1, parts).sum(axis=1), wanted)
    mean = float(wanted @ distortion / wanted.sum())
    worst = int(np.argmax(wanted * (distortion - 2.0)))
    compared = f"whose image has {ratio[worst]:.3g} times its area"
    text = f"area distortion {mean:.4g}, where 2 is perfect, most of it in {{}}, {compared}"
    return mean, _finding(goal, "area-distortion", "face", parts * worst, text)


def _areas_around(goal: Surface, sphere: Floats, own: NDArray[np.integer]) -> list[Finding]:
    """Find the warning about the areas around the vertices ``own``, which a map promises."""
    # Relative error of the area around a vertex. Where the optimal map is found it is at round-off.
    max_vertex_area_error = 0.10
    around = goal.sum_to_vertices(triangle_solid_angles(*sphere.take(goal.faces.T, axis=0)))
    error = np.abs(around / around.sum() * SPHERE_AREA / goal.vertex_areas - 1.0)[own]
    off = int((error > max_vertex_area_error).sum())
    if not off:
        return []
    worst = int(own[np.argmax(error)])
    several = f"by more than {max_vertex_area_error:.0%} at {off} of {len(error)}"
    text = f"areas around vertices are off by up to {error.max():.0%}, the most at {{}}, and {several}"
    return [_finding(goal, "vertex-areas", "vertex", worst, text)]


def _finding(surface: Surface, kind: str, what: str, number: int, message: str, remedy: str = "") -> Finding:
    """Make a finding about a ``face`` or ``vertex``, whose name and place replace the braces in the message."""
    where, name = named(surface.origins, what, number)
    place = surface.vertices[surface.faces[number]].mean(axis=0) if what == "face" else surface.vertices[number]
    shown = f"{name} at ({', '.join(f'{coordinate:.4g}' for coordinate in place)})"
    return Finding(kind, where, message.format(shown), remedy)
