"""Newton steps of the few vertices that hold back the whole map.

On scans most of what is left to gain soon lies with a few hundredths of the vertices: thin limbs, and what a step of
the whole map bent too far. Their own matrix is small, so that several steps of theirs cost less than one of all.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from omtwarp._warp import ONE, wp
from omtwarp.errors import OmtwarpError
from omtwarp.mesh.patches import Patches, grow
from omtwarp.mesh.surface import SPHERE_AREA
from omtwarp.refine.energy import DistortionEnergy, Terms
from omtwarp.refine.kernels import (
    from_tangent,
    gather_tangent,
    retract,
    to_tangent,
    triangle_gradient,
    triangle_hessian,
    triangle_terms,
    triangle_trouble,
)
from omtwarp.refine.newton import NewtonMatrix
from omtwarp.threads import launch_parts

WORTH = 3.0  # times what a step of all gains for each vertex: those that gain more alone are worth a step of their own
LARGEST = 0.01  # of what could be gained, that one vertex counts for: the rest would be gained beyond its tangent plane
RINGS = 2  # freed around them
MOST_CHOSEN, MOST_FREED = 0.15, 0.6  # of all vertices: with more than that a step of all costs no more
STEPS = 3
HALVINGS = 12
SUFFICIENT = 1e-4  # of the slope: Armijo's condition
DIAGONAL_GROWTH = 1e-9  # of every entry of the diagonal: the Hessian is only semidefinite


def stiff_vertices(decrements: NDArray[np.float64], gain: float) -> NDArray[np.bool_]:
    """The vertices with far more to gain than most, as a mask of shape [V]; one at least.

    Args:
        decrements: what moving each vertex alone is expected to gain, twice over, shape [V].
        gain: the same for moving all together.
    """
    counted = np.minimum(decrements, LARGEST * gain)
    order = np.argsort(-counted, kind="stable")
    count = min(int((counted > WORTH * gain / len(counted)).sum()), int(MOST_CHOSEN * len(counted)))
    chosen = np.zeros(len(counted), dtype=bool)
    chosen[order[: max(count, 1)]] = True
    return chosen


class Relaxation:
    """Moves patches of a surface's map, each by steps of its own length, that flip nothing.

    Args:
        energy: of the surface's maps.
        patches: what may move.
        points: the map, vec3d, shape [V], on the device.
        terms: of the map.
        weight: λ.
        caution: see :func:`omtwarp.refine.kernels.triangle_hessian`.
    """

    def __init__(
        self, energy: DistortionEnergy, patches: Patches, points: wp.array, terms: Terms, weight: float, caution: float
    ):
        device, surface = energy.device, energy.surface
        self._device, self._patches, self._caution = device, patches, caution
        self._whole = points.numpy()
        self._points = wp.array(self._whole[patches.vertices], dtype=wp.vec3d, device=device)
        # Of the whole map's area patches are a small part: its scale is taken to stay.
        self._pressures = energy.pressures(terms, weight)
        self._areas = surface.face_areas[patches.triangles]
        self._faces = wp.array(patches.faces, dtype=wp.vec3i, device=device)
        frames = energy.d_frames.numpy()[patches.triangles]
        self._frames = wp.array(frames, dtype=wp.vec3d, device=device)
        self._d_areas = wp.array(self._areas, dtype=wp.float64, device=device)
        freed = surface.scaled_vertices[patches.vertices[: patches.free]]
        self._matrix = NewtonMatrix.of_patches(patches, freed, DIAGONAL_GROWTH)
        self._offsets, self._corners = (array.to(device) for array in self._matrix.vertex_corners)

    def run(self) -> wp.array:
        """The map after a few steps, vec3d, shape [V].

        Raises:
            OmtwarpError: the distortion is not finite.
        """
        for _ in range(STEPS):
            if not self._step():
                break
        free = self._patches.free
        out = self._whole.copy()
        out[self._patches.vertices[:free]] = self._points.numpy()[:free]
        return wp.array(out, dtype=wp.vec3d, device=self._device)

    def _step(self) -> bool:
        """One step of all patches; whether any has moved."""
        patches, device, points = self._patches, self._device, self._points
        free = patches.free
        energies, volume = self._energies(points)
        gradient = self._gradient()
        self._matrix.factorise(self._hessian())
        coordinates = wp.array(-self._matrix.solve(gradient), dtype=wp.float64, device=device)
        vectors = wp.empty(free, dtype=wp.vec3d, device=device)
        wp.launch(from_tangent, dim=free, inputs=[points, coordinates], outputs=[vectors], device=device)
        direction = coordinates.numpy()
        patch = patches.vertex_patch
        slope = np.bincount(patch, (direction * gradient).sum(axis=1), minlength=patches.count)
        reach = np.zeros(patches.count)
        np.maximum.at(reach, patch, np.linalg.norm(direction, axis=1))
        length = np.where(slope < 0.0, 1.0, 0.0) / np.maximum(1.0, 2.0 * reach)  # no farther than half a radian
        for _ in range(HALVINGS):
            moved = self._moved(vectors, length)
            after, _ = self._energies(moved, volume)
            worse = ~(after <= energies + SUFFICIENT * length * slope)
            if not worse.any():
                break
            length[worse] *= 0.5
        else:
            length[worse] = 0.0
            moved = self._moved(vectors, length)
        self._points = moved
        return bool(length.any())

    def _moved(self, vectors: wp.array, length: NDArray[np.float64]) -> wp.array:
        moved = wp.clone(self._points)
        share = wp.array(length[self._patches.vertex_patch], dtype=wp.float64, device=self._device)
        inputs = [self._points, vectors, share, ONE]
        wp.launch(retract, dim=self._patches.free, inputs=inputs, outputs=[moved], device=self._device)
        return moved

    def _energies(self, points: wp.array, before: wp.array | None = None) -> tuple[NDArray[np.float64], wp.array]:
        """Energy of every patch, infinite where a triangle lost too much of its volume before, and the volumes."""
        count, device = len(self._areas), self._device
        outputs = [wp.empty(count, dtype=wp.float64, device=device) for _ in range(4)]
        self._of_triangles(
            triangle_terms,
            lambda part: ([points, self._faces[part], self._frames[part]], [array[part] for array in outputs]),
        )
        angle, ratio, _, steepness = (array.numpy() for array in outputs)
        linear, inverse, barrier = (float(number) for number in self._pressures)
        with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
            values = self._areas * (angle + linear * ratio + inverse / ratio + barrier * steepness) / SPHERE_AREA
        if before is not None:
            trouble = wp.empty(count, dtype=wp.int32, device=device)
            inputs, found = [points, self._faces, before], wp.zeros(1, dtype=wp.int32, device=device)
            wp.launch(triangle_trouble, dim=count, inputs=inputs, outputs=[trouble, found], device=device)
            values[trouble.numpy() > 0] = np.inf
        energies = np.bincount(self._patches.face_patch, values, minlength=self._patches.count)
        return energies.astype(np.float64, copy=False), outputs[2]

    def _gradient(self) -> NDArray[np.float64]:
        """Gradient by the freed vertices in their tangent bases, shape [free, 2]."""
        free, device, points = self._patches.free, self._device, self._points
        corners = wp.empty(3 * len(self._areas), dtype=wp.vec3d, device=device)
        self._of_triangles(
            triangle_gradient,
            lambda part: (
                [points, self._faces[part], self._frames[part], self._d_areas[part], *self._pressures],
                [corners[3 * part.start : 3 * part.stop]],
            ),
        )
        gradient = wp.empty(free, dtype=wp.vec3d, device=device)
        inputs = [points, self._offsets, self._corners, corners, wp.float64(SPHERE_AREA)]
        wp.launch(gather_tangent, dim=free, inputs=inputs, outputs=[gradient], device=device)
        coordinates = wp.empty((free, 2), dtype=wp.float64, device=device)
        wp.launch(to_tangent, dim=free, inputs=[points, gradient], outputs=[coordinates], device=device)
        return coordinates.numpy()

    def _hessian(self) -> NDArray[np.float64]:
        blocks = wp.empty((len(self._areas), 21), dtype=wp.float64, device=self._device)
        numbers = [*self._pressures, wp.float64(self._caution), wp.float64(SPHERE_AREA)]
        self._of_triangles(
            triangle_hessian,
            lambda part: (
                [self._points, self._faces[part], self._frames[part], self._d_areas[part], *numbers],
                [blocks[part]],
            ),
        )
        return blocks.numpy()

    def _of_triangles(self, kernel, arguments) -> None:
        launch_parts(kernel, len(self._areas), arguments, self._device)


def relax(
    energy: DistortionEnergy,
    points: wp.array,
    terms: Terms,
    weight: float,
    caution: float,
    chosen: NDArray[np.bool_],
) -> tuple[wp.array, Terms, int] | None:
    """Move the vertices chosen, and some rings around them, to where they hold less distortion.

    Args:
        energy: of the surface's maps.
        points: a map without flips, vec3d, shape [V], on the device.
        terms: of the map.
        weight: λ.
        caution: see :func:`omtwarp.refine.kernels.triangle_hessian`.
        chosen: the vertices, shape [V].

    Returns:
        The new map, its terms and how many vertices were freed; None where they are too many or nothing is gained.
    """
    surface = energy.surface
    freed = grow(surface.faces, chosen, RINGS)
    if freed.mean() > MOST_FREED:
        return None
    patches = Patches.of_vertices(surface.faces, freed)
    try:
        moved = Relaxation(energy, patches, points, terms, weight, caution).run()
    except OmtwarpError:
        return None
    after = energy.terms(moved)
    return (moved, after, patches.free) if after.total(weight) < terms.total(weight) else None


__all__ = ["relax", "stiff_vertices"]
