"""Caps of the sphere: Lambert's equal-area azimuthal projection to them, and disjoint ones in given proportions.

The projection takes the hemisphere to the unit disk, and that to caps of any size (J. P. Snyder, Map Projections: A
Working Manual, USGS Professional Paper 1395, 1987, section 24). It keeps ratios of areas exactly where it is smooth. It
does not keep the property of being optimal: a map to the hemisphere that is optimal for the squared distance on the
sphere gives a map to the disk that is optimal for the distance of the hemisphere's points, not for that in the plane.

Disjoint caps are as large as an arrangement was found for. Caps of radii r_i lie apart where the angles between their
centres are at least r_i + r_j. From random centres on, what overlaps is pushed apart by least squares (L-BFGS), and the
share of the sphere that all caps cover is bisected. Two caps can cover the sphere, equal ones in great number at most
91 % of it (Fejes Tóth 1943).
"""

import numpy as np
from scipy.optimize import minimize

from omtwarp.mesh.arrays import ROUND_OFF, Floats, normalised, norms

GAP = 0.02  # radians between caps: a seam to be seen, and far above the errors that SETTLED leaves
SETTLED = 1e-9  # sum of squared overlaps, radians², that counts as none; GAP absorbs them


def hemisphere_to_disk(points: Floats, conformal: bool = False) -> Floats:
    """Project the upper unit hemisphere, shape [V, 3], to the unit disk, shape [V, 2], the equator to its circle.

    The distance from the middle is sqrt(1 - z): a zone of the sphere has the area of its ring, up to the factor 2. With
    ``conformal`` the projection is the stereographic one, which keeps angles.

    >>> import numpy as np
    >>> hemisphere_to_disk(np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0]])).tolist()
    [[0.0, 0.0], [0.0, 1.0]]
    """
    nearer = 1.0 + points[:, 2]
    return points[:, :2] / (nearer if conformal else np.sqrt(nearer))[:, None]


def disk_to_cap(disk: Floats, share: float, conformal: bool = False) -> Floats:
    """Project the unit disk, shape [V, 2], to the cap around the north pole with a share of the sphere's area.

    Args:
        disk: points with |p| <= 1.
        share: of the area of the whole sphere, between 0 and 1; 0.5 gives the hemisphere.
        conformal: keep angles in place of areas.
    """
    square = np.einsum("ij,ij->i", disk, disk)
    if conformal:
        slope = np.sqrt(share / (1.0 - share))  # tangent of half the cap's radius
        radial = 2.0 * slope / (1.0 + slope**2 * square)
        height = radial / slope - 1.0
    else:
        # A point at distance r is where the cap around the pole has the share s r², at height 1 - 2 s r².
        height = 1.0 - 2.0 * share * square
        radial = 2.0 * np.sqrt(share * (1.0 - share * square))
    return np.concatenate([disk * radial[:, None], height[:, None]], axis=1)


def pack_caps(shares: Floats) -> tuple[Floats, float]:
    """Place disjoint caps on the sphere.

    Args:
        shares: of the caps in all that they cover together, sum 1, shape [P].

    Returns:
        Unit vectors of their centres, shape [P, 3], and the share of the sphere that they cover; cap i has that times
        ``shares[i]``. With one cap the covered share is 1.

    >>> import numpy as np
    >>> centres, covered = pack_caps(np.array([0.5, 0.5]))
    >>> bool(centres[0] @ centres[1] < -0.999), covered > 0.95
    (True, True)
    """
    count = len(shares)
    if count == 1:
        return np.array([[0.0, 0.0, 1.0]]), 1.0
    size = 4 if count <= 50 else 1, count, 3  # arrangements to try; of many caps one suffices
    starts = normalised(np.random.default_rng(1943).normal(size=size))
    low, high = 0.02, 0.98
    while (best := _apart(starts[0], shares, low)) is None:
        low *= 0.5  # very many caps: gaps take most of the sphere
    for _ in range(7):  # the covered share is then known to 1 %
        covered = 0.5 * (low + high)
        packings = (_apart(start, shares, covered) for start in (best, *starts))
        packing = next((placed for placed in packings if placed is not None), None)
        if packing is None:
            high = covered
        else:
            best, low = packing, covered
    return best, low


def cap_radius(share: Floats) -> Floats:
    """Return the angle between centre and rim of a cap with a share of the sphere's area."""
    return np.arccos(np.clip(1.0 - 2.0 * share, -1.0, 1.0))


def _apart(start: Floats, shares: Floats, covered: float) -> Floats | None:
    """Move the centres of caps from a start until no two overlap; None where some still do."""
    radius = cap_radius(covered * shares)
    i, j = np.triu_indices(len(shares), 1)
    least = radius[i] + radius[j] + GAP
    if least.max() > np.pi:
        return None

    def overlaps(flat: Floats) -> tuple[float, Floats]:
        raw = flat.reshape(-1, 3)
        length = norms(raw)[:, None]
        place = raw / length
        cosine = np.clip(np.einsum("ij,ij->i", place[i], place[j]), -1.0 + ROUND_OFF, 1.0 - ROUND_OFF)
        missing = np.maximum(least - np.arccos(cosine), 0.0)
        slope = (2.0 * missing / np.sqrt(1.0 - cosine**2))[:, None]
        pull = np.zeros_like(raw)
        np.add.at(pull, i, slope * place[j])
        np.add.at(pull, j, slope * place[i])
        pull -= np.einsum("ij,ij->i", pull, place)[:, None] * place
        return float((missing**2).sum()), (pull / length).ravel()

    # 100 unequal caps took 172 steps, 30 took 231.
    solution = minimize(overlaps, start.ravel(), jac=True, method="L-BFGS-B", options={"maxiter": 500})
    return normalised(solution.x.reshape(-1, 3)) if solution.fun <= SETTLED else None
