"""Reading of inputs: regular files of bounded size, arrays whose sizes are known first, pictures; and writing arrays.

Every reader of the package uses :func:`read_bytes` or :func:`read_arrays`, so that a pipe without a writer, an endless
device, or a file that inflates without end gives an error line and does not hang. Pillow opens pictures here alone, by
their header, and only in formats that it decodes itself.
"""

import contextlib
import csv
import io
import math
import os
import re
import stat
import threading
import warnings
import zipfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO, TYPE_CHECKING, BinaryIO

import numpy as np
from numpy.typing import ArrayLike, NDArray

from omtwarp.errors import OmtwarpError, brief, naming
from omtwarp.files import limits
from omtwarp.files.limits import LARGEST_ARRAYS, LARGEST_MESH_FILE, LARGEST_REPORT, MOST_KEPT, MOST_TEXELS, amount
from omtwarp.files.output import as_path, contents, note_input, staged

if TYPE_CHECKING:
    from PIL.Image import Image


@contextlib.contextmanager
def reading(file: Path, kind: str, size: int | None) -> Iterator[None]:
    """Turn whatever a parser raises in a block into a line that names the file, and bound the memory that it takes.

    Warnings are about guesses of parsers, whose results are checked, and are not passed on.

    Args:
        file: what is read.
        kind: what it should be; any failure of a parser means that it is not.
        size: of the file in bytes; None for no bound on memory.

    Raises:
        OmtwarpError: the file cannot be read as that.
    """
    bounded = contextlib.nullcontext() if size is None else limits.memory_for_file(size)
    try:
        with naming(str(file)), warnings.catch_warnings(action="ignore"), bounded:
            yield
    except (OmtwarpError, MemoryError):
        raise
    except Exception as error:
        raise OmtwarpError(f"{file}: cannot be read as {kind}: {brief(error)}") from None


def _identity(file: str | os.PathLike[str] | int) -> tuple[int, ...]:
    """Return numbers that tell a file, and whether it was written in between."""
    status = os.stat(file)
    return status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns


@contextlib.contextmanager
def open_input(path: str | os.PathLike[str], most: int, kind: str = "file") -> Iterator[BinaryIO]:
    """Open a regular file that is neither empty nor too large, for reading; inside of a command only once.

    Args:
        path: the file.
        most: bytes that it may have.
        kind: what it should be, for the error's text: ``mesh file``, ``picture``, ``map``.

    Raises:
        OmtwarpError: no such file, a directory, a device or pipe, an empty or too large file, or no right to read.
    """
    if "\0" in str(path):
        raise OmtwarpError(f"{path}: no such file")
    content = None
    with contextlib.suppress(OSError):
        content = contents and contents.get(_identity(path))
    if content and len(content) <= most:
        yield io.BytesIO(content)
        return
    try:
        # Non-blocking: a pipe without a writer is opened at once, and distinguished from a file.
        flags = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0) | getattr(os, "O_CLOEXEC", 0)
        descriptor = os.open(path, flags)
    except (FileNotFoundError, NotADirectoryError):
        raise OmtwarpError(f"{path}: no such file") from None
    except OSError as error:
        if os.path.isdir(path):  # which cannot be opened on Windows
            raise OmtwarpError(f"{path}: a directory, not a {kind}") from None
        raise OmtwarpError(f"{path}: cannot be read: {error.strerror or error}") from None
    try:
        status = os.fstat(descriptor)
        if stat.S_ISDIR(status.st_mode):
            raise OmtwarpError(f"{path}: a directory, not a {kind}")
        if not stat.S_ISREG(status.st_mode):
            raise OmtwarpError(f"{path}: a pipe or device, not a {kind}; standard input is read as '-'")
        if status.st_size > most:
            raise OmtwarpError(f"{path}: {amount(status.st_size)}, and a {kind} may have {amount(most)} at most")
        if not status.st_size:
            raise OmtwarpError(f"{path}: an empty file, not a {kind}")
        keep = note_input(path) and status.st_size <= MOST_KEPT
        with open(descriptor, "rb", closefd=False) as stream:
            if keep:
                contents[_identity(descriptor)] = content = _all_of(stream, path, most)
                while sum(map(len, contents.values())) > MOST_KEPT:
                    del contents[next(iter(contents))]
            yield io.BytesIO(content) if content else stream
    finally:
        os.close(descriptor)


def read_bytes(path: str | os.PathLike[str], most: int, kind: str = "file") -> bytes:
    """Read a regular file; arguments and errors are those of :func:`open_input`.

    Raises:
        OmtwarpError: the file cannot be read.
    """
    with open_input(path, most, kind) as stream:
        return stream.getvalue() if isinstance(stream, io.BytesIO) else _all_of(stream, path, most)


def table_text(path: str | os.PathLike[str], most: int, wanted: str) -> str:
    """Read the text of a table.

    Args:
        path: of the file.
        most: bytes it may have.
        wanted: what a message asks for where the file is no text.

    Raises:
        OmtwarpError: the file cannot be read, or is no text.
    """
    try:
        return read_bytes(path, most, "table").decode("utf-8-sig")
    except UnicodeDecodeError:
        raise OmtwarpError(f"'{path}' is no text: give {wanted}") from None


def table_rows(
    text: str, name: str, delimiter: str, *needed: str
) -> tuple[Sequence[str], list[tuple[int, dict[str, str]]]]:
    """Return the names of a table's columns, and its rows with the lines that they end in.

    Args:
        text: of the table.
        name: what messages call it.
        delimiter: between columns.
        needed: names of columns that it must have.

    Raises:
        OmtwarpError: a row cannot be read, or a column is missing.
    """
    rows = csv.DictReader(io.StringIO(text), delimiter=delimiter)
    try:
        names, listed = rows.fieldnames or [], [(rows.line_num, row) for row in rows]
    except csv.Error as error:
        raise OmtwarpError(f"{name}, line {max(rows.line_num, 1)}: {error}") from None
    if missing := [column for column in needed if column not in names]:
        first = text.partition("\n")[0][:80]
        raise OmtwarpError(f"{name} has no column '{missing[0]}': its first line is '{first}'")
    return names, listed


def _all_of(stream: BinaryIO, path: str | os.PathLike[str], most: int) -> bytes:
    try:
        # Room is made for as much as is asked for; a file may have grown since it was opened.
        return stream.read(min(os.fstat(stream.fileno()).st_size, most))
    except OSError as error:
        raise OmtwarpError(f"{path}: cannot be read: {error.strerror or error}") from None


def read_up_to(read: Callable[[int], bytes], most: int) -> bytes:
    """Read a stream of unknown length in blocks, until its end or one byte beyond a bound.

    Python makes room for as much as is asked for at once.

    Args:
        read: the stream's own function.
        most: the bound, in bytes.
    """
    blocks: list[bytes] = []
    left = most + 1
    # Bytes of a block
    while left > 0 and (block := read(min(left, 2**24))):
        blocks.append(block)
        left -= len(block)
    return b"".join(blocks)


def file_beside(file: str | os.PathLike[str], name: str) -> Path | None:
    """Return the file that another one names, such as a picture or a buffer: a regular file in its folder or below.

    A name that leads elsewhere, as that of a program which wrote the file on another machine, stands for the file of
    the same name in the folder. Links are followed first, so that none leads out of it.

    Args:
        file: the file that names the other.
        name: as it stands there.

    Returns:
        Its path; None where nothing is there.

    Raises:
        OmtwarpError: what is there is outside of the folder, or no regular file.
    """
    folder = Path(file).resolve().parent
    words = name.replace("\\", "/").strip().strip('"')
    if not words or "\0" in words:
        return None
    try:
        there = (folder / words).resolve()
        if not there.is_relative_to(folder):
            there = (folder / Path(words).name).resolve()
        if not os.path.lexists(there):
            return None
        regular = there.is_file()
    except (OSError, RuntimeError):  # a name that is too long, links in a circle
        return None
    if not there.is_relative_to(folder):
        raise OmtwarpError(f"names '{words}', which is outside of its folder")
    if not regular:
        raise OmtwarpError(f"names '{words}', which is not a regular file")
    return there


def read_arrays(source: BinaryIO, names: Iterable[str]) -> dict[str, NDArray]:
    """Read some arrays of an ``.npz``; sizes are checked before anything is inflated, and nothing is unpickled.

    Args:
        source: the file.
        names: arrays that are wanted; those that are missing are left out, and others are not read.

    Raises:
        OmtwarpError: no ``.npz``, a damaged one, an array that is not of numbers or text, or too much in it.
    """
    try:
        _check_directory(source)
        with zipfile.ZipFile(source) as archive:
            entries = {entry.filename: entry for entry in archive.infolist()}
            wanted = {name: entries[f"{name}.npy"] for name in names if f"{name}.npy" in entries}
            total = sum(entry.file_size for entry in wanted.values())
            if total > LARGEST_ARRAYS:
                raise OmtwarpError(f"its arrays inflate to {amount(total)}, and {amount(LARGEST_ARRAYS)} is the most")
            return {name: _read_array(archive, entry, name) for name, entry in wanted.items()}
    except (OmtwarpError, MemoryError):
        raise
    except Exception as error:  # zipfile, zlib and NumPy raise many kinds on a damaged file
        raise OmtwarpError(f"damaged, or no .npz: {brief(error)}") from None


def write_arrays(path: str | os.PathLike[str], arrays: Mapping[str, ArrayLike]) -> None:
    """Write arrays as an ``.npz``, completely or not at all; :func:`read_arrays` reads it.

    Raises:
        OmtwarpError: the file cannot be written; nothing is left of it.
    """
    save: Callable[..., None] = np.savez  # typed as if every array could be its option allow_pickle
    # With a name in place of a file NumPy would add a suffix.
    with staged(as_path(path)) as file, open(file, "wb") as stream:
        save(stream, **arrays)


def holds_array(path: str | os.PathLike[str], *names: str) -> bool:
    """Return whether a file is an ``.npz`` with an array of one of these names; False for what cannot be read."""
    errors = OmtwarpError, OSError, ValueError, zipfile.BadZipFile
    with contextlib.suppress(*errors), open_input(path, LARGEST_MESH_FILE) as stream:
        _check_directory(stream)
        return not {f"{name}.npy" for name in names}.isdisjoint(zipfile.ZipFile(stream).namelist())
    return False


def _check_directory(source: BinaryIO) -> None:
    """Check the length of an archive's list of entries before it is read into memory.

    Raises:
        OmtwarpError: the list of entries is too long.
    """
    source.seek(0, os.SEEK_END)
    # Longest end: bytes in which a zip archive's last records stand, with the longest comment
    source.seek(max(source.tell() - (22 + 2**16 + 76), 0))
    end = source.read()
    source.seek(0)
    size, place = 0, end.rfind(b"PK\5\6")
    if 0 <= place <= len(end) - 22:
        size = int.from_bytes(end[place + 12 : place + 16], "little")
    if place >= 76 and end[place - 20 : place - 16] == b"PK\6\7":  # a locator: the record of a large archive before it
        if end[place - 76 : place - 72] != b"PK\6\6":
            raise OmtwarpError("damaged: its list of arrays is not where it should be")
        size = max(size, int.from_bytes(end[place - 36 : place - 28], "little"))
    if size > limits.LARGEST_DIRECTORY:
        raise OmtwarpError(f"its list of arrays has {amount(size)}, and {amount(limits.LARGEST_DIRECTORY)} is the most")


def _read_array(archive: zipfile.ZipFile, entry: zipfile.ZipInfo, name: str) -> NDArray:
    """Read an array after its header was found to fit the size of its entry.

    Raises:
        OmtwarpError: the entry holds objects, or its header announces another length than it has.
    """
    with archive.open(entry) as stream:
        _check_header(stream, entry.file_size, name)
    with archive.open(entry) as stream:
        return np.lib.format.read_array(stream, allow_pickle=False)


def _check_header(stream: IO[bytes], length: int, name: str) -> None:
    """Make sure that an array's header fits so many bytes, and leave the stream behind it.

    Raises:
        OmtwarpError: the array holds objects, or its header announces another length than there is.
    """
    version = np.lib.format.read_magic(stream)
    header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, dtype = header(stream)
    size = math.prod(shape) * dtype.itemsize
    if dtype.hasobject:
        raise OmtwarpError(f"'{name}' is not an array of numbers")
    if size != length - stream.tell():
        raise OmtwarpError(f"damaged: '{name}' is not as long as its header says")
    if dtype.kind in "US" and size > LARGEST_REPORT:
        raise OmtwarpError(f"'{name}' has {amount(size)} of text, and {amount(LARGEST_REPORT)} is the most")


def array_of(data: bytes, name: str = "data") -> NDArray:
    """Read an array from the content of an ``.npy`` file.

    Raises:
        OmtwarpError: the data are no array of NumPy, are damaged, or hold objects.
    """
    try:
        _check_header(io.BytesIO(data), len(data), name)
        return np.lib.format.read_array(io.BytesIO(data), allow_pickle=False)
    except OmtwarpError:
        raise
    except Exception as error:  # NumPy raises many kinds on a damaged header
        raise OmtwarpError(f"not an array in NumPy's format: {brief(error)}") from None


# Formats that textures come in and Pillow decodes itself; it would pass others, such as EPS, to programs of the system.
FORMATS = ("PNG", "JPEG", "TIFF", "WEBP", "BMP", "TGA")

_pillow = threading.Lock()  # over Pillow's own limit, which is one number for the whole process


def open_picture(stream: BinaryIO, formats: tuple[str, ...] = FORMATS) -> "Image":
    """Open a picture and read its header, without Pillow's own limit of size: the caller has one that fits.

    Raises:
        Exception: what Pillow raises on a file of another format.
    """
    from PIL import Image as pil

    with _pillow:
        limit = pil.MAX_IMAGE_PIXELS
        pil.MAX_IMAGE_PIXELS = None
        try:
            return pil.open(stream, formats=formats)
        finally:
            pil.MAX_IMAGE_PIXELS = limit


def read_stack(stream: BinaryIO) -> tuple[NDArray[np.generic], tuple[float, float, float]]:
    """Read the pages of a TIFF file, one above another, as a volume of numbers.

    Returns:
        Numbers of columns, rows and pages, shape [X, Y, Z], and the sides of a voxel: ImageJ's, or 1.

    Raises:
        OmtwarpError: colours, pages of different sizes, several channels or times, or too many numbers.
        Exception: what Pillow raises on a damaged file.
    """
    from PIL import ImageSequence

    # Tags of TIFF: the description, and texels per unit of length across and down
    described, across, down = 270, 282, 283
    pages: list[NDArray[np.generic]] = []
    with open_picture(stream, ("TIFF",)) as opened:
        text = str(opened.tag_v2.get(described, ""))  # type: ignore[attr-defined]
        per_unit = [float(opened.tag_v2.get(tag, 1.0)) for tag in (across, down)]  # type: ignore[attr-defined]
        if more := re.search(r"^(channels|frames)=([2-9]|\d{2,})", text, re.M):
            raise OmtwarpError(f"a volume of several {more.group(1)}: save one of them by itself")
        for image in ImageSequence.Iterator(opened):
            if image.mode not in ("1", "L", "P", "I", "F", "I;16", "I;16L", "I;16B"):
                raise OmtwarpError(f"pages of colours ({image.mode}), not of labels")
            if (len(pages) + 1) * image.width * image.height > MOST_TEXELS:
                raise OmtwarpError(f"more than {MOST_TEXELS / 1e6:.0f} million voxels, which is the most")
            page = np.asarray(image)
            if pages and page.shape != pages[0].shape:
                raise OmtwarpError(f"no volume: page {len(pages)} is of another size than the first")
            pages.append(page)
    thick = re.search(r"^spacing=(\S+)", text, re.M)
    sides = (1.0, 1.0, 1.0)
    if text.startswith("ImageJ=") and thick and min(per_unit) > 0.0:
        sides = (1.0 / per_unit[0], 1.0 / per_unit[1], abs(float(thick.group(1))))
    return np.stack(pages).transpose(2, 1, 0), sides
