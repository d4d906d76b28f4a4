"""Newton steps of the few vertices that hold back the whole map.

On scans most of the remaining gain soon comes from a few hundredths of the vertices: on thin limbs, and where a step of
the whole map went too far. Their own matrix is small, so that several steps of theirs cost less than one of all
vertices.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from omtwarp.device.arrays import empty
from omtwarp.device.start import ONE, wp
from omtwarp.errors import OmtwarpError
from omtwarp.mesh.patches import Patches, grow
from omtwarp.mesh.surface import SPHERE_AREA
from omtwarp.refine.energy import DistortionEnergy, Terms, TriangleKernels
from omtwarp.refine.kernels import put_vectors, take_vectors
from omtwarp.triangle_newton.line_search import search_patches
from omtwarp.triangle_newton.motion_kernels import from_tangent, retract_to_sphere, to_tangent, triangle_trouble
from omtwarp.triangle_newton.newton import NewtonMatrix

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


class Relaxation:
    """Moves patches of a surface's map, each by steps of its own length, that flip nothing.

    Args:
        energy: of the surface's maps.
        patches: what may move.
        points: the map, vec3d, shape [V], on the device.
        terms: of the map.
        weight: λ.
        curvature_share: see :func:`omtwarp.refine.kernels.triangle_hessian`.
    """

    def __init__(
        self,
        energy: DistortionEnergy,
        patches: Patches,
        points: wp.array,
        terms: Terms,
        weight: float,
        curvature_share: float,
    ):
        device, surface = energy.device, energy.surface
        self._device, self._patches, self._curvature_share = device, patches, curvature_share
        self._whole, self._vertices = points, self._sent(patches.vertices, wp.int32)
        self._points = self._taken(points, self._vertices)
        # Patches are a small part of the map's area: its scale is taken as constant.
        self._pressures = energy.pressures(terms, weight)
        self._areas = energy.areas[patches.triangles]
        self._matrix = NewtonMatrix.of_patches(patches, surface, energy.workspace)
        faces, areas = self._sent(patches.faces, wp.vec3i), self._sent(self._areas, wp.float64)
        frames = self._taken(energy.triangles.frames, self._sent(patches.triangles, wp.int32))
        rows = [array.to(device) for array in self._matrix.vertex_corners]
        self._triangles = TriangleKernels(faces, frames, areas, rows, energy.workspace)

    def run(self) -> wp.array:
        """Take a few steps of all patches, and return the map, vec3d, shape [V].

        Raises:
            OmtwarpError: the distortion is not finite.
        """
        for _ in range(MAX_STEPS):
            if not self._step():
                break
        out = wp.clone(self._whole)
        inputs = [self._vertices, self._points]
        wp.launch(put_vectors, dim=self._patches.free, inputs=inputs, outputs=[out], device=self._device)
        return out

    def _sent(self, values: NDArray[np.generic], dtype: type) -> wp.array:
        """Return an array on the device."""
        return wp.array(values, dtype=dtype, device=self._device, copy=False)

    def _taken(self, vectors: wp.array, places: wp.array) -> wp.array:
        """Gather the vectors at some indices on the device."""
        out = empty(len(places), wp.vec3d, self._device)
        wp.launch(take_vectors, dim=len(places), inputs=[vectors, places], outputs=[out], device=self._device)
        return out

    def _step(self) -> bool:
        """Take one step of all patches, and return whether any has moved."""
        patches, device, points = self._patches, self._device, self._points
        free = patches.free
        energies, volume = self._energies(points)
        gradient = self._gradient()
        blocks = self._triangles.hessian(points, self._pressures, self._curvature_share)
        self._matrix.factorise(blocks.numpy())
        coordinates = self._sent(-self._matrix.solve(gradient), wp.float64)
        vectors = empty(free, wp.vec3d, device)
        wp.launch(from_tangent, dim=free, inputs=[points, coordinates], outputs=[vectors], device=device)
        direction = coordinates.numpy()
        slope = patches.sum_of_vertices((direction * gradient).sum(axis=1))
        # No vertex moves farther than half a radian.
        longest = np.where(slope < 0.0, 1.0, 0.0) / np.maximum(1.0, 2.0 * patches.longest(direction))
        self._points, length = search_patches(
            lambda length: self._moved(vectors, length),
            lambda moved: self._energies(moved, volume)[0],
            energies,
            slope,
            longest,
            MAX_HALVINGS,
        )
        return bool(length.any())

    def _moved(self, vectors: wp.array, length: NDArray[np.float64]) -> wp.array:
        moved = wp.clone(self._points)
        share = self._sent(length[self._patches.vertex_patch], wp.float64)
        inputs = [self._points, vectors, share, ONE]
        wp.launch(retract_to_sphere, dim=self._patches.free, inputs=inputs, outputs=[moved], device=self._device)
        return moved

    def _energies(self, points: wp.array, before: wp.array | None = None) -> tuple[NDArray[np.float64], wp.array]:
        """Return the energy of every patch, infinite where a triangle lost too much of its volume, and the volumes."""
        count, device = len(self._areas), self._device
        outputs = self._triangles.terms(points)
        angle, ratio, _, steepness = (array.numpy() for array in outputs)
        linear, inverse, barrier = (float(number) for number in self._pressures)
        with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
            values = self._areas * (angle + linear * ratio + inverse / ratio + barrier * steepness) / SPHERE_AREA
        if before is not None:
            trouble = empty(count, wp.int32, device)
            inputs, found = [points, self._triangles.faces, before], wp.zeros(1, dtype=wp.int32, device=device)
            wp.launch(triangle_trouble, dim=count, inputs=inputs, outputs=[trouble, found], device=device)
            values[trouble.numpy() > 0] = np.inf
        return self._patches.sum_of_faces(values), outputs[2]

    def _gradient(self) -> NDArray[np.float64]:
        """Return the gradient by the freed vertices in their tangent bases, shape [free, 2]."""
        free, device, points = self._patches.free, self._device, self._points
        gradient = self._triangles.gradient(points, self._pressures)
        coordinates = wp.empty((free, 2), dtype=wp.float64, device=device)
        wp.launch(to_tangent, dim=free, inputs=[points, gradient], outputs=[coordinates], device=device)
        return coordinates.numpy()


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
    try:
        moved = Relaxation(energy, patches, points, terms, weight, curvature_share).run()
    except OmtwarpError:
        return None
    after = energy.terms(moved)
    return (moved, after, patches.free) if after.total(weight) < terms.total(weight) else None


__all__ = ["relax", "stiff_vertices"]
