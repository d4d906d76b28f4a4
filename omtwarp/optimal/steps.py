"""Steps of a whole map that turn no triangle over: corners of triangles that a step would turn over are held back."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from omtwarp.device.start import wp
from omtwarp.mesh.arrays import Floats
from omtwarp.optimal.energy import MapTerms, TransportEnergy
from omtwarp.solvers.motion_kernels import hold_back

# Share of the vertices, at most, that is held back in a step: of more, half of the whole step gains more. Drawn parts
# end in rags with 1; 0.25 and 0.5 are the same on scans.
MOST_HELD = 0.5


class FlipFreeSteps:
    """Moves the maps that an energy measures along directions.

    Args:
        energy: of the maps of a surface, V vertices and F triangles.
    """

    def __init__(self, energy: TransportEnergy):
        self._energy, self._domain, self._device = energy, energy.domain, energy.device
        self._count, self._faces = energy.surface.vertex_count, energy.surface.on(energy.device).faces
        self._whole = wp.full(self._count, 1.0, dtype=wp.float64, device=self._device)

    def tried(
        self, points: wp.array, direction: wp.array, volume: wp.array, length: float, multipliers: wp.array | None
    ) -> tuple[Floats, Callable[[], tuple[wp.array, MapTerms, int] | None]]:
        """Try a step: return the numbers that were read, and what returns the map that it leads to.

        Args:
            points: a map without flips, shape [V].
            direction: of every vertex, shape [V].
            volume: of the triangles of the map, as of :meth:`omtwarp.optimal.energy.Domain.spoilt`, shape [F].
            length: of the step.
            multipliers: as of :meth:`omtwarp.optimal.energy.TransportEnergy.terms`.

        Returns:
            What the energy's reading held, and a function that returns the map, its terms, and the number of vertices
            held back at triangles that the step would turn over or nearly flatten; None where it cannot be held back.
        """
        energy = self._energy
        moved = self._domain.moved(points, direction, self._whole, length)
        marks = self._domain.spoilt(moved, volume)
        troubled, finish = energy.reading.largest(marks), energy.begin(moved, multipliers)
        numbers = energy.reading.read()

        def taken() -> tuple[wp.array, MapTerms, int] | None:
            if not numbers[troubled] > 0.0:
                return moved, finish(numbers), 0
            held = self._held_back(points, direction, volume, length, marks)
            return None if held is None else (held[0], energy.terms(held[0], multipliers), held[1])

        return numbers, taken

    def _held_back(
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
        share = self._whole
        for _ in range(holds):
            last, share = share, wp.clone(share)
            wp.launch(hold_back, len(marks), [self._faces, marks, last], [share], device=self._device)
            held = int(np.count_nonzero(share.numpy() < 1.0))  # never less than the last time
            if held > MOST_HELD * self._count:
                return None
            moved = self._domain.moved(points, direction, share, length)
            marks = self._domain.spoilt(moved, volume)
            place = self._energy.reading.largest(marks)
            if not self._energy.reading.read()[place] > 0.0:
                return moved, held
        return None
