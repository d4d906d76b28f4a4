"""The area error of a moving map, which shows whether a falling cost is real."""

from __future__ import annotations

from omtwarp.device.start import wp
from omtwarp.device.sums import RowSums
from omtwarp.mesh.surface import SPHERE_AREA, Surface
from omtwarp.transport.cost import capped_area_error

# A triangle's area error D + 1/D - 2 counts at most this much, so that a few degenerate triangles do not decide.
LARGEST_ERROR = 0.1


class AreaMonitor:
    """Measures the area error of a moving map on the device.

    Where a mesh is too coarse for a motion, its vertices can shorten their paths by losing area, and the cost falls
    below that of any mass-preserving map. A falling cost is meaningful only if the area error does not grow.
    """

    def __init__(self, surface: Surface, device: wp.Device):
        self.device = device
        mesh = surface.on(device)
        self._faces, self._areas = mesh.faces, mesh.face_areas
        self._errors = wp.empty((surface.face_count, 1), dtype=wp.float64, device=device)
        self._sums = RowSums(surface.face_count, 1, device)

    def error(self, points: wp.array) -> float:
        """Return the mean of D + 1/D - 2 weighted by original area, each triangle counting at most LARGEST_ERROR."""
        wp.launch(
            capped_area_error,
            dim=len(self._errors),
            inputs=[points, self._faces, self._areas, wp.float64(LARGEST_ERROR)],
            outputs=[self._errors],
            device=self.device,
        )
        return float(self._sums(self._errors).numpy().sum()) / SPHERE_AREA
