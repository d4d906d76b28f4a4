"""Flat tori: the certificate of a map to one, and the ring torus that shows it."""

from dataclasses import dataclass

import numpy as np

from omtwarp.flips.exact import flipped_faces
from omtwarp.mesh.arrays import Floats, norms
from omtwarp.mesh.surface import plane_areas


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


def certify_torus(corners: Floats) -> TorusCertificate:
    """Establish the flips and the degree of a map to a flat torus.

    Args:
        corners: of its triangles, in multiples of the lattice's vectors, shape [F, 3, 2].
    """
    corner = corners.reshape(-1, 2)
    lifted = np.concatenate([corner, np.ones((len(corner), 1))], axis=1)
    flipped = np.flatnonzero(flipped_faces(lifted, np.arange(len(corner)).reshape(-1, 3)))
    whole = plane_areas(corners).sum()
    first = int(flipped[0]) if len(flipped) else -1
    return TorusCertificate(len(flipped), first, round(float(whole)) if np.isfinite(whole) else 0)


def tube_radius(lattice: Floats) -> float:
    """Return the radius of the tube of a lattice's ring torus; that of the ring is 1."""
    most_tube = 0.8  # radius of the tube over the ring's: a fatter one hides its inside
    along = norms(lattice)
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
    along = norms(lattice)
    share = tube_radius(lattice)
    tube, ring = (coordinates.T if along[0] <= along[1] else coordinates.T[::-1]) * (2.0 * np.pi)
    angle = tube.copy()
    # Kepler steps, of Newton's method, at most: from the mean anomaly, seven reach round-off with MOST_TUBE
    for _ in range(40):  # Newton's method on Kepler's equation; convex enough for every share below 1
        angle -= (angle + share * np.sin(angle) - tube) / (1.0 + share * np.cos(angle))
    reach = 1.0 + share * np.cos(angle)
    turned = -1.0 if along[0] <= along[1] else 1.0  # keeps triangles counter-clockwise from outside
    return np.stack([reach * np.cos(ring), reach * np.sin(ring), turned * share * np.sin(angle)], axis=1)
