"""Weights on a surface: which parts are to cover more of the sphere than their area."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from omtwarp.errors import OmtwarpError, choose
from omtwarp.files.inputs import array_of, read_bytes
from omtwarp.files.limits import LARGEST_MESH_FILE
from omtwarp.mesh.arrays import real_numbers
from omtwarp.mesh.data import from_text
from omtwarp.mesh.surface import Surface
from omtwarp.options import WeightsAt


def weighted_surface(surface: Surface, weights: ArrayLike | None, at: str = WeightsAt.AUTO) -> Surface:
    """Multiply the area of every triangle by a weight; the result is the measure that maps of the surface keep.

    Args:
        surface: V vertices and F triangles.
        weights: positive and finite, shape [V] or [F]; a triangle takes the mean of its vertices. Only ratios count:
            a part of weight 2 among parts of weight 1 covers twice as much of the sphere for its area. None returns the
            surface itself.
        at: what they belong to: ``vertices`` or ``triangles``; ``auto`` goes by their number.

    Returns:
        The surface with its measure, of total 4π; see :class:`omtwarp.Surface`.

    Raises:
        OmtwarpError: another number of weights, one that is not positive and finite, or ``auto`` where there are as
            many vertices as triangles.

    Example:
        >>> import numpy as np, omtwarp
        >>> from omtwarp.measures import weighted_surface
        >>> surface = omtwarp.shapes.icosphere(8)
        >>> north = weighted_surface(surface, np.where(surface.vertices[:, 2] > 0, 3.0, 1.0))
        >>> bool(north.vertex_areas[surface.vertices[:, 2] > 0.2].sum() > 2 * 4 * np.pi / 4)
        True
    """
    if weights is None:
        return surface
    return surface.with_areas(surface.face_areas * face_weights(weights, surface.faces, surface.vertex_count, at))


def face_weights(weights: ArrayLike, corners: NDArray, vertices: int, at: str = WeightsAt.AUTO) -> NDArray[np.float64]:
    """Convert weights of vertices or triangles to weights of triangles, the largest being 1, shape [F].

    Args:
        weights: positive and finite, shape [V] or [F].
        corners: the vertices of every triangle, shape [F, 3].
        vertices: how many there are, V.
        at: what the weights belong to, as of :func:`weighted_surface`.

    Raises:
        OmtwarpError: another number of weights, one that is not positive and finite, or ``auto`` where there are as
            many vertices as triangles.
    """
    given = np.array(real_numbers(weights, "the weights", None, finite=False))
    faces = len(corners)
    where = weights_belong_to(given.shape, vertices, faces, at)
    wrong = ~(np.isfinite(given) & (given > 0.0))
    if wrong.any():
        first = int(np.argmax(wrong))
        raise OmtwarpError(
            f"{int(wrong.sum())} weights are not positive and finite, the first is weight {first}: {given[first]:g}"
        )
    given /= given.max()
    return given if where is WeightsAt.TRIANGLES else np.asarray(given[corners].mean(axis=1))


def weights_belong_to(shape: tuple[int, ...], vertices: int, faces: int, at: str = WeightsAt.AUTO) -> WeightsAt:
    """Return whether weights are of vertices or of triangles.

    Args:
        shape: of their array.
        vertices: how many vertices the surface has.
        faces: how many triangles it has.
        at: what is said about them.

    Raises:
        OmtwarpError: another number of weights, or nothing is said where both numbers are the same.
    """
    said = choose(WeightsAt, at)
    counts = {WeightsAt.VERTICES: vertices, WeightsAt.TRIANGLES: faces}
    fitting = [name for name, count in counts.items() if shape == (count,) and said in (name, WeightsAt.AUTO)]
    if not fitting:
        wanted = " or ".join(f"{count} {name}" for name, count in counts.items() if said in (name, WeightsAt.AUTO))
        raise OmtwarpError(f"the weights have shape {list(shape)}: give one for each of {wanted}")
    if len(fitting) > 1:
        raise OmtwarpError(
            f"{shape[0]} weights are given for a surface of as many vertices as triangles: say which they belong to, "
            "by --weights-at (weights_at in Python) vertices or triangles"
        )
    return fitting[0]


def read_numbers(path: Path) -> NDArray[np.float64]:
    """Read one number per line, or a one-dimensional array.

    Args:
        path: ``.npy``, or text with one number a line (a header line and a comma at its end are let pass).

    Returns:
        float64, shape [N].

    Raises:
        OmtwarpError: the file is missing, or holds something else.
    """
    data = read_bytes(path, LARGEST_MESH_FILE, "file of weights")
    if path.suffix.lower() == ".npy":
        try:
            values = array_of(data).squeeze()
        except OmtwarpError as error:
            raise OmtwarpError(f"{path}: {error}") from None
    else:
        try:
            values = from_text(data.decode("utf-8-sig")).values
        except (OmtwarpError, UnicodeDecodeError) as error:
            detail = str(error) if isinstance(error, OmtwarpError) else "no list of numbers: no text"
            raise OmtwarpError(f"{path}: {detail}") from None
        values = values[:, 0] if values.shape[1] == 1 else values
    if values.ndim != 1 or values.dtype.kind not in "uifb":
        raise OmtwarpError(f"{path}: an array of shape {list(values.shape)}, not one number a vertex or face")
    return values.astype(np.float64)
