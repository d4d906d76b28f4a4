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
from omtwarp.mesh.surface import triangle_areas
from omtwarp.render.camera import Camera, camera_axes
from omtwarp.render.domains import domain_name, domains_of, fits_of, placed_on, vertex_areas
from omtwarp.render.scene import Part, SurfaceView, normalisation, smooth_parts, welded_normals
from omtwarp.render.subject import FinishedMap, Picture, is_torus_map, map_view, torus_view
from omtwarp.render.upright import posed
from omtwarp.texturing.adaptive import rasterize
from omtwarp.texturing.smooth import grid_points, grid_triangles, smooth_map

if TYPE_CHECKING:
    from omtwarp.maps.torus_map import TorusMap

Floats = NDArray[np.float64]
Ints = NDArray[np.int32]


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
    smallest_sine = 1e-12  # of points next to their antipodes, between which no great circle is the shortest
    if time <= 0.0:
        return first
    if time >= 1.0:
        return last
    cosine = np.einsum("ij,ij->i", first, last)
    angle = np.arctan2(np.linalg.norm(np.cross(first, last), axis=1), cosine)[:, None]
    sine = np.maximum(np.sin(angle), smallest_sine)
    # Near, radians: between points nearer than this the great circle is a straight line
    near = angle < 1e-6
    ahead = np.where(near, time, np.sin(time * angle) / sine)
    behind = np.where(near, 1.0 - time, np.sin((1.0 - time) * angle) / sine)
    points = behind * first + ahead * last
    return points / np.maximum(np.linalg.norm(points, axis=1, keepdims=True), smallest_sine)


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
    # Texels around the sphere of a pattern: two to a pixel of the picture, of which a ball fills about a half.
    picture_widths = (512, 4096)
    least, most = picture_widths
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
    number = domains_of(result, len(faces))
    axes = camera_axes(camera, shown.up or "y", shown.front)
    disk = getattr(result, "disk", None)
    if disk is not None:
        points = np.column_stack([disk, np.zeros(len(disk))])
        domain = placed_on(points, faces, number, *fits_of(surface, points, faces, number, "disk", axes))
        ends = domain if weights is None else weights @ domain
    else:
        points = np.asarray(result.sphere)
        fits = fits_of(surface, points, faces, number, str(getattr(result, "domain", "sphere")), axes)
        domain = placed_on(points, faces, number, *fits)
        ends = placed_on(last, parts, np.repeat(number, len(parts) // len(faces)), *fits)
    picture, name = np.asarray(shown.image), domain_name(result)
    return Story(surface, domain, ends, first, last, faces, parts, weights, picture, name), shown


def _centred(shown: SurfaceView) -> Floats:
    """Return the vertices of a view around the origin, the farthest that is drawn at distance 1."""
    centre, radius = normalisation(shown)
    return (np.asarray(shown.vertices, dtype=np.float64) - centre) / radius


def _on_torus(
    result: TorusMap, pattern: str, image: Picture | None, texels: int, up: str | None, front: str | None
) -> tuple[Story, SurfaceView]:
    """Return the course of a film of a map to a torus, which ends with a ring torus."""
    tube_turns = 24  # beginnings along the tube of a ring torus that are compared
    from omtwarp.maps.torus_map import ring_torus, tube_radius
    from omtwarp.texturing.textured import texture_torus

    cut = texture_torus(result, image, None if image is not None else pattern, size=texels)
    shown = posed(torus_view(result, cut.image), up, front)
    surface = _centred(shown)
    weights = vertex_areas(surface, cut.faces)
    middle = np.average(surface, axis=0, weights=weights)
    tube = int(np.argmin(np.linalg.norm(result.lattice, axis=1)))  # the vector that goes around the tube
    # Fitted: vertices, at most, that they are compared at
    chosen = np.linspace(0, len(surface) - 1, min(4000, len(surface))).astype(int)
    steps = np.zeros((tube_turns, 2))
    steps[:, tube] = np.arange(tube_turns) / tube_turns
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
