"""Readers of small formats of brain surfaces and of asteroids: each holds points and triangles, and little else."""

from __future__ import annotations

import struct

import numpy as np
from numpy.typing import NDArray

from omtwarp.errors import OmtwarpError
from omtwarp.mesh.arrays import whole_numbers

Numbers = NDArray[np.generic]

_MZ3_HEADER = "<HHIII"  # the magic number, what is in the file, and the numbers of faces, vertices and bytes to skip


def read_mz3(data: bytes) -> tuple[Numbers, Numbers]:
    """Read a surface of Surf Ice (``.mz3``).

    Returns:
        Points [V, 3] and faces [F, 3].

    Raises:
        OmtwarpError: no such file, one without a surface, or one cut short.
    """
    mz3_both = 3  # bits of faces and vertices in what is in the file
    size = struct.calcsize(_MZ3_HEADER)
    magic, content, faces, vertices, skipped = struct.unpack(_MZ3_HEADER, data[:size].ljust(size, b"\0"))
    # Mz3 magic: "MZ" as a little-endian number
    if magic != 23117:
        raise OmtwarpError("no header of an mz3 file")
    if content & mz3_both != mz3_both:
        raise OmtwarpError("not a triangle mesh: an mz3 file of data alone")
    start = size + skipped
    need = start + 12 * (faces + vertices)
    if len(data) < need:
        raise OmtwarpError(f"cut short: {need} bytes announced, {len(data)} there")
    corners = np.frombuffer(data, "<i4", 3 * faces, start)
    points = np.frombuffer(data, "<f4", 3 * vertices, start + 12 * faces)
    return points.reshape(-1, 3), corners.reshape(-1, 3)


def read_freesurfer_text(data: bytes) -> tuple[Numbers, Numbers]:
    """Read a surface that FreeSurfer wrote as text (``.asc``): two counts, and points and faces with a mark each.

    Returns:
        Points [V, 3] and faces [F, 3].

    Raises:
        OmtwarpError: the file is cut short.
    """
    numbers = _Numbers(data.partition(b"\n")[2])
    vertices, faces = (int(count) for count in numbers.take(2))
    points = numbers.take(4 * vertices).reshape(-1, 4)[:, :3]
    return points, numbers.take(4 * faces).reshape(-1, 4)[:, :3]


def read_mni(data: bytes) -> tuple[Numbers, Numbers, NDArray[np.int64]]:
    """Read polygons of the Montreal Neurological Institute (``.obj`` that begins with P).

    Returns:
        Points [V, 3], the corners of all polygons one after another, and how many each has [F].

    Raises:
        OmtwarpError: the file is cut short, or its polygons do not fit their corners.
    """
    numbers = _Numbers(data.lstrip()[1:])
    numbers.take(5)  # how it shines, and its opacity
    vertices = int(numbers.take(1)[0])
    points = numbers.take(3 * vertices).reshape(-1, 3)
    numbers.take(3 * vertices)  # normals
    count, colored = (int(number) for number in numbers.take(2))
    if colored not in (0, 1, 2):
        raise OmtwarpError(f"damaged: colours of the kind {colored}")
    numbers.take(4 * (1, count, vertices)[colored])
    ends = whole_numbers(numbers.take(count), "ends of polygons", (None,))
    sizes = np.diff(ends, prepend=0)
    if (sizes < 0).any():
        raise OmtwarpError("damaged: ends of polygons that do not grow")
    return points, numbers.take(int(sizes.sum())), sizes


def read_plates(data: bytes) -> tuple[Numbers, Numbers]:
    """Read a plate model of the Planetary Data System (``.tab``): numbered vertices, and plates that count from 1.

    Counts stand together before the vertices, or each before its own list.

    Returns:
        Points [V, 3] and faces [F, 3], which count from 0.

    Raises:
        OmtwarpError: no plate model, or one cut short.
    """
    together = len(data.split(b"\n", 1)[0].split()) == 2
    numbers = _Numbers(data)
    vertices = int(numbers.take(1)[0])
    plates = int(numbers.take(1)[0]) if together else None
    points = numbers.take(4 * vertices).reshape(-1, 4)
    faces = numbers.take(4 * (int(numbers.take(1)[0]) if plates is None else plates)).reshape(-1, 4)
    for rows in (points, faces):
        if not np.array_equal(rows[:, 0], np.arange(1, len(rows) + 1)):
            raise OmtwarpError("no plate model: its rows are not numbered from 1")
    return points[:, 1:], faces[:, 1:] - 1


class _Numbers:
    """The numbers of a text, taken from its beginning to its end."""

    def __init__(self, text: bytes):
        self.words, self.place = text.split(), 0

    def take(self, count: int) -> NDArray[np.float64]:
        """Return the next numbers.

        Raises:
            OmtwarpError: there are fewer.
        """
        taken = self.words[self.place : self.place + max(count, 0)]
        if len(taken) != count:
            raise OmtwarpError(f"cut short: {count} numbers announced, {len(taken)} there")
        self.place += count
        return np.array(taken, dtype=np.float64)
