"""Optimal plans between points on the sphere, by POT, to compare maps and bounds with."""

import numpy as np
import ot
from numpy.typing import ArrayLike


def exact_transport(
    sources: ArrayLike, source_masses: ArrayLike, targets: ArrayLike, target_masses: ArrayLike
) -> tuple[float, float]:
    """Return the optimal plan between two sets of points on the sphere, by network simplex (POT's ``emd``).

    Memory is 8 bytes for every pair of points, several times over: for a few thousand points.

    Args:
        sources: unit vectors, shape [N, 3].
        source_masses: shape [N], scaled to sum to 4π.
        targets: unit vectors, shape [K, 3].
        target_masses: shape [K], scaled to sum to 4π.

    Returns:
        The least Σ plan_ij d(x_i, z_j)², and Σ m_i d(x_i, z̄_i)² with z̄_i the mean image of x_i under the plan. The
        second omits most of the cost of spreading a point over many targets; compare it with a map's cost when the
        targets are finer than the sources.

    Raises:
        RuntimeError: the solver gives up.
    """
    x, z = (np.ascontiguousarray(p, dtype=np.float64) for p in (sources, targets))
    a, b = (np.asarray(w, dtype=np.float64) / np.sum(w) for w in (source_masses, target_masses))
    squared = 2.0 * np.arcsin(np.clip(np.sqrt(np.maximum(2.0 - 2.0 * (x @ z.T), 0.0)) / 2.0, 0.0, 1.0))
    squared *= squared
    # Most pivots, of the network simplex: POT's default of 100,000 ends too soon above some thousand points
    plan, log = ot.emd(a, b, squared, numItermax=10_000_000, log=True)
    if log.get("warning"):
        raise RuntimeError(f"the exact optimum was not found: {log['warning']}")
    mean = plan @ z
    mean /= np.linalg.norm(mean, axis=1)[:, None]
    angle = 2.0 * np.arcsin(np.clip(np.linalg.norm(x - mean, axis=1) / 2.0, 0.0, 1.0))
    return 4.0 * np.pi * float((plan * squared).sum()), 4.0 * np.pi * float(a @ angle**2)
