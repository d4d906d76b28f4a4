"""Newton steps of the few vertices that hold back the whole map.

On scans most of the remaining gain soon comes from a few hundredths of the vertices: on thin limbs, and where a step of
the whole map went too far. Their own matrix is small, so that several steps of theirs cost less than one of all
vertices.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from omtwarp.device.start import wp
from omtwarp.mesh.patches import Patches, grow
from omtwarp.refine.energy import DistortionEnergy, Terms
from omtwarp.refine.relaxation_kernels import Relaxing, relax_small_patches
from omtwarp.solvers.triangle_newton.newton import GROWTH
from omtwarp.solvers.triangle_newton.small_patches import SmallPatches

# A vertex is relaxed if it alone gains this many times what a step of all vertices gains on average for each.
MIN_GAIN_RATIO = 3.0
# No vertex counts for more than this share of the whole gain: a larger one would need a step beyond its tangent plane.
MAX_GAIN_SHARE = 0.01
FREED_RINGS = 2  # rings of vertices that move with each vertex chosen
MAX_CHOSEN_SHARE, MAX_FREED_SHARE = 0.15, 0.6  # of all vertices: beyond it a step of all costs no more
MAX_STEPS = 3  # Newton steps of the patches in one relaxation
MAX_HALVINGS = 12  # of a patch's step before the patch stays where it is


def stiff_vertices(decrements: NDArray[np.float64], gain: float) -> NDArray[np.bool_]:
    """Return a mask, shape [V], of the vertices with much more to gain than most; at least one is in it.

    Args:
        decrements: what moving each vertex alone is expected to gain, twice over, shape [V].
        gain: the same for moving all together.
    """
    counted = np.minimum(decrements, MAX_GAIN_SHARE * gain)
    chosen = counted > MIN_GAIN_RATIO * gain / len(counted)
    most = int(MAX_CHOSEN_SHARE * len(counted))
    if chosen.sum() > max(most, 1):
        chosen[:] = False
        chosen[np.argsort(-counted, kind="stable")[:most]] = True
    if not chosen.any():
        chosen[np.argmax(counted)] = True
    return chosen


def relax(
    energy: DistortionEnergy,
    points: wp.array,
    terms: Terms,
    weight: float,
    curvature_share: float,
    chosen: NDArray[np.bool_],
) -> tuple[wp.array, Terms, int] | None:
    """Move the vertices chosen, and some rings around them, to where they hold less distortion.

    Args:
        energy: of the surface's maps.
        points: a map without flips, vec3d, shape [V], on the device.
        terms: of the map.
        weight: λ.
        curvature_share: see :func:`omtwarp.refine.kernels.triangle_hessian`.
        chosen: the vertices, shape [V].

    Returns:
        The new map, its terms and how many vertices were freed; None where they are too many or nothing is gained.
    """
    surface = energy.surface
    freed = grow(surface.faces, chosen, FREED_RINGS)
    if freed.mean() > MAX_FREED_SHARE:
        return None
    patches = Patches.of_vertices(surface.faces, freed)
    small = SmallPatches.of(patches)
    if small is None:
        return None
    given = Relaxing()
    # Patches are a small part of the map's area: its scale is taken as constant.
    given.linear, given.inverse, given.barrier = energy.pressures(terms, weight)
    given.curvature_share, given.growth = curvature_share, GROWTH
    given.steps, given.halvings = MAX_STEPS, MAX_HALVINGS
    meshes = small.meshes(energy.triangles.frames.numpy()[patches.triangles], energy.areas[patches.triangles])
    sphere = points.numpy().copy()
    own = small.launch(relax_small_patches, sphere[patches.vertices], [meshes, given], [small.scratch()])
    sphere[patches.vertices[: patches.free]] = own
    moved = energy.upload(sphere)
    after = energy.terms(moved)
    return (moved, after, patches.free) if after.total(weight) < terms.total(weight) else None


__all__ = ["relax", "stiff_vertices"]
