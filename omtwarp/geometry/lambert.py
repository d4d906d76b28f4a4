"""Lambert's equal-area azimuthal projection: hemisphere to unit disk, and to spherical caps of any size.

Both maps keep ratios of areas exactly where they are smooth. They do not keep the property of being optimal: a map to
the hemisphere that is optimal for the squared distance on the sphere gives a map to the disk that is optimal for the
distance of the hemisphere's points, not for the distance in the plane.

Source: J. P. Snyder, Map Projections: A Working Manual, USGS Professional Paper 1395 (1987), section 24.
"""

from __future__ import annotations

import numpy as np

from omtwarp.mesh.arrays import Floats


def hemisphere_to_disk(points: Floats) -> Floats:
    """Project the upper unit hemisphere, shape [V, 3], to the unit disk, shape [V, 2], the equator to its circle.

    The distance from the middle is sqrt(1 - z): a zone of the sphere has the area of its ring, up to the factor 2.

    >>> import numpy as np
    >>> hemisphere_to_disk(np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0]])).tolist()
    [[0.0, 0.0], [0.0, 1.0]]
    """
    return points[:, :2] / np.sqrt(1.0 + points[:, 2])[:, None]


def disk_to_cap(disk: Floats, share: float) -> Floats:
    """Project the unit disk, shape [V, 2], to the cap around the north pole with a share of the sphere's area.

    Args:
        disk: points with |p| <= 1.
        share: of the area of the whole sphere, between 0 and 1; 0.5 gives the hemisphere.
    """
    square = np.einsum("ij,ij->i", disk, disk)
    # A point at distance r is where the cap around the pole has the share s r², at height 1 - 2 s r².
    height = 1.0 - 2.0 * share * square
    radial = 2.0 * np.sqrt(share * (1.0 - share * square))
    return np.concatenate([disk * radial[:, None], height[:, None]], axis=1)


def to_gnomonic(cap: Floats, share: float) -> Floats:
    """Project a cap with a share below 0.5 to the unit disk so that great circles become straight.

    Args:
        cap: unit vectors around the north pole, shape [V, 3].
        share: of the sphere's area; the rim goes to the unit circle.

    Returns:
        Shape [V, 2].
    """
    return cap[:, :2] / cap[:, 2:] / _gnomonic_radius(share)


def from_gnomonic(disk: Floats, share: float) -> Floats:
    """Undo :func:`to_gnomonic`: points of the unit disk, shape [V, 2], as unit vectors, shape [V, 3]."""
    points = np.concatenate([_gnomonic_radius(share) * disk, np.ones((len(disk), 1))], axis=1)
    return points / np.linalg.norm(points, axis=1)[:, None]


def _gnomonic_radius(share: float) -> float:
    """Return the tangent of the angle between the centre and the rim of a cap."""
    height = 1.0 - 2.0 * share
    return float(np.sqrt(1.0 - height**2) / height)
