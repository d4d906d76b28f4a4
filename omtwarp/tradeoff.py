"""Maps between conformal and area preserving: the mass-preserving map of a density raised to a power.

With μ the density of a conformal map (equation 4), μ^p for 0 <= p <= 1 prescribes part of the change of area only:
p = 0 keeps the conformal map, p = 1 preserves area. Moser's flow (section 4.2) makes the map, and the distortion
energy of :mod:`omtwarp.refine` evens it out. It weighs every triangle by the area that it is to have on the sphere, so
that for given areas there the angle distortion by area on the sphere, the paper's, is what becomes least.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from omtwarp.device.policy import resolve_device
from omtwarp.errors import OmtwarpError
from omtwarp.flips.predicates import count_flips
from omtwarp.mesh.arrays import TINY
from omtwarp.mesh.surface import Surface, triangle_areas
from omtwarp.moser import moser_map
from omtwarp.refine.solver import Refiner
from omtwarp.untangling.untangle import untangle

# The weight of area against angle: enough to keep the prescribed areas; more only raises angle distortion.
WEIGHT = 10.0
ITERATIONS = 100
TOLERANCE = 1e-4


def map_with_density_exponent(
    surface: Surface,
    conformal: ArrayLike,
    exponent: float,
    *,
    weight: float | None = WEIGHT,
    device: str | None = "auto",
) -> NDArray[np.float64]:
    """Map a surface so that areas lie between those of the conformal map and those of the surface.

    Args:
        surface: the surface, V vertices.
        conformal: its conformal map (or the substitute) without flips, unit vectors, shape [V, 3].
        exponent: p, from 0 (angles) to 1 (areas). A triangle of density μ that covers the area a on the conformal
            sphere is to cover a part of the sphere proportional to a μ^p.
        weight: how much deviations from these areas count against angle distortion; None leaves Moser's map as it is.
        device: where the kernels run.

    Returns:
        The map, unit vectors, float64, shape [V, 3].

    Raises:
        OmtwarpError: the exponent is outside 0 to 1, or flips could not be undone.
    """
    if not 0.0 <= exponent <= 1.0:
        raise OmtwarpError(f"the density exponent is {exponent}: it must be between 0 and 1")
    start = np.array(conformal, dtype=np.float64)
    on_sphere = np.maximum(triangle_areas(start, surface.faces), TINY)
    # a μ^p = A^p a^(1-p), in logarithms since a may be as good as zero.
    areas = np.exp(exponent * np.log(surface.face_areas) + (1.0 - exponent) * np.log(on_sphere))
    target = surface.with_areas(areas)
    sphere = moser_map(target, start, device=device).sphere
    if count_flips(sphere, surface.faces, device=device):
        sphere = untangle(target, sphere, device=device).sphere
        flips = count_flips(sphere, surface.faces, device=device)
        if flips:
            raise OmtwarpError(f"the density exponent {exponent} leaves {flips} flipped triangles: try a smaller one")
    if weight is None:
        return sphere
    refiner = Refiner(target, resolve_device(device))
    return refiner.minimise(sphere, weight, iterations=ITERATIONS, tolerance=TOLERANCE).sphere


__all__ = ["map_with_density_exponent"]
