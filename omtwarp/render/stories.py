"""Course of a film of a map: where every vertex is drawn, and on the map's domain, at any time."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.spatial.transform import Rotation

from omtwarp.errors import OmtwarpError
from omtwarp.mesh.surface import SPHERE_AREA, triangle_areas
from omtwarp.render.camera import Camera, camera_axes
from omtwarp.render.scene import Part, SurfaceView, normalisation, smooth_parts, welded_normals
from omtwarp.render.subject import FinishedMap, Picture, is_torus_map, map_view, torus_view
from omtwarp.render.upright import posed
from omtwarp.texturing.rasterizing import rasterize
from omtwarp.texturing.smooth import grid_points, grid_triangles, smooth_map

if TYPE_CHECKING:
    from omtwarp.torus.torus_map import TorusMap

Floats = NDArray[np.float64]
Ints = NDArray[np.int32]

# Texels around the sphere of a pattern: two to a pixel of the picture, of which a ball fills about a half.
PICTURE_WIDTHS = (512, 4096)
NEAR = 1e-6  # radians: between points nearer than this the great circle is a straight line
SMALLEST_SINE = 1e-12  # of points next to their antipodes, between which no great circle is the shortest
LEAST_WEIGHT = 1e-9  # of the mean, of a vertex without area: turns the domain as little as that
FLAT = 1e-3  # of a surface's area: the length of its mean normal below which it has no side
TUBE_TURNS = 24  # beginnings along the tube of a ring torus that are compared
FITTED = 4000  # vertices, at most, that they are compared at
SPACING = 1.08  # distance of two domains over the sum of their radii, as seen
PUSHES = 300  # of domains that hide each other, at most: 50 random ones took 41
MOST_PUSHED = 500  # domains: more are left where their parts are
SPIRAL = 2.399963  # radians: the golden angle, between the ways in which domains at one place go apart
START = 1e-3  # of its radius: how far each is moved along that way at first


@dataclass(frozen=True)
class Story:
    """Where every vertex is drawn and on the map's domain, at any time of a film.

    From time 0 to 1 the points on the sphere go along great circles from the conformal to the final map, which is what
    optimal transport does with them; on a torus they go straight. From 1 to 2 the surface goes straight to the domain.

    Both maps are divided as pictures of maps are, so that lines of the pattern are smooth curves between the vertices.

    Attributes:
        surface: the surface, centred, its farthest point at distance 1, shape [V, 3].
        domain: the vertices on the domain, of the surface's area, turned to lie nearest to it, shape [V, 3].
        domain_points: the same of the divided map, shape [N, 3].
        first: the conformal map, divided: unit vectors, or u and v of a torus, shape [N, 3].
        last: the final map, divided, shape [N, 3].
        faces: of the surface, shape [F, 3].
        parts: the triangles that the surface's are divided into, corners numbered as ``first`` and ``last`` are.
        weights: sparse, shape [N, V]: every point of the divided maps as a combination of vertices; None where they
            are not divided.
        image: picture that is carried along, equirectangular or repeating both ways.
        name: of the domain, in words.
        on_torus: whether the maps are to a torus.
    """

    surface: Floats
    domain: Floats
    domain_points: Floats
    first: Floats
    last: Floats
    faces: Ints
    parts: Ints
    weights: csr_matrix | None
    image: NDArray[np.uint8]
    name: str = "sphere"
    on_torus: bool = False

    @property
    def flows(self) -> bool:
        """Whether the conformal and the optimal map differ, so that the film shows the flow between them."""
        return not np.array_equal(self.first, self.last)

    @property
    def captions(self) -> tuple[str, str, str, str, str]:
        """Words for what is seen at time 0, to 1, at 1, to 2, and at 2."""
        owner = "their" if self.name.endswith("s") and self.name != "torus" else "its"
        there = f"to {owner} {self.name}", f"the map on the {self.name}"
        return ("conformal map", "to the optimal map", "optimal map", *there)

    def part(self, time: float) -> Part:
        """Return the surface as it is drawn at a time between 0 and 2."""
        places = self.surface + max(time - 1.0, 0.0) * (self.domain - self.surface)
        flow = min(time, 1.0)
        if self.on_torus:
            points = self.first + flow * (self.last - self.first)
        else:
            points = along_great_circles(self.first, self.last, flow)
        normals = welded_normals(places, self.faces)
        if self.weights is not None:
            # During the second part, added points also move to the domain, not to the flat triangles inside it.
            fill = max(time - 1.0, 0.0) * (self.domain_points - self.weights @ self.domain)
            places, normals = self.weights @ places + fill, self.weights @ normals
            normals /= np.maximum(np.linalg.norm(normals, axis=1), np.finfo(float).tiny)[:, None]
        return Part(
            positions=places.astype(np.float32),
            normals=normals.astype(np.float32),
            faces=self.parts,
            kind="uv" if self.on_torus else "sphere",
            value=points.astype(np.float32),
            image=self.image,
            repeat_rows=self.on_torus,
        )


def along_great_circles(first: Floats, last: Floats, time: float) -> Floats:
    """Return the points on the way between unit vectors, at constant speed along great circles, shape [N, 3].

    Args:
        first: where points are at time 0, shape [N, 3].
        last: where they are at time 1, shape [N, 3].
        time: 0 to 1; both ends are exact.
    """
    if time <= 0.0:
        return first
    if time >= 1.0:
        return last
    cosine = np.einsum("ij,ij->i", first, last)
    angle = np.arctan2(np.linalg.norm(np.cross(first, last), axis=1), cosine)[:, None]
    sine = np.maximum(np.sin(angle), SMALLEST_SINE)
    near = angle < NEAR
    ahead = np.where(near, time, np.sin(time * angle) / sine)
    behind = np.where(near, 1.0 - time, np.sin((1.0 - time) * angle) / sine)
    points = behind * first + ahead * last
    return points / np.maximum(np.linalg.norm(points, axis=1, keepdims=True), SMALLEST_SINE)


def story_of(
    result: FinishedMap | TorusMap,
    pattern: str,
    image: Picture | None,
    width: int,
    camera: Camera,
    up: str | None,
    front: str | None,
    device: str,
) -> tuple[Story, SurfaceView]:
    """Return the course of a film, and the surface with the axes that are up and to the front.

    Args:
        result: the map.
        pattern: that is carried along where there is no image.
        image: a picture in place of it.
        width: of the film in pixels.
        camera: from where it is seen, which parts that have a domain each are laid out for.
        up, front: axes; guessed where they are None.
        device: where the pattern is computed.

    Raises:
        OmtwarpError: no map, or an unusable picture.
    """
    least, most = PICTURE_WIDTHS
    texels = int(np.clip(2 ** math.ceil(math.log2(2 * width)), least, most))
    if is_torus_map(result):
        return _on_torus(result, pattern, image, texels // 2, up, front)
    if not isinstance(result, FinishedMap):
        raise OmtwarpError(f"cannot film a {type(result).__name__}: give a map")
    return _on_domains(result, rasterize(pattern, texels, device=device) if image is None else image, camera, up, front)


def _on_domains(
    result: FinishedMap, image: Picture, camera: Camera, up: str | None, front: str | None
) -> tuple[Story, SurfaceView]:
    """Return the course of a film of a map to spheres, disks and parts of spheres."""
    shown = posed(map_view(result, image), up, front)
    surface = _centred(shown)
    faces = np.asarray(result.faces, dtype=np.int32)
    first, last, parts, weights = np.asarray(result.conformal), np.asarray(result.sphere), faces, None
    divisions = smooth_parts(len(faces))
    if divisions > 1:
        divided = smooth_map(surface, faces, last, divisions)
        flows = not np.array_equal(first, last)
        first = smooth_map(surface, faces, first, divisions).sphere if flows else divided.sphere
        last, parts, weights = divided.sphere, divided.faces, divided.weights
    number = _domains(result, len(faces))
    axes = camera_axes(camera, shown.up or "y", shown.front)
    disk = getattr(result, "disk", None)
    if disk is not None:
        points = np.column_stack([disk, np.zeros(len(disk))])
        domain = _placed(points, faces, number, *_fits(surface, points, faces, number, "disk", axes))
        ends = domain if weights is None else weights @ domain
    else:
        points = np.asarray(result.sphere)
        fits = _fits(surface, points, faces, number, str(getattr(result, "domain", "sphere")), axes)
        domain = _placed(points, faces, number, *fits)
        ends = _placed(last, parts, np.repeat(number, len(parts) // len(faces)), *fits)
    picture, name = np.asarray(shown.image), _name(result, number)
    return Story(surface, domain, ends, first, last, faces, parts, weights, picture, name), shown


def _centred(shown: SurfaceView) -> Floats:
    """Return the vertices of a view around the origin, the farthest that is drawn at distance 1."""
    centre, radius = normalisation(shown)
    return (np.asarray(shown.vertices, dtype=np.float64) - centre) / radius


def _domains(result: FinishedMap, count: int) -> NDArray[np.intp]:
    """Return the number of the domain that every face has, shape [F]: zeros, but with parts that have one each."""
    part = getattr(result, "part", None)
    if part is None or getattr(result, "cap_centres", None) is not None:
        return np.zeros(count, dtype=np.intp)
    return np.unique(part, return_inverse=True)[1]


def _name(result: FinishedMap, number: NDArray[np.intp]) -> str:
    """Return what a map goes to, in words."""
    one = str(getattr(result, "domain", "sphere"))
    if getattr(result, "cap_centres", None) is not None or one not in ("sphere", "hemisphere", "disk", "cap"):
        one = "sphere"
    return one + "s" if number.any() else one


def _vertex_areas(surface: Floats, faces: Ints) -> Floats:
    """Return three times the area around every vertex, and a little for those without, shape [V]."""
    areas = np.bincount(faces.ravel(), np.repeat(triangle_areas(surface, faces), 3), minlength=len(surface))
    return areas + areas.mean() * LEAST_WEIGHT


def _fits(
    surface: Floats, points: Floats, faces: Ints, number: NDArray[np.intp], kind: str, axes: Floats
) -> tuple[Floats, Floats]:
    """Return the matrices [P, 3, 3] and shifts [P, 3] that take every domain's points next to its part of the surface.

    Every domain gets the area of its part. Where there are several, none hides another from the camera.

    Args:
        surface: shape [V, 3].
        points: on the domains, shape [V, 3].
        faces: shape [F, 3].
        number: the domain of every face, shape [F].
        kind: of the domains.
        axes: the camera's, as columns.
    """
    matrices, shifts, radii = [], [], []
    for k in range(int(number.max(initial=0)) + 1):
        mine = faces[number == k]
        weights = _vertex_areas(surface, mine)
        used = np.unique(mine)
        several = bool(number.any())
        area = float(triangle_areas(surface, mine).sum())
        covered = {"sphere": SPHERE_AREA, "disk": math.pi}.get(kind)
        covered = float(triangle_areas(points, mine).sum()) if covered is None else covered
        centre = np.average(surface[used], axis=0, weights=weights[used]) if several else np.zeros(3)
        here, there = surface[used] - centre, points[used]
        turn = _facing(surface, mine, here, there, weights[used]) if kind == "disk" else None
        if turn is None:
            turn = Rotation.align_vectors(here, there, weights=weights[used])[0].as_matrix()
        scale = math.sqrt(area / covered)
        matrices.append(scale * turn.T)
        shifts.append(centre)
        radii.append(scale)
    return np.array(matrices), _apart(np.array(shifts), np.array(radii), axes)


def _facing(surface: Floats, faces: Ints, here: Floats, there: Floats, weights: Floats) -> Floats | None:
    """Return the rotation of a disk to the side that a surface faces, nearest to it; None where it faces none.

    Args:
        surface, faces: the part, shapes [V, 3] and [F, 3].
        here: its vertices about their middle, shape [N, 3].
        there: the same on the disk, shape [N, 3].
        weights: of the vertices, shape [N].
    """
    corner = surface[faces]
    normal = 0.5 * np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]).sum(axis=0)
    length = float(np.linalg.norm(normal))
    if length < FLAT * triangle_areas(surface, faces).sum():
        return None
    normal /= length
    across = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    across /= np.linalg.norm(across)
    above = np.cross(normal, across)
    x, y = here @ across, here @ above
    angle = math.atan2(weights @ (there[:, 0] * y - there[:, 1] * x), weights @ (there[:, 0] * x + there[:, 1] * y))
    right = math.cos(angle) * across + math.sin(angle) * above
    return np.column_stack([right, np.cross(normal, right), normal])


def _apart(centres: Floats, radii: Floats, axes: Floats) -> Floats:
    """Return the centres of balls moved across the line of sight until none hides another, shape [P, 3].

    Args:
        centres: shape [P, 3].
        radii: shape [P].
        axes: the camera's, as columns.
    """
    count = len(centres)
    if count == 1 or count > MOST_PUSHED:
        return centres
    turns = SPIRAL * np.arange(count)
    flat = centres @ axes[:, :2] + START * radii[:, None] * np.column_stack([np.cos(turns), np.sin(turns)])
    wanted = SPACING * (radii[:, None] + radii[None])
    np.fill_diagonal(wanted, 0.0)
    for _ in range(PUSHES):
        between = flat[:, None] - flat[None]
        far = np.linalg.norm(between, axis=2)
        lack = np.maximum(wanted - far, 0.0)
        if lack.max() <= 0.5 * (SPACING - 1.0) * radii.min():
            break
        way = between / np.maximum(far, np.finfo(float).tiny)[..., None]
        flat = flat + 0.5 * (lack[..., None] * way).sum(axis=1)
    return centres + (flat - centres @ axes[:, :2]) @ axes[:, :2].T


def _placed(points: Floats, faces: Ints, number: NDArray[np.intp], matrices: Floats, shifts: Floats) -> Floats:
    """Return points on domains where they are drawn, shape [N, 3].

    Args:
        points: shape [N, 3].
        faces: triangles of them, shape [F, 3].
        number: the domain of every triangle, shape [F].
        matrices, shifts: of the domains, shapes [P, 3, 3] and [P, 3].
    """
    own = np.zeros(len(points), dtype=np.intp)
    own[faces] = number[:, None]
    return np.einsum("ni,nij->nj", points, matrices[own]) + shifts[own]


def _on_torus(
    result: TorusMap, pattern: str, image: Picture | None, texels: int, up: str | None, front: str | None
) -> tuple[Story, SurfaceView]:
    """Return the course of a film of a map to a torus, which ends with a ring torus."""
    from omtwarp.torus.pictures import ring_torus, tube_radius

    cut = result.textured(image, pattern=None if image is not None else pattern, size=texels)
    shown = posed(torus_view(result, cut.image), up, front)
    surface = _centred(shown)
    weights = _vertex_areas(surface, cut.faces)
    middle = np.average(surface, axis=0, weights=weights)
    tube = int(np.argmin(np.linalg.norm(result.lattice, axis=1)))  # the vector that goes around the tube
    chosen = np.linspace(0, len(surface) - 1, min(FITTED, len(surface))).astype(int)
    steps = np.zeros((TUBE_TURNS, 2))
    steps[:, tube] = np.arange(TUBE_TURNS) / TUBE_TURNS
    fits = [
        Rotation.align_vectors(
            surface[chosen] - middle,
            ring_torus(result.coordinates[cut.welded[chosen]] + step, result.lattice),
            weights=weights[chosen],
        )
        for step in steps
    ]
    best = int(np.argmin([off for _, off in fits]))
    area = float(triangle_areas(surface, cut.faces).sum())
    scale = math.sqrt(area / (4.0 * math.pi**2 * tube_radius(result.lattice)))
    to_ring = scale * fits[best][0].as_matrix().T
    first = cut.uv - result.coordinates[cut.welded] + result.conformal[cut.welded]
    last, parts, shares = cut.uv, cut.faces, None
    divisions = smooth_parts(len(cut.faces))
    if divisions > 1:
        parts, shares = _evenly(cut.faces, len(surface), divisions)
        first, last = shares @ first, shares @ last
    # Of equal coordinates up to whole numbers, so that the two sides of a seam are at the same place to the last bit.
    domain = (ring_torus(result.coordinates + steps[best], result.lattice) @ to_ring)[cut.welded] + middle
    ends = domain if shares is None else ring_torus(last + steps[best], result.lattice) @ to_ring + middle
    flat = np.zeros((len(last), 1))
    return Story(
        surface, domain, ends, np.hstack([first, flat]), np.hstack([last, flat]), cut.faces, parts, shares,
        np.asarray(cut.image[..., :3]), "torus", on_torus=True,
    ), shown  # fmt: skip


def _evenly(faces: Ints, count: int, divisions: int) -> tuple[Ints, csr_matrix]:
    """Divide triangles, each by itself; return the parts and their points as combinations of ``count`` vertices."""
    points = grid_points(divisions)
    share = np.column_stack([divisions - points.sum(axis=1), points]) / divisions
    rows = np.repeat(np.arange(len(faces) * len(share)), 3)
    columns = np.repeat(faces, len(share), axis=0).ravel()
    weights = csr_matrix((np.tile(share, (len(faces), 1)).ravel(), (rows, columns)), (len(faces) * len(share), count))
    parts = np.arange(len(faces))[:, None, None] * len(share) + grid_triangles(divisions)
    return parts.reshape(-1, 3).astype(np.int32), weights


__all__ = ["Story", "along_great_circles", "story_of"]
