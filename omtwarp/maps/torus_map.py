"""A finished map of a surface of genus 1 to a flat torus, and its file."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from functools import cached_property
from typing import cast

import numpy as np
from numpy.typing import NDArray

from omtwarp.errors import OmtwarpError
from omtwarp.flips.exact import flipped_faces
from omtwarp.maps import result
from omtwarp.maps.result import MapReport, MapResult, StoredMap
from omtwarp.mesh.arrays import Floats, Ints
from omtwarp.mesh.surface import plane_areas
from omtwarp.metrics.distortion import Distortion, measure_corners
from omtwarp.options import Record


class TorusReport(MapReport, total=False):
    """How a map to a torus was made, as plain values ready for JSON, and the unit of its coordinates."""

    domain: str
    quantum: float


@dataclass(frozen=True)
class TorusCertificate:
    """Facts established about a map to a torus: its flips and its degree.

    Attributes:
        flips: triangles that are not counter-clockwise in the universal cover, decided exactly.
        first_flip: index of the first of them, or -1.
        degree: how often the torus is covered: the triangles' signed area over the torus's, rounded.
    """

    flips: int
    first_flip: int
    degree: int

    @property
    def bijective(self) -> bool:
        """No flip and degree 1: a point that is covered once by triangles of one orientation has one preimage."""
        return self.flips == 0 and self.degree == 1

    def to_dict(self) -> dict[str, int | bool]:
        """Convert to plain values, ready for JSON."""
        return vars(self) | {"bijective": self.bijective}

    def __str__(self) -> str:
        where = f" (the first is face {self.first_flip})" if self.flips else ""
        return f"{self.flips} flipped triangles{where}, degree {self.degree}"


@dataclass(frozen=True, eq=False, repr=False)
class TorusMap(StoredMap):
    """A surface and its map to the flat torus R² / Λ.

    The corner ``k`` of triangle ``f`` lies at ``corners[f, k] @ lattice`` in the plane.

    Attributes:
        vertices: the surface as given, float64, shape [V, 3].
        faces: int32, shape [F, 3].
        coordinates: of the vertices, in multiples of the lattice's vectors, float64, shape [V, 2].
        wraps: whole numbers that are added at the corners of triangles, int64, shape [F, 3, 2].
        lattice: the vectors that the torus repeats along, as rows, shape [2, 2]; the torus has the surface's area.
        conformal: the conformal map that distances are measured from, as ``coordinates``, shape [V, 2].
        vertex_origin: after a repair, the index of every vertex in the mesh before it, shape [V].
        face_origin: the same of the faces, shape [F].
        split_edges: the two vertices that each vertex of origin -1 lies halfway between, in their order, shape [K, 2].
        history: one record per step of the transport.
        report: how the map was made, ready for JSON.

    Example:
        >>> import trimesh
        >>> from omtwarp import map_surface
        >>> ring = trimesh.creation.torus(1.0, 0.4, major_sections=12, minor_sections=6)
        >>> result = map_surface(ring, domain="torus")
        >>> result
        TorusMap(72 vertices, 144 faces)
        >>> result.certificate.flips, result.certificate.degree
        (0, 1)
    """

    vertices: Floats = field(metadata=result.stored(np.float64, "V", 3))
    faces: Ints = field(metadata=result.stored(np.int32, "F", 3))
    coordinates: Floats = field(metadata=result.stored(np.float64, "V", 2))
    wraps: NDArray[np.int64] = field(metadata=result.stored(np.int64, "F", 3, 2))
    lattice: Floats = field(metadata=result.stored(np.float64, 2, 2))
    conformal: Floats = field(metadata=result.stored(np.float64, "V", 2))
    vertex_origin: NDArray[np.int64] | None = field(default=None, metadata=result.stored(np.int64, "V"))
    face_origin: NDArray[np.int64] | None = field(default=None, metadata=result.stored(np.int64, "F"))
    split_edges: NDArray[np.int64] | None = field(default=None, metadata=result.stored(np.int64, "K", 2), kw_only=True)

    history: list[Record] = field(default_factory=list)
    report: TorusReport = field(default_factory=lambda: cast(TorusReport, {}))

    domain = "torus"
    required = ("vertices", "faces", "coordinates", "wraps", "lattice", "conformal")
    kind = "a map to a torus"

    def __repr__(self) -> str:
        return f"TorusMap({len(self.vertices)} vertices, {len(self.faces)} faces)"

    @property
    def corners(self) -> Floats:
        """Corners of the triangles in multiples of the lattice's vectors, shape [F, 3, 2]; the sums are exact."""
        return self.coordinates[self.faces] + self.wraps

    @property
    def maps(self) -> dict[str, Floats]:
        """The maps of the stages as ``coordinates``, by name; ``torus`` is the final one."""
        return {"conformal": self.conformal, "torus": self.coordinates}

    @cached_property
    def certificate(self) -> TorusCertificate:
        """The flips and the degree of the map, established from its arrays at the first access."""
        corner = self.corners.reshape(-1, 2)
        lifted = np.concatenate([corner, np.ones((len(corner), 1))], axis=1)
        flipped = np.flatnonzero(flipped_faces(lifted, np.arange(len(corner)).reshape(-1, 3)))
        whole = plane_areas(self.corners).sum()
        first = int(flipped[0]) if len(flipped) else -1
        return TorusCertificate(len(flipped), first, round(float(whole)) if np.isfinite(whole) else 0)

    @property
    def bijective(self) -> bool:
        """Whether the map is one to one and onto: see :attr:`certificate`."""
        return self.certificate.bijective

    def distortion(self, stage: str = "torus") -> Distortion:
        """Measure the distortion of the map (or of the conformal map), as for maps to the sphere.

        Raises:
            OmtwarpError: the stage is unknown.
        """
        places = self.maps.get(stage) if isinstance(stage, str) else None
        if places is None:
            raise OmtwarpError(f"this map has no stage '{stage}'")
        corner = (places[self.faces] + self.wraps) @ self.lattice
        return measure_corners(self.vertices[self.faces], corner, abs(float(np.linalg.det(self.lattice))))

    def ring(self) -> Floats:
        """Map the vertices to a ring torus, with areas in proportion to those of the surface, shape [V, 3].

        The ring's radii are in the proportion of the lattice's vectors, the tube at most 0.8 of the ring.
        """
        return ring_torus(self.coordinates, self.lattice)


TorusMap.layout = result.layout_of(TorusMap)


def tube_radius(lattice: Floats) -> float:
    """Return the radius of the tube of a lattice's ring torus; that of the ring is 1."""
    most_tube = 0.8  # radius of the tube over the ring's: a fatter one hides its inside
    along = np.linalg.norm(lattice, axis=1)
    return min(float(along.min() / along.max()), most_tube)


def ring_torus(coordinates: Floats, lattice: Floats) -> Floats:
    """Map points of a flat torus to a ring torus with areas in proportion, shape [N, 3].

    The first coordinate goes around the tube and the second around the ring. The radii are in the proportion of the
    lattice's vectors, the tube at most 0.8 of the ring; along the tube the angle t grows such that t + (r/R) sin t, to
    which the area from the outside on is proportional, grows evenly.

    Args:
        coordinates: in multiples of the lattice's vectors, shape [N, 2].
        lattice: the vectors, as rows, shape [2, 2].
    """
    along = np.linalg.norm(lattice, axis=1)
    share = tube_radius(lattice)
    tube, ring = (coordinates.T if along[0] <= along[1] else coordinates.T[::-1]) * (2.0 * np.pi)
    angle = tube.copy()
    # Kepler steps, of Newton's method, at most: from the mean anomaly, seven reach round-off with MOST_TUBE
    for _ in range(40):  # Newton's method on Kepler's equation; convex enough for every share below 1
        angle -= (angle + share * np.sin(angle) - tube) / (1.0 + share * np.cos(angle))
    reach = 1.0 + share * np.cos(angle)
    turned = -1.0 if along[0] <= along[1] else 1.0  # keeps triangles counter-clockwise from outside
    return np.stack([reach * np.cos(ring), reach * np.sin(ring), turned * share * np.sin(angle)], axis=1)


def read_map(path: str | os.PathLike[str]) -> MapResult | TorusMap:
    """Read a map of any kind; the file is opened once.

    Raises:
        OmtwarpError: the file is missing, or is no map.
    """
    arrays = result.read_map_arrays(path, MapResult, TorusMap)
    kind = TorusMap if any(name in arrays for name in result.OF_TORUS_MAPS) else MapResult
    return kind.from_arrays(arrays, path)
