"""Atomic outputs, checked to be writable before the work starts.

Every file that the package writes for a user goes through :func:`staged`, from Python and from the command line alike:
links are followed and kept, an existing file's mode is kept, directories, devices, pipes and read-only files are
refused, and so are inputs of the command. What is not named by the user, companions of a named file and the files in a
folder of results, replaces only what :func:`_may_replace` allows: what the package wrote there before and nobody
changed, of which a record in the folder (:data:`RECORD`) has the digests, or any file with ``force``.
"""

import contextlib
import csv
import errno
import hashlib
import itertools
import json
import os
import secrets
import shutil
import stat
import tempfile
import time
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

from omtwarp.errors import OmtwarpError
from omtwarp.files.interruptions import removed_at_the_end

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

PREFIX = ".omtwarp-"  # of the directories that files are written in before they are moved
MARKER = "omtwarp-staging"  # the file in these directories that tells them from all others
RECORD = ".omtwarp.json"  # what the package wrote in a folder: names of files, and the digests of their content
STALE_SECONDS = 3600.0  # age from which a staging directory that no process holds is removed
STALE_UNKNOWN_SECONDS = 86400.0  # the same where it is unknown whether a process holds it

_places: dict[Path, Path] = {}  # staging directories of this process, and the files that they are for
_kept: list[Path] = []  # inputs of the command, which nothing replaces
_noting = False  # whether files that are read become such inputs
_forced = False  # whether files of others are replaced too
contents: dict[tuple[int, ...], bytes] = {}  # of inputs of the command, by what tells them, see files.inputs
_results: list[Path] = []  # folders of results, all of whose files are the package's own


def as_path(given: str | os.PathLike[str]) -> Path:
    """Check the name of a file.

    Raises:
        OmtwarpError: neither text nor a path.
    """
    try:
        return Path(given)
    except TypeError:
        raise OmtwarpError(f"the name of a file must be text or a path, not a {type(given).__name__}") from None


def check_output(path: str | os.PathLike[str] | None, suffixes: tuple[str, ...] = (), *inputs: Path | None) -> None:
    """Make sure that an output can be written, by a trial, before any long computation.

    Args:
        path: the file to be; None where none is asked for.
        suffixes: what it may end in, with the dot, in small letters; anything if empty.
        inputs: files that it must not be.

    Raises:
        OmtwarpError: an unknown suffix, no directory, no right to write, something there that is not a regular file,
            or an input as the output.
    """
    if path is None:
        return
    given = as_path(path)
    if suffixes and given.suffix.lower() not in suffixes:
        raise OmtwarpError(f"cannot write '{path}': unknown suffix '{given.suffix}', use {', '.join(suffixes)}")
    try:
        target = _destination(given)
        _require_no_input(given, target, inputs)
        if target.parent not in _places:
            with _new_folder(target.parent):
                pass
    except OSError as error:
        raise _cannot_write(given, error) from None


def check_outputs(
    outputs: Iterable[tuple[str | os.PathLike[str] | None, tuple[str, ...]]], *inputs: Path | None
) -> None:
    """Make sure that each of a command's outputs can be written, and that no two are the same file.

    Args:
        outputs: files, None where none is asked for, with what they may end in, as of :func:`check_output`.
        inputs: files that none of them must be.

    Raises:
        OmtwarpError: as of :func:`check_output`, or one file is named twice.
    """
    taken = set()
    for path, suffixes in outputs:
        check_output(path, suffixes, *inputs)
        if path is None:
            continue
        target = _destination(as_path(path))
        if target in taken:
            raise OmtwarpError(f"cannot write '{path}' twice: give each output a name of its own")
        taken.add(target)


def make_folder(folder: Path) -> None:
    """Make a folder of outputs, with those above it, where it is not there.

    Raises:
        OmtwarpError: it cannot be made.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OmtwarpError(f"cannot write to '{folder}': {error.strerror or error}") from None


def check_folder(path: str | os.PathLike[str]) -> Path:
    """Make sure that a folder of outputs is there or can be made, before anything long is computed; make nothing.

    Raises:
        OmtwarpError: the path names something other than a folder, or may not be written to.
    """
    given = as_path(path)
    try:
        there = next(folder for folder in (given, *given.absolute().parents) if os.path.lexists(folder))
        if not there.is_dir():
            raise NotADirectoryError(errno.ENOTDIR, f"'{there}' is not a directory")
        if not os.access(there, os.W_OK):
            raise PermissionError(errno.EACCES, "Permission denied")
    except (OSError, ValueError) as error:
        words = getattr(error, "strerror", None) or error
        raise OmtwarpError(f"cannot write to '{given}': {words}") from None
    return given


def _destination(path: Path) -> Path:
    """Return the file to write for a path, with links followed; refuse a path whose file must not be replaced.

    Raises:
        OmtwarpError: the path is a directory, a device or pipe, or a link to itself, or its directory does not exist.
        OSError: no right to write, a name that is too long.
    """
    if "\0" in str(path):
        raise OSError(errno.EINVAL, "no file can have such a name")
    target = Path(os.path.realpath(path))
    try:
        mode = os.lstat(target).st_mode
    except (FileNotFoundError, NotADirectoryError):
        if not target.parent.is_dir():
            folder = (target if path.is_symlink() else path).parent
            raise OmtwarpError(f"cannot write '{path}': there is no directory '{folder}'") from None
        return target
    if stat.S_ISDIR(mode):
        raise OmtwarpError(f"cannot write '{path}': it is a directory")
    if stat.S_ISLNK(mode):
        raise OmtwarpError(f"cannot write '{path}': it is a symbolic link that leads to itself")
    if not stat.S_ISREG(mode):
        raise OmtwarpError(f"cannot write '{path}': it is not a regular file")
    if not os.access(target, os.W_OK):
        raise PermissionError(errno.EACCES, "Permission denied")
    return target


def _require_no_input(given: Path, target: Path, inputs: Iterable[Path | None] = ()) -> None:
    """Refuse to write what a command reads.

    Raises:
        OmtwarpError: the file is one of some inputs, or of those of :func:`keeping`.
    """
    if _is_one_of(target, (*inputs, *_kept)):
        raise OmtwarpError(f"cannot write '{given}': it is the input; choose another name")


@contextlib.contextmanager
def keeping(inputs: Iterable[Path], *, force: bool = False) -> Iterator[None]:
    """Keep files, and all that are read in the meantime, from being replaced by what is written in the meantime.

    What is read of files is kept too, so that each is opened once, and is the same for all who read it.

    Args:
        inputs: the files.
        force: whether companions and results replace files that the package did not write, except those kept.
    """
    global _noting, _forced
    before = list(_kept), list(_results), _noting, _forced
    _kept.extend(inputs)
    _noting, _forced = True, force
    try:
        yield
    finally:
        _kept[:], _results[:], _noting, _forced = before
        contents.clear()


def note_input(path: str | os.PathLike[str]) -> bool:
    """Keep a file that is read from being replaced, inside of :func:`keeping`: also one that another file names.

    Returns:
        Whether this is inside of it.
    """
    if _noting:
        _kept.append(Path(path))
    return _noting


@contextlib.contextmanager
def folder_of_results(folder: Path, *names: str) -> Iterator[None]:
    """Replace nothing in a folder in the meantime but what the package wrote there; see :func:`guard_results`."""
    before = list(_results)
    guard_results(folder, *names)
    try:
        yield
    finally:
        _results[:] = before


def guard_results(folder: Path, *names: str) -> None:
    """Replace nothing in a folder, to the end of :func:`keeping`, but what the package wrote there before.

    Args:
        folder: where results go; it need not exist yet.
        names: of files that will be written, which are looked at before the work.

    Raises:
        OmtwarpError: a file that would be replaced is not the package's.
    """
    place = Path(os.path.realpath(folder))
    for name in names:
        require_own(folder / name, _may_replace(place / name))
    _results.append(place)


def require_own(given: Path, own: bool) -> None:
    """Refuse a result whose place holds what the package did not write, but with ``--force``.

    Args:
        given: the file to be.
        own: whether its place is free, or holds what the package wrote there.

    Raises:
        OmtwarpError: the place holds a file of somebody's own.
    """
    if not own and not (_forced and given.is_file() and not given.is_symlink()):
        raise OmtwarpError(
            f"cannot write '{given}': omtwarp did not write what is there, or it was changed; move it away, or "
            "choose another directory"
        )


def _may_replace(target: Path, keep: Iterable[Path | None] = ()) -> bool:
    """Return whether a file that the user did not name may be written: one that is free, the package's, or forced.

    Raises:
        OSError: the system does not tell what is there.
    """
    if not os.path.lexists(target):
        return True
    forced = _forced and target.is_file() and not target.is_symlink()
    return (forced or written_by_omtwarp(target)) and not _is_one_of(target, (*keep, *_kept))


def _cannot_write(path: Path, error: OSError) -> OmtwarpError:
    """Make the error for an output that failed, in the system's words."""
    return OmtwarpError(f"cannot write '{path}': {error.strerror or error}")


def _is_one_of(path: Path, others: Iterable[Path | None]) -> bool:
    """Return whether a path is the same file as one of the others."""
    for other in others:
        with contextlib.suppress(OSError):
            if other is not None and path.samefile(other):
                return True
    return False


def written_by_omtwarp(path: Path) -> bool:
    """Return whether the record of a file's folder has the file as it is now.

    Raises:
        OSError: the file cannot be read.
    """
    return not path.is_symlink() and path.is_file() and _recorded(path.parent).get(path.name) == digest_of(path)


def _content(path: Path) -> bytes:
    """Read a small file of the package's own; nothing of what is no regular file, for which it does not wait.

    Raises:
        OSError: it cannot be read.
    """
    descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0))
    with open(descriptor, "rb") as stream:
        # Largest record: bytes
        return stream.read(1 << 24) if stat.S_ISREG(os.fstat(descriptor).st_mode) else b""


def digest_of(path: Path) -> str:
    """Return the SHA-256 of a file's content.

    Raises:
        OSError: the file cannot be read.
    """
    with open(path, "rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def _recorded(folder: Path) -> dict[str, object]:
    """Return the record of a folder; empty where there is none, or none that can be read."""
    with contextlib.suppress(OSError, ValueError, RecursionError):
        recorded = json.loads(_content(folder / RECORD))
        return recorded if isinstance(recorded, dict) else {}
    return {}


def _record(folder: Path, names: Iterable[str]) -> None:
    """Add files to the record of their folder, as they are now; other processes that do the same wait."""
    part = folder / f"{RECORD}.{secrets.token_hex(4)}"
    with _held(folder, wait=not folder.name.startswith(PREFIX)):  # folders of its own are held already
        known = _recorded(folder) | {name: digest_of(folder / name) for name in names}
        there = {name: digest for name, digest in known.items() if os.path.lexists(folder / name)}
        try:
            part.write_text(json.dumps(there, indent=1) + "\n", "utf-8")
            os.replace(part, folder / RECORD)
        finally:
            part.unlink(missing_ok=True)


def companion(path: Path, suffix: str, keep: Iterable[Path | None] = ()) -> Path:
    """Choose a name for a companion of a file, such as the picture of a textured mesh.

    The name is free, or that of a file which the package wrote there before; never that of a file of the user's.

    Args:
        path: the file that it belongs to; only the name's stem is used, without spaces.
        suffix: of the companion, with the dot.
        keep: files that must not be replaced even if the package wrote them, such as inputs.

    Returns:
        A path in the same directory.

    Raises:
        OmtwarpError: the system does not tell what is at the companion's path.
    """
    folder = _destination(_places.get(path.parent, path)).parent
    stem = "_".join(path.stem.split()) or "texture"
    names = itertools.chain((stem, f"{stem}-texture"), (f"{stem}-texture-{number}" for number in itertools.count(2)))
    kept, there = tuple(keep), folder
    try:
        for name in names:
            there = folder / f"{name}{suffix}"
            if _may_replace(there, kept):
                break
        return path.with_name(there.name)
    except OSError as error:
        raise _cannot_write(path.with_name(there.name), error) from None


@contextlib.contextmanager
def staged(path: str | os.PathLike[str], *, keep: Iterable[Path | None] = ()) -> Iterator[Path]:
    """Yield a path of the same name in a new directory next to the target; at the end, move all that was written there.

    Companions written with the file (materials, textures) move with it. After an error or an
    interruption nothing is left, neither parts nor the directory, and an older file is as it was. Where the file is
    staged already, by a caller, the path itself is given.

    Args:
        path: the file to be; links are followed and kept, and so is the mode of a file that is replaced.
        keep: files that companions must not replace.

    Raises:
        OmtwarpError: no place that can be written to, a full disk, a device or pipe, or a file beside the target that
            the package did not write and would have to replace.
    """
    given = as_path(path)
    if given.parent in _places:
        try:
            yield given
        except BaseException:
            given.unlink(missing_ok=True)
            raise
        return
    folder: Path | None = None
    try:
        target = _destination(given)
        _require_no_input(given, target)
        if target.parent in _results:
            require_own(given, _may_replace(target))
        _sweep(target.parent)
        with _new_folder(target.parent) as folder:
            _places[folder] = target
            try:
                yield folder / target.name
                _move(folder, target, given, tuple(keep))
            finally:
                _places.pop(folder, None)
    except BrokenPipeError:  # by standard output, not by a file
        raise
    except OmtwarpError as error:
        if folder is None or str(folder) not in str(error):
            raise
        raise OmtwarpError(str(error).replace(str(folder), str(given.parent))) from None
    except OSError as error:
        raise _cannot_write(given, error) from error


def write_text(path: str | os.PathLike[str], text: str, encoding: str = "utf-8") -> None:
    """Write a file of text, whole or not at all; bytes of a file's name that are no UTF-8 are backslashed in it."""
    with staged(path) as file:
        file.write_text(text, encoding, "backslashreplace")


def write_table(path: Path, columns: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """Write a table of comma-separated values (.csv), empty where there is None; names as :func:`write_text` does."""
    with staged(path) as file, open(file, "w", encoding="utf-8", errors="backslashreplace", newline="") as stream:
        csv.writer(stream).writerows([columns, *rows])


def _move(folder: Path, target: Path, given: Path, keep: tuple[Path | None, ...]) -> None:
    """Move what was written to where it belongs: companions first, so that the file never names one that is not there.

    Raises:
        OmtwarpError: a companion would replace a file of the user's.
    """
    moves = []
    written = [file for file in folder.iterdir() if file.name != MARKER]
    for file in sorted(written, key=lambda file: file.name == target.name):
        place = target.parent / file.name
        if place != target and not _may_replace(place, keep):
            name = given.with_name(place.name)
            raise OmtwarpError(f"cannot write '{given}': '{name}' would be replaced, which omtwarp did not write")
        moves.append((file, place))
    for file, place in moves:
        with contextlib.suppress(FileNotFoundError):
            old = os.stat(place)
            with contextlib.suppress(OSError, AttributeError):  # only root gives files away; Windows has no owners
                if (old.st_uid, old.st_gid) != (os.getuid(), os.getgid()):
                    os.chown(file, old.st_uid, old.st_gid)
            os.chmod(file, stat.S_IMODE(old.st_mode))
        os.replace(file, place)
    own = [place.name for _, place in moves if place != target or target.parent in _results]
    if own:
        with contextlib.suppress(OSError):  # without a record they are only not replaced the next time
            _record(target.parent, own)


@contextlib.contextmanager
def scratch() -> Iterator[Path]:
    """Yield a new directory among the system's temporary ones, and remove it at the end."""
    parent = Path(tempfile.gettempdir())
    _sweep(parent)
    with _new_folder(parent) as folder:
        yield folder


@contextlib.contextmanager
def _new_folder(parent: Path) -> Iterator[Path]:
    """Yield a new directory that is held, and remove it at the end; interruptions remove it from the first moment."""
    folder = parent / f"{PREFIX}{secrets.token_hex(8)}"
    with removed_at_the_end(folder):
        try:
            folder.mkdir(mode=0o700)
            (folder / MARKER).write_text(folder.name, "utf-8")
            with _held(folder):
                yield folder
        finally:
            shutil.rmtree(folder, ignore_errors=True)


@contextlib.contextmanager
def _held(folder: Path, *, wait: bool = False) -> Iterator[None]:
    """Hold a lock on a directory that ends with the process, however that ends; wait for one that another holds."""
    if fcntl is None:
        yield
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        with contextlib.suppress(OSError):  # not every file system has locks
            fcntl.flock(descriptor, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        yield
    finally:
        os.close(descriptor)


@contextlib.contextmanager
def locked(place: Path, refusal: str = "") -> Iterator[None]:
    """Lock a file to the end, which any exit brings; where there are no locks, as on Windows, nothing is kept apart.

    Args:
        place: the file; it is made where it is not there.
        refusal: what is said where another process has the lock; without it this one waits.

    Raises:
        OmtwarpError: another process has the lock, and is not to be waited for.
    """
    with open(place, "a") as file:
        try:
            if fcntl is not None:
                fcntl.flock(file, fcntl.LOCK_EX | (fcntl.LOCK_NB if refusal else 0))
        except BlockingIOError:
            raise OmtwarpError(refusal) from None
        except OSError:  # some network file systems have no locks
            pass
        yield


def _sweep(parent: Path) -> None:
    """Remove staging directories of processes that were killed: marked, the user's own, old, and held by nobody."""
    with contextlib.suppress(OSError):
        for entry in os.scandir(parent):
            if entry.name.startswith(PREFIX) and entry.is_dir(follow_symlinks=False):
                with contextlib.suppress(OSError):
                    if _abandoned(Path(entry.path)):
                        shutil.rmtree(entry.path, ignore_errors=True)


def _abandoned(folder: Path) -> bool:
    """Return whether a directory is marked as one for staging, is this user's, old, and no process holds it.

    Raises:
        OSError: it cannot be looked at, for instance because it is gone.
    """
    status = os.stat(folder, follow_symlinks=False)
    if hasattr(os, "getuid") and status.st_uid != os.getuid():
        return False
    if _content(folder / MARKER) != folder.name.encode():
        return False
    changed = [status.st_mtime, *(os.stat(file, follow_symlinks=False).st_mtime for file in folder.iterdir())]
    age = time.time() - max(changed)
    if fcntl is None or age < STALE_SECONDS:
        return age > STALE_UNKNOWN_SECONDS
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        return True
    except BlockingIOError:
        return False
    except OSError:  # no locks on this file system
        return age > STALE_UNKNOWN_SECONDS
    finally:
        os.close(descriptor)
