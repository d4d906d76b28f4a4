"""Maps and meshes as the kernels of a device read them."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from omtwarp.device.start import wp


def vectors(points: ArrayLike | wp.array, device: wp.Device) -> wp.array:
    """Return the points as vec3d, shape [N], to be read only.

    A Warp array that is on the device is taken as it is; on the CPU a float64 array of NumPy's is not copied either.

    Args:
        points: shape [N, 3]; or a Warp array of vec3d.
        device: a Warp device.
    """
    if isinstance(points, wp.array):
        return points.to(device)
    return wp.array(np.ascontiguousarray(points, dtype=np.float64), dtype=wp.vec3d, device=device, copy=False)


def triangles(faces: ArrayLike | wp.array, device: wp.Device) -> wp.array:
    """Return the corners of triangles as vec3i, shape [F], to be read only; see :func:`vectors`.

    Args:
        faces: whole numbers, shape [F, 3]; or a Warp array of vec3i.
        device: a Warp device.
    """
    if isinstance(faces, wp.array):
        return faces.to(device)
    return wp.array(np.ascontiguousarray(faces, dtype=np.int32), dtype=wp.vec3i, device=device, copy=False)


__all__ = ["triangles", "vectors"]
