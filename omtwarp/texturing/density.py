"""Target densities from a function, a picture of the sphere, or data on the vertices of a sphere."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from omtwarp.errors import OmtwarpError
from omtwarp.location import Locator
from omtwarp.measures import TargetDensity
from omtwarp.mesh.arrays import Floats, real_numbers, whole_numbers
from omtwarp.texturing.image import PictureLike, as_floats, direction_to_image, read_image

Function: TypeAlias = Callable[[Floats], ArrayLike]
TargetLike: TypeAlias = "TargetDensity | Function | tuple[ArrayLike, ArrayLike, ArrayLike] | PictureLike"
"""A density on the sphere in any of the forms that :func:`as_target` takes."""


def image_density(image: PictureLike, floor: float = 0.0) -> TargetDensity:
    """Make a density of the grey values of an equirectangular picture: the brighter, the more mass.

    Args:
        image: what :func:`omtwarp.texturing.image.read_image` takes; row 0 is the north pole, longitude 0 the middle.
            Bilinear between texels, so a picture much finer than the mesh should be smoothed first.
        floor: densities below this share of the mean are raised to it; black needs one above 0.

    Raises:
        OmtwarpError: no picture, or a black texel and no floor.

    Example:
        >>> import numpy as np
        >>> from omtwarp.texturing.density import image_density
        >>> bright_east = image_density(np.array([[0.2, 0.6]]))
        >>> bool(bright_east.at([[0.0, 1.0, 0.0]])[0] > bright_east.at([[0.0, -1.0, 0.0]])[0])
        True
    """
    grey = as_floats(read_image(image))[..., :3].astype(np.float64) @ (0.2126, 0.7152, 0.0722)  # ITU-R BT.709
    if not grey.max() > 0.0:
        raise OmtwarpError("the target image is black everywhere: it says nothing of where mass is to be")
    if floor == 0.0 and grey.min() <= 0.0:
        row, column = np.unravel_index(int(np.argmin(grey)), grey.shape)
        raise OmtwarpError(
            f"{np.count_nonzero(grey <= 0.0)} texels of the target image are black, the first in row {row}, column "
            f"{column}: a density must be positive everywhere; give a floor, such as 0.05 of its mean"
        )
    height, width = grey.shape
    # The first and last column are neighbours; beyond the poles the outermost rows are repeated.
    padded = np.pad(np.pad(grey, ((0, 0), (1, 1)), mode="wrap"), ((1, 1), (0, 0)), mode="edge")

    def density(points: Floats) -> Floats:
        u, v = direction_to_image(points).T
        from scipy.ndimage import map_coordinates  # takes a tenth of a second to import

        return map_coordinates(padded, [(1.0 - v) * height + 0.5, u * width + 0.5], order=1, mode="nearest")

    return TargetDensity(density, floor)


def vertex_density(
    sphere: ArrayLike, faces: ArrayLike, values: ArrayLike, floor: float = 0.0, *, device: str | None = "auto"
) -> TargetDensity:
    """Make a density of numbers at the vertices of a triangulated sphere, linear on its triangles.

    Args:
        sphere: vertices of any sphere about the origin, such as another map, shape [V, 3].
        faces: its triangles, shape [F, 3].
        values: positive (or not negative, with a floor), shape [V].
        floor: densities below this share of the mean are raised to it.
        device: where points are located.

    Raises:
        OmtwarpError: arrays that do not fit together, or values that are no density.
    """
    points = real_numbers(sphere, "the target's sphere", (None, 3))
    points = points / np.linalg.norm(points, axis=1, keepdims=True)
    triangles = whole_numbers(faces, "the target's faces", (None, 3), below=len(points)).astype(np.int32)
    numbers = real_numbers(values, "the target's values", (len(points),), finite=False)
    locator = Locator(points, triangles, device=device)

    def density(queries: Floats) -> Floats:
        holding = locator.find(queries)
        return (numbers[triangles[holding.faces]] * holding.coordinates).sum(axis=1)

    return TargetDensity(density, floor)


def as_target(target: TargetLike | None, floor: float = 0.0, *, device: str | None = "auto") -> TargetDensity | None:
    """Make a target density of any of the accepted forms; None is the uniform one.

    Args:
        target: a :class:`TargetDensity`; a function of unit vectors, [N, 3] -> [N]; ``(sphere, faces, values)`` with
            data at the vertices of a triangulated sphere; or an equirectangular picture (a path or an array).
        floor: densities below this share of the mean are raised to it.
        device: where points are located.

    Raises:
        OmtwarpError: the target has none of these forms, or is not positive everywhere.
    """
    if target is None or isinstance(target, TargetDensity):
        return target
    if isinstance(target, tuple):
        if len(target) != 3:
            raise OmtwarpError(f"a target of {len(target)} arrays: give (sphere, faces, values)")
        return vertex_density(*target, floor, device=device)
    if callable(target):
        return TargetDensity(target, floor)
    if isinstance(target, str | os.PathLike | np.ndarray) or hasattr(target, "convert"):
        return image_density(target, floor)
    raise OmtwarpError(
        f"a target of type {type(target).__name__}: give a function of points, an image, or (sphere, faces, values)"
    )
