"""Disjoint spherical caps with areas in given proportions, as large as an arrangement was found for.

Caps of radii r_i lie apart where the angles between their centres are at least r_i + r_j. From random centres on,
what overlaps is pushed apart by least squares (L-BFGS), and the share of the sphere that all caps cover is bisected.
Two caps can cover the sphere, equal ones in great number at most 91 % of it (Fejes Tóth 1943).
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import minimize

from omtwarp.mesh.arrays import ROUND_OFF, Floats

GAP = 0.02  # radians between caps: a seam to be seen, and far above the errors that SETTLED leaves
SETTLED = 1e-9  # sum of squared overlaps, radians², that counts as none; GAP absorbs them


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
    rng = np.random.default_rng(1943)
    starts = rng.normal(size=(4 if count <= 50 else 1, count, 3))  # arrangements to try; of many caps one suffices
    starts /= np.linalg.norm(starts, axis=2)[:, :, None]
    low, high = 0.02, 0.98
    best = _apart(starts[0], shares, low)
    while best is None:  # very many caps: gaps take most of the sphere
        low *= 0.5
        best = _apart(starts[0], shares, low)
    for _ in range(7):  # the covered share is then known to 1 %
        covered = 0.5 * (low + high)
        found = next(
            (placed for start in (best, *starts) if (placed := _apart(start, shares, covered)) is not None), None
        )
        if found is None:
            high = covered
        else:
            best, low = found, covered
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
        length = np.linalg.norm(raw, axis=1)[:, None]
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
    found = minimize(overlaps, start.ravel(), jac=True, method="L-BFGS-B", options={"maxiter": 500})
    if found.fun > SETTLED:
        return None
    placed = found.x.reshape(-1, 3)
    return placed / np.linalg.norm(placed, axis=1)[:, None]
