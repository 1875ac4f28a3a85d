"""Files that are replaced as a whole: a full disk or a kill leaves the old one."""

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO


@contextmanager
def replaced(path: str | Path) -> Iterator[IO[bytes]]:
    """A binary file to write to; without an error it replaces `path` in one operation, after its bytes are on disk."""
    path = Path(path).resolve()  # a link stays, its target is replaced
    check_place(path)
    if path.exists() and not path.is_file():  # a device is written to directly: it cannot be replaced
        with path.open("wb") as file:
            yield file
        return
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        with partial.open("wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        partial.replace(path)
    except BaseException:
        partial.unlink(missing_ok=True)
        raise
    synchronize(path)


@contextmanager
def made_beside(path: Path) -> Iterator[Path]:
    """A new folder that replaces `path` if the block raises nothing; until then an existing folder stays."""
    partial, old = (path.with_name(f".{path.name}.{os.getpid()}.{end}") for end in ("partial", "old"))
    shutil.rmtree(partial, ignore_errors=True)
    try:
        yield partial
        if path.exists():
            path.rename(old)
        partial.rename(path)
    except BaseException:
        shutil.rmtree(partial, ignore_errors=True)
        raise
    shutil.rmtree(old, ignore_errors=True)
    synchronize(path)


@contextmanager
def explained(path: Path, advice: str) -> Iterator[None]:
    """Context whose errors of the file system name the path that cannot be written, and end with the advice."""
    try:
        yield
    except OSError as error:
        raise OSError(error.errno, f"{path} cannot be written: {error.strerror or error}. {advice}") from error


def check_place(path: Path) -> None:
    """Refuse a path where no file can be: FileNotFoundError without its folder, IsADirectoryError for a folder."""
    if not path.parent.is_dir():
        raise FileNotFoundError(f"{path} cannot be written: the folder {path.parent} does not exist; make it first.")
    if os.path.isdir(path):  # False, where `Path.is_dir` raises: a name that is too long
        raise IsADirectoryError(f"{path} is a folder; give the name of a file.")


def check_writable(path: Path) -> None:
    """Refuse a path where no file can be written, before long work: a file is made beside `path` and removed again.

    Permissions alone do not tell: only an attempt finds a read-only file system, or a name that is too long.
    """
    check_place(path)
    path = path.resolve()
    if os.path.exists(path) and not os.access(path, os.W_OK):
        raise PermissionError(f"{path} cannot be written: there is a file that may not be changed; give another name.")
    if os.path.exists(path) and not path.is_file():  # a device: written to directly, without a file beside it
        return
    attempt = path.with_name(f".{path.name}.{os.getpid()}.partial")
    with explained(path, "Give another place."):
        attempt.touch()
        attempt.unlink()


def make_writable_folder(path: Path) -> None:
    """Make a folder with all folders above it, and refuse a folder in which no file can be written."""
    with explained(path, "Give another place."):
        path.mkdir(parents=True, exist_ok=True)
    check_writable(path / "attempt")


def synchronize(*paths: Path) -> None:
    """Wait until these files, as far as they exist, and the lists of files of their folders are on disk."""
    if os.name == "nt":  # Windows opens no folders, and files for synchronisation only if they are writable
        return
    for path in (*filter(Path.exists, paths), *{path.parent for path in paths}):
        descriptor = os.open(path, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
