"""Steps of a whole map that flip no triangle: triangles that a step flips are untangled after it, or held back."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from omtwarp.device.arrays import empty, vectors
from omtwarp.device.start import wp
from omtwarp.device.sums import Reading
from omtwarp.flips.exact import flipped_faces
from omtwarp.mesh.arrays import Floats
from omtwarp.mesh.surface import Surface
from omtwarp.solvers.motion_kernels import hold_back, retract_to_sphere, triangle_trouble
from omtwarp.untangling.untangle import Attempt, RepairBudget, untangle_patches

# Rings of vertices freed around the few triangles that a step flips, and the first ε of their repair, before the step
# is shortened: with smaller ones they move less far from where it took them. Of five hemispheres with long limbs all
# end within 20 steps, with an ε of 1 three of them in 40.
REPAIR_RINGS, REPAIR_EPSILON = 2, 0.1
REPAIR = Attempt(REPAIR_RINGS, largest=REPAIR_EPSILON)


class FlipFreeSteps:
    """Moves maps of one surface along directions.

    Args:
        surface: the surface, V vertices and F faces.
        device: a Warp device.
    """

    def __init__(self, surface: Surface, device: wp.Device):
        self._surface, self._device = surface, device
        self._reading = Reading(device)
        self._examined = surface.face_count  # the first triangles, which are looked at after a step
        mesh = surface.on(device)
        self._faces, self._rows = mesh.faces, mesh.vertex_corners
        # Of the budget of one repair, for all steps of a minimisation: a body with eight thin arms takes four fifths of
        # it.
        self.budget = RepairBudget(surface, 3.0)
        self._refused = False

    def tried(
        self, points: wp.array, direction: wp.array, volume: wp.array, length: float, reading: Reading
    ) -> tuple[wp.array, wp.array, int]:
        """Move points by the whole step, and begin to look for triangles that it flips or nearly flattens.

        Args:
            points: a map without flips, vec3d, shape [V].
            direction: tangent to the sphere, vec3d, shape [V].
            volume: det[s0, s1, s2] of the triangles of the map, shape [F].
            length: of the step.
            reading: of numbers from the device.

        Returns:
            The map, marks of these triangles, float64, shape [F], and the place of the largest in what is read.
        """
        moved = self._moved(points, direction, None, length)
        marks = self._marks(moved, volume)
        return moved, marks, reading.largest(marks)

    def untangled(self, moved: wp.array, marks: wp.array, weight: float) -> tuple[wp.array, int] | None:
        """Untangle the patches around triangles that a step flips.

        Holding a few vertices back while those around them move would tangle them more.

        Args:
            moved: the map after the step, vec3d, shape [V].
            marks: of these triangles, as of :meth:`tried`.
            weight: λ of the energy that untangling minimises.

        Returns:
            The map and how many vertices were untangled; None where that fails.
        """
        seeds = marks.numpy() > 0
        # Most trouble, of the triangles: with more than that the step itself is too long
        if seeds.mean() > 0.05:
            return None
        if self.budget.exhausted:
            self._refused = True
            return None
        sphere, count = untangle_patches(
            self._surface, moved.numpy(), seeds, REPAIR, self._device, self.budget, weight=weight
        )
        sphere = self._admitted(sphere)
        if self._counted(flipped_faces(sphere, self._surface.faces)).any():
            return None
        return vectors(sphere, self._device), count

    @property
    def gave_up(self) -> str:
        """Say that untangling was wanted after it had taken what it may take; empty where it was not."""
        return "untangling after steps, which had taken what it may take" if self._refused else ""

    def held_back(
        self, points: wp.array, direction: wp.array, volume: wp.array, length: float
    ) -> tuple[wp.array, wp.array] | None:
        """Move points by the largest shares of the step, halved corner by corner, that keep every triangle.

        Args:
            points, direction, volume, length: as of :meth:`tried`.

        Returns:
            The map and the shares, float64, shape [V], on the device; None where no shares were found.
        """
        holds = 30  # halvings of the shares of corners of triangles in trouble
        count, device = self._surface.vertex_count, self._device
        share, other = (wp.full(count, 1.0, dtype=wp.float64, device=device) for _ in range(2))
        for _ in range(holds):
            moved = self._moved(points, direction, share, length)
            trouble = self._marked(moved, volume)
            if trouble is None:
                return moved, share
            wp.launch(hold_back, dim=count, inputs=[*self._rows, trouble, share], outputs=[other], device=device)
            share, other = other, share
        return None

    def _admitted(self, sphere: Floats) -> Floats:
        """Return the nearest map of the kind that these steps lead to, shape [V, 3]; here the map itself."""
        return sphere

    def _counted(self, faces: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Return a mask of the triangles, among some, that have to be repaired, shape [F]: here all of them."""
        return faces

    def _moved(self, points: wp.array, direction: wp.array, share: wp.array | None, length: float) -> wp.array:
        count = self._surface.vertex_count
        if share is None:
            share = wp.full(count, 1.0, dtype=wp.float64, device=self._device)
        moved = empty(count, wp.vec3d, self._device)
        inputs = [points, direction, share, wp.float64(length)]
        wp.launch(retract_to_sphere, dim=count, inputs=inputs, outputs=[moved], device=self._device)
        return moved

    def _marked(self, moved: wp.array, volume: wp.array) -> wp.array | None:
        """Return marks of the triangles that a step flips or nearly flattens; None where there are none."""
        marks = self._marks(moved, volume)
        place = self._reading.largest(marks)
        return marks if self._reading.read()[place] > 0.0 else None

    def _marks(self, moved: wp.array, volume: wp.array) -> wp.array:
        """Return 1 for these triangles and 0 for others, float64, shape [F]."""
        marks = wp.zeros(self._surface.face_count, dtype=wp.float64, device=self._device)
        inputs = [moved, self._faces, volume]
        wp.launch(triangle_trouble, dim=self._examined, inputs=inputs, outputs=[marks], device=self._device)
        return marks
