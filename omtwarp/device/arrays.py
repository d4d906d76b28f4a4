"""Arrays that kernels on a device read, made of maps and meshes, and memory on the host that is shared."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from omtwarp.device.policy import shares_host_memory
from omtwarp.device.start import wp

# What arrays made by :func:`empty` may hold.
NUMBERS = {wp.float64: np.float64, wp.int32: np.int32}
COMPONENTS = {wp.vec2d: 2, wp.vec3d: 3}


def sent(values: NDArray[np.generic], dtype: type, device: wp.Device | str = "cpu") -> wp.array:
    """Return an array on a device with the values of NumPy's; on the CPU it shares their memory."""
    return wp.array(np.ascontiguousarray(values), dtype=dtype, device=device, copy=False)


def vectors(points: ArrayLike | wp.array, device: wp.Device) -> wp.array:
    """Convert points to a read-only array of vec3d, shape [N], on a device.

    A Warp array that is on the device is taken as it is; on the CPU a float64 array of NumPy's is not copied either.

    Args:
        points: shape [N, 3]; or a Warp array of vec3d.
        device: a Warp device.
    """
    return points.to(device) if isinstance(points, wp.array) else sent(np.asarray(points, np.float64), wp.vec3d, device)


def triangles(faces: ArrayLike | wp.array, device: wp.Device) -> wp.array:
    """Convert triangles to a read-only array of vec3i, shape [F], on a device; see :func:`vectors`.

    Args:
        faces: whole numbers, shape [F, 3]; or a Warp array of vec3i.
        device: a Warp device.
    """
    return faces.to(device) if isinstance(faces, wp.array) else sent(np.asarray(faces, np.int32), wp.vec3i, device)


def empty(count: int, dtype: type, device: wp.Device) -> wp.array:
    """Return an uninitialised array of numbers or vectors, shape [count], on a device.

    On the CPU its memory is NumPy's, in half the time, for loops that make thousands of small arrays.
    """
    if not shares_host_memory(device):
        return wp.empty(count, dtype=dtype, device=device)
    width = COMPONENTS.get(dtype)
    numbers = np.empty(count, dtype=NUMBERS[dtype]) if width is None else np.empty((count, width))
    return wp.array(numbers, dtype=dtype, device=device, copy=False)


class Workspace:
    """An array that steps of a computation use in turn; it grows to the largest number of elements requested.

    Its contents are valid until the next step uses it.
    """

    def __init__(self) -> None:
        self._numbers: NDArray[np.float64] = np.empty(0)

    def numbers(self, count: int) -> NDArray[np.float64]:
        """Return an uninitialised float64 array, shape [count], in the same memory at every call."""
        if len(self._numbers) < count:
            self._numbers = np.empty(0)  # free the old array first: otherwise both exist for a moment
            self._numbers = np.empty(count)
        return self._numbers[:count]
