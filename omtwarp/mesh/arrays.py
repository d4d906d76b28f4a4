"""Check the arrays that callers pass: type, shape and values."""

import math
import operator
import sys
from collections.abc import Iterable, Mapping
from functools import reduce
from typing import Protocol, TypeAlias, TypeVar, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from omtwarp.errors import OmtwarpError

# Coordinates to the fourth power, as in squared areas, stay within float64.
SMALLEST, LARGEST = 1e-75, 1e75

# Least divisor: a quotient by less is that of a length or an area that is zero. The smallest normal float64 is 2e-308.
TINY = 1e-300

# Relative: what differs by less is equal but for rounding. Some five thousand times float64's round-off, as much as a
# few thousand roundings in a row leave at worst, and a millionth of the least digit that any figure is given to.
ROUND_OFF = 1e-12

# A repair merges vertices of boundaries that are nearer than this share of the mean length of the edges at both. Single
# precision rounds a coordinate by 6e-8 of the extent, a thousandth of edges that are 6e-5 of it.
WELD = 1e-3

Floats: TypeAlias = NDArray[np.float64]
Ints: TypeAlias = NDArray[np.int32]
Indices: TypeAlias = NDArray[np.int64]
Numbers: TypeAlias = NDArray[np.generic]
Bytes: TypeAlias = NDArray[np.uint8]
Bools: TypeAlias = NDArray[np.bool_]
Shape = tuple[int | None, ...]
Kind = TypeVar("Kind")
Layout = Mapping[str, tuple[type[np.generic], tuple[str | int, ...]]]


class InOneLine:
    """Results that print in a line: plain values as they are, arrays by their shapes, records by how many there are."""

    def __repr__(self) -> str:
        fields = {name: vars(self)[name] for name in getattr(self, "__dataclass_fields__", ())}
        return f"{type(self).__name__}({', '.join(f'{name}={_brief(value)}' for name, value in fields.items())})"


def _brief(value: object) -> str:
    if isinstance(value, np.ndarray):
        return f"{value.dtype}{list(value.shape)}"
    if isinstance(value, list | tuple | dict):
        return f"<{len(value)}>"
    return f"{value:.6g}" if isinstance(value, float) else repr(value)


@runtime_checkable
class HasTriangles(Protocol):
    """An object with vertices, shape [V, 3], and faces, shape [F, 3], such as a ``trimesh.Trimesh``."""

    @property
    def vertices(self) -> ArrayLike:
        """Positions, shape [V, 3]."""

    @property
    def faces(self) -> ArrayLike:
        """Vertex indices of the triangles, shape [F, 3]."""


class SphereMap(HasTriangles, Protocol):
    """A surface and its map to the sphere, such as a :class:`~omtwarp.MapResult`."""

    @property
    def sphere(self) -> ArrayLike:
        """Images of the vertices, shape [V, 3]."""


@runtime_checkable
class FinishedMap(SphereMap, Protocol):
    """A surface with its final and its conformal map, such as a :class:`omtwarp.MapResult`."""

    @property
    def conformal(self) -> ArrayLike | None:
        """Images of the vertices by the conformal map, shape [V, 3]."""


def real_numbers(
    values: object, name: str, shape: Shape | None, *, finite: bool = True, positive: bool = False, truths: bool = False
) -> NDArray[np.float64]:
    """Convert an array of real numbers to float64, without changing a number.

    Args:
        values: anything that NumPy makes an array of.
        name: what to call it in a message, such as ``vertices``.
        shape: the shape that it must have, with None for any length; None for any shape.
        finite: whether NaN and infinite numbers are refused.
        positive: whether zero and negative numbers are refused too.
        truths: whether truth values are taken, as 0 and 1.

    Returns:
        float64, contiguous; the array itself where it is that already.

    Raises:
        OmtwarpError: complex numbers, text, objects, masked entries, another shape, or numbers that are not finite, or
            not positive.

    Example:
        >>> real_numbers([[0, 1, 2]], "points", (None, 3))
        array([[0., 1., 2.]])
    """
    array = _of_kind(values, name, "iufb" if truths else "iuf", (0,) if shape is None else shape)
    if shape is not None:
        _require_shape(array, name, shape)
    out = np.ascontiguousarray(array, dtype=np.float64)
    if finite:
        good = np.isfinite(out) & (out > 0.0) if positive else np.isfinite(out)
        if not good.all():
            first = int(np.argmin(good.reshape(len(out), -1).all(axis=1))) if out.ndim else 0
            what = f"{int((~good).sum())} numbers that are" if (~good).sum() > 1 else "1 number that is"
            raise OmtwarpError(f"{name}: {what} not {'positive and ' * positive}finite, first in row {first}")
    return out


def single_precision(values: NDArray[np.generic], name: str) -> NDArray[np.float32]:
    """Round numbers to single precision, in which some file formats hold them.

    Args:
        values: an array of any shape; NaN and infinite numbers stay.
        name: what to call it in a message.

    Raises:
        OmtwarpError: finite numbers that are too large for it, or numbers that are all too small.
    """
    with np.errstate(over="ignore", under="ignore"):
        out = np.asarray(values, dtype=np.float32)
    largest = float(np.abs(np.asarray(values)[np.isfinite(values)]).max(initial=0.0))
    tiny, most = float(np.finfo(np.float32).tiny), float(np.finfo(np.float32).max)
    if largest and not tiny <= largest <= most:
        raise OmtwarpError(
            f"{name}: numbers up to {largest:g} are out of range for single precision, {tiny:.3g} to {most:.3g}: "
            "scale them, or use a format of double precision"
        )
    return out


def whole_numbers(values: object, name: str, shape: Shape, *, below: int | None = None, nan: bool = False) -> Indices:
    """Convert an array of whole numbers to int64; floating point numbers are accepted where they are whole.

    Args:
        values: anything that NumPy makes an array of.
        name: what to call it in a message, such as ``faces``.
        shape: the shape that it must have; None for any length.
        below: numbers must be at least 0 and below this; unbounded by default.
        nan: whether NaN counts as 0, in place of being refused.

    Returns:
        int64, contiguous.

    Raises:
        OmtwarpError: the values are not whole numbers, are masked, out of range, or of another shape.

    Example:
        >>> whole_numbers([[0.0, 1.0, 2.0]], "faces", (None, 3), below=3)
        array([[0, 1, 2]])
    """
    array = _of_kind(values, name, "iuf", shape)
    _require_shape(array, name, shape)
    if array.dtype.kind == "f":
        array = np.where(np.isnan(array), 0.0, array) if nan else array
        with np.errstate(invalid="ignore", over="ignore"):
            whole = np.isfinite(array) & (array == np.floor(array)) & (np.abs(array) < 2**62)
        if not whole.all():
            raise OmtwarpError(f"{name}: must be whole numbers, not {array.reshape(-1)[int(np.argmin(whole))]}")
    if array.dtype.kind == "u" and array.size and array.max() > np.iinfo(np.int64).max:
        raise OmtwarpError(f"{name}: numbers up to {array.max()} are out of range")
    out = np.ascontiguousarray(array, dtype=np.int64)
    if below is not None and out.size and (out.min() < 0 or out.max() >= below):
        outside = (out < 0) | (out >= below)
        first = int(np.argmax(outside.reshape(len(out), -1).any(axis=1)))
        raise OmtwarpError(f"{name}: {out[outside][0]} in row {first} is out of range, 0 to {below - 1}")
    return out


def fitting_arrays(
    arrays: Mapping[str, object], layout: Layout, counts: Mapping[str, int]
) -> dict[str, NDArray[np.generic]]:
    """Make read-only copies, of the types and shapes of a table, of arrays that belong together.

    None and missing ones are skipped. An array that is such a copy itself is returned as it is.

    Args:
        arrays: by name; arrays that the table does not name are ignored.
        layout: type and shape of every array; letters of a shape are lengths that have to agree.
        counts: lengths of letters that are known beforehand; others are taken from the first array.

    Raises:
        OmtwarpError: an array is not of numbers, not finite, or does not fit the others; the first such is named.
    """
    known = dict(counts)
    fitting: dict[str, NDArray[np.generic]] = {}
    for name, (dtype, letters) in layout.items():
        values = arrays.get(name)
        if values is None:
            continue
        shape = tuple(known.get(letter) if isinstance(letter, str) else letter for letter in letters)
        take = whole_numbers if issubclass(dtype, np.integer) else real_numbers
        fitting[name] = _owned(take(values, f"'{name}'", shape), dtype)
        for letter, length in zip(letters, fitting[name].shape, strict=True):
            if isinstance(letter, str):
                known.setdefault(letter, length)
    return fitting


def edge_keys(ends: NDArray[np.integer], vertex_count: int) -> NDArray[np.int64]:
    """Return a number for every edge, whichever of its ends comes first, shape [E]; it sorts as edges do.

    Args:
        ends: vertices, shape [E, 2].
        vertex_count: of the surface.
    """
    first, second = ends[:, 0].astype(np.int64), ends[:, 1].astype(np.int64)
    return np.minimum(first, second) * vertex_count + np.maximum(first, second)


def marked(count: int, places: NDArray[np.integer] | NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return a mask of shape [count] that is true at these places."""
    mask = np.zeros(count, dtype=bool)
    mask[places] = True
    return mask


def summed(values: NDArray[np.floating], places: NDArray[np.integer], count: int = 0) -> NDArray[np.float64]:
    """Return the sums of rows of numbers, shape [N, C], that have the same place, shape [count, C] or more rows."""
    return np.stack([np.bincount(places, column, count) for column in values.T], axis=1)


def _owned(values: object, dtype: type[np.generic]) -> NDArray[np.generic]:
    """Return a read-only copy, or the array itself if it is one already."""
    array = np.asarray(values)
    if array.dtype != dtype or array.flags.writeable or not array.flags.owndata or not array.flags.c_contiguous:
        array = np.array(array, dtype=dtype, order="C")
        array.flags.writeable = False
    return array


def real_number(value: object, name: str, *, least: float = -math.inf, above: float = -math.inf) -> float:
    """Check one finite number.

    Args:
        value: a number of Python or NumPy; no truth value, text or array.
        name: what to call it in a message.
        least: it must be at least this.
        above: it must be more than this.

    Raises:
        OmtwarpError: the value is no finite number, or is out of range.

    Example:
        >>> real_number(3, "the weight", above=0.0)
        3.0
    """
    bound = f"above {above:g}" if above > -math.inf else f"of at least {least:g}" if least > -math.inf else ""
    wanted = f"a finite number {bound}".strip()
    if isinstance(value, bool | np.bool_) or not isinstance(value, int | float | np.integer | np.floating):
        raise OmtwarpError(f"{name}: must be {wanted}, not {_shown(value)}")
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    if not (math.isfinite(number) and number >= least and number > above):
        raise OmtwarpError(f"{name}: must be {wanted}, not {number:g}")
    return number


def whole_number(value: object, name: str, *, least: int = 0, most: int = 2**31 - 1) -> int:
    """Check one whole number.

    Args:
        value: an integer of Python or NumPy, or a floating point number that is whole; no truth value, text or array.
        name: what to call it in a message.
        least: it must be at least this.
        most: it must be at most this; by default the largest that kernels count to.

    Raises:
        OmtwarpError: the value is no whole number, or is out of range.

    Example:
        >>> whole_number(40, "the number of steps")
        40
    """
    wanted = f"a whole number from {least} to {most}"
    if isinstance(value, float | np.floating) and math.isfinite(value) and value == math.floor(value):
        value = int(value)
    if isinstance(value, bool | np.bool_) or not isinstance(value, int | np.integer):
        raise OmtwarpError(f"{name}: must be {wanted}, not {_shown(value)}")
    number = operator.index(value)
    if not least <= number <= most:
        raise OmtwarpError(f"{name}: must be {wanted}, not {value}")
    return number


def by_name(given: Mapping[str, Kind] | None, name: str) -> dict[str, Kind]:
    """Copy what is given by name, such as a feature under each; nothing where None is given.

    Raises:
        OmtwarpError: it is no mapping.
    """
    if not isinstance(given, Mapping | None):
        raise OmtwarpError(f"{name}: must be a dictionary of them by name, not {_shown(given)}")
    return dict(given or {})


def listed(given: Iterable[Kind], name: str, what: str, kind: type = object) -> list[Kind]:
    """List what is given one after another, a generator's items too.

    Raises:
        OmtwarpError: it holds nothing one after another, or something that is not of the type.
    """
    items = list(given) if isinstance(given, Iterable) else None
    if items is None or not all(isinstance(item, kind) for item in items):
        raise OmtwarpError(f"{name}: must be a list of {what}")
    return items


def in_range(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Scale points so that squares and products of their coordinates neither overflow nor vanish.

    Args:
        points: float64, shape [N, 3], finite or NaN.

    Returns:
        The points times a power of two, which changes no digit; the array itself where the largest coordinate is
        between 1e-75 and 1e75 anyway.
    """
    largest = float(np.fmax.reduce(np.abs(points), axis=None, initial=0.0))
    if largest == 0.0 or SMALLEST <= largest <= LARGEST:
        return points
    return np.ldexp(points, -int(np.frexp(largest)[1]))


def _shown(value: object) -> str:
    """Return a value that is no number, short and in one line."""
    return str(value) if isinstance(value, float | np.floating) else f"a {type(value).__name__}"


def _of_kind(values: object, name: str, kinds: str, shape: Shape) -> NDArray[np.generic]:
    """Return the values as an array of a kind of numbers."""
    if "numpy.ma" in sys.modules and isinstance(values, np.ma.MaskedArray):  # asking imports it
        if np.ma.is_masked(values):
            raise OmtwarpError(f"{name}: {int(np.ma.getmaskarray(values).sum())} entries are masked; fill them first")
        values = values.data
    try:
        array = np.asarray(values)
    except (TypeError, ValueError):  # rows of unequal length, among others
        raise OmtwarpError(f"{name}: must be numbers in rows of equal length") from None
    if array.size == 0:  # an empty list has the type and shape of nothing in particular
        return np.zeros([0, *(length or 0 for length in shape[1:])])
    if array.dtype.kind not in kinds:
        what = {"c": "complex numbers", "b": "truth values", "O": "objects", "U": "text", "S": "text"}
        raise OmtwarpError(f"{name}: must be real numbers, not {what.get(array.dtype.kind, str(array.dtype))}")
    return array


def _require_shape(array: NDArray[np.generic], name: str, shape: Shape) -> None:
    same = [length in (None, there) for length, there in zip(shape, array.shape, strict=False)]
    if len(array.shape) != len(shape) or not all(same):
        wanted = ", ".join("any" if length is None else str(length) for length in shape)
        raise OmtwarpError(f"{name}: shape {list(array.shape)}, not [{wanted}]")


def require_unit_length(points: NDArray[np.generic], name: str) -> None:
    """Make sure that points lie on the unit sphere, to single precision.

    Raises:
        OmtwarpError: some points do not; the message counts them and names the first.
    """
    with np.errstate(over="ignore"):
        lengths = norms(np.asarray(points, dtype=np.float64))
    # Unit length, largest distance of a point from the sphere: many times the rounding of single precision
    off = ~(np.abs(lengths - 1.0) <= 1e-5)
    if off.any():
        first = int(np.argmax(off))
        raise OmtwarpError(
            f"{int(off.sum())} points of {name} are not on the unit sphere, first vertex {first} "
            f"at a distance of {lengths[first]:g} from its centre"
        )


def dots(first: Floats, second: Floats) -> Floats:
    """Return the scalar products of vectors, shape [...], from shape [..., 2] or [..., 3].

    Column by column: NumPy's sums along so short rows take five times as long, for the same bits.
    """
    total = first[..., 0] * second[..., 0]
    for k in range(1, first.shape[-1]):
        total = total + first[..., k] * second[..., k]
    return total


def tangential_parts(normals: Floats, vectors: Floats) -> Floats:
    """Return vectors, shape [..., 2] or [..., 3], less their parts along unit normals; a normal of 0 takes nothing."""
    return vectors - dots(normals, vectors)[..., None] * normals


def mean_edge_lengths(points: Floats, ends: NDArray[np.integer]) -> Floats:
    """Return the mean length of the edges at every vertex, shape [V], 0 without any, from their ends, shape [E, 2]."""
    lengths = np.repeat(norms(points[ends[:, 0]] - points[ends[:, 1]]), 2)
    counts = np.bincount(ends.ravel(), minlength=len(points))
    return np.bincount(ends.ravel(), lengths, len(points)) / np.maximum(counts, 1)


def row_maxima(rows: Floats) -> Floats:
    """Return the largest number of every row, shape [N], column by column as :func:`dots` does."""
    return np.asarray(reduce(np.maximum, rows.T))


def squared_norms(vectors: Floats) -> Floats:
    """Return the squared lengths of vectors, shape [...], from shape [..., 2] or [..., 3]."""
    return dots(vectors, vectors)


def norms(vectors: Floats) -> Floats:
    """Return the lengths of vectors, shape [...], from shape [..., 2] or [..., 3]."""
    return np.asarray(np.sqrt(squared_norms(vectors)))


def cross(first: Floats, second: Floats) -> Floats:
    """Return the vector products of vectors, shape [..., 3], in a fifth of the time of NumPy's function."""
    columns = [first[..., i] * second[..., j] - first[..., j] * second[..., i] for i, j in ((1, 2), (2, 0), (0, 1))]
    return np.stack(columns, axis=-1)


def normalised(points: ArrayLike) -> NDArray[np.float64]:
    """Scale vectors to unit length, shape [..., 3]; zero stays zero."""
    vectors = np.asarray(points, dtype=np.float64)
    length = norms(vectors)[..., None]
    return np.asarray(vectors / np.where(length > 0.0, length, 1.0))


def octahedral_directions(x: Floats, y: Floats) -> Floats:
    """Return the unit vectors of points (x, y) of the octahedral square, each from -1 to 1."""
    z = 1.0 - np.abs(x) - np.abs(y)
    sx, sy = np.where(x < 0, -1.0, 1.0), np.where(y < 0, -1.0, 1.0)
    folded = [np.where(z < 0, (1.0 - np.abs(y)) * sx, x), np.where(z < 0, (1.0 - np.abs(x)) * sy, y), z]
    return normalised(np.stack(folded, axis=-1))


def direction_from_angles(longitude: ArrayLike, latitude: ArrayLike) -> Floats:
    """Return the unit vectors, shape [..., 3], from longitude and latitude in radians."""
    lon, lat = np.broadcast_arrays(np.asarray(longitude, dtype=np.float64), np.asarray(latitude, dtype=np.float64))
    return np.stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)], axis=-1)
