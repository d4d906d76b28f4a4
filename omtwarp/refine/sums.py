"""The sums that make up the distortion of a map, taken on the device."""

from __future__ import annotations

from omtwarp.device.start import wp
from omtwarp.device.sums import DeviceSum
from omtwarp.refine.step_kernels import distortion_summands


class DistortionSums:
    """Sums over triangles in an order that depends on their number alone; five numbers return to the host.

    Args:
        count: number of triangles F.
        device: a Warp device.
    """

    def __init__(self, count: int, device: wp.Device):
        self._device = device
        self._sum = DeviceSum(device)
        self._excess, self._inverse = (wp.empty(count, dtype=wp.float64, device=device) for _ in range(2))
        self._totals = wp.empty(5, dtype=wp.float64, device=device)
        self._places: list[wp.array] = [self._totals[k : k + 1] for k in range(5)]

    def __call__(
        self, areas: wp.array, angle: wp.array, ratio: wp.array, _volume: wp.array, steepness: wp.array
    ) -> tuple[float, ...]:
        """Return Σ A angle, Σ A D, Σ A (r + 1/r - 2) with r = 4π D / Σ A D, Σ A / D and Σ A steepness.

        The arguments are arrays of shape [F].
        """
        place = self._places
        self._sum.dot(areas, ratio, place[1])
        inputs, outputs = [ratio, place[1]], [self._excess, self._inverse]
        wp.launch(distortion_summands, dim=areas.size, inputs=inputs, outputs=outputs, device=self._device)
        for k, values in ((0, angle), (2, self._excess), (3, self._inverse), (4, steepness)):
            self._sum.dot(areas, values, place[k])
        return tuple(float(x) for x in self._totals.numpy())


__all__ = ["DistortionSums"]
