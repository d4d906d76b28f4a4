"""Steps of a whole map that turn no triangle over: corners of triangles that a step would turn over are held back."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from omtwarp.device.start import wp
from omtwarp.device.sums import Reading
from omtwarp.solvers.motion_kernels import hold_back

if TYPE_CHECKING:
    from omtwarp.optimal.energy import Domain


# Share of the vertices, at most, that is held back in a step: of more, half of the whole step gains more. Drawn parts
# end in rags with 1; 0.25 and 0.5 are the same on scans.
MOST_HELD = 0.5


class FlipFreeSteps:
    """Moves the maps of a domain along directions.

    Args:
        domain: where the V vertices of a surface move.
    """

    def __init__(self, domain: Domain):
        self._domain, self._device = domain, domain.device
        mesh = domain.surface.on(domain.device)
        self._count, self._triangles = domain.surface.vertex_count, [*mesh.vertex_corners, mesh.faces]
        self._whole = wp.full(self._count, 1.0, dtype=wp.float64, device=self._device)
        self._reading = Reading(self._device)

    def tried(
        self, points: wp.array, direction: wp.array, volume: wp.array, length: float, reading: Reading
    ) -> tuple[wp.array, wp.array, int]:
        """Move points by a step, and begin to look for triangles that it turns over or nearly flattens.

        Args:
            points: a map without flips, shape [V].
            direction: of every vertex, shape [V].
            volume: of the triangles of the map, as of :meth:`omtwarp.optimal.energy.Domain.spoilt`, shape [F].
            length: of the step.
            reading: of numbers from the device.

        Returns:
            The map; marks of such triangles, float64, shape [F]; and the place of a number among those read that is
            positive where there are some.
        """
        moved = self._domain.moved(points, direction, self._whole, length)
        marks = self._domain.spoilt(moved, volume)
        return moved, marks, reading.largest(marks)

    def taken(
        self, points: wp.array, direction: wp.array, volume: wp.array, length: float
    ) -> tuple[wp.array, int] | None:
        """Move points by a step, held back where it spoils triangles; arguments and result as of :meth:`held_back`."""
        moved, marks, troubled = self.tried(points, direction, volume, length, self._reading)
        if self._reading.read()[troubled] > 0.0:
            return self.held_back(points, direction, volume, length, marks)
        return moved, 0

    def held_back(
        self, points: wp.array, direction: wp.array, volume: wp.array, length: float, marks: wp.array
    ) -> tuple[wp.array, int] | None:
        """Move points by shares of the step, halved at corners and falling towards them, that keep every triangle.

        Args:
            points, direction, volume, length: as of :meth:`tried`.
            marks: of triangles that the whole step spoils, of which there are some.

        Returns:
            The map and the number of vertices held back; None where no shares were found, or most vertices are held.
        """
        holds = 29  # halvings of the shares of corners of triangles in trouble
        share, other = self._whole, wp.empty_like(self._whole)
        for _ in range(holds):
            inputs = [*self._triangles, marks, share]
            wp.launch(hold_back, dim=self._count, inputs=inputs, outputs=[other], device=self._device)
            share, other = other, wp.empty_like(share) if share is self._whole else share
            held = int(np.count_nonzero(share.numpy() < 1.0))  # never less than the last time
            if held > MOST_HELD * self._count:
                return None
            moved = self._domain.moved(points, direction, share, length)
            marks = self._domain.spoilt(moved, volume)
            place = self._reading.largest(marks)
            if not self._reading.read()[place] > 0.0:
                return moved, held
        return None
