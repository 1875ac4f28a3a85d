"""Files that are replaced as a whole: a full disk or a kill leaves the old one."""

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO


@contextmanager
def replaced(path: str | Path) -> Iterator[IO[bytes]]:
    """A binary file to write to that takes the place of `path`, at once and on disk, when all went well."""
    path = Path(path).resolve()  # of a link its target
    check_place(path)
    if path.exists() and not path.is_file():  # a folder is refused by open, a device cannot be replaced
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
    synchronize(path.parent)


@contextmanager
def made_beside(path: Path) -> Iterator[Path]:
    """A new folder that takes the place of `path` when all went well; one that is there gives way only then."""
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
    synchronize(path.parent)


def clear_partial(path: Path) -> None:
    """Remove files in a folder whose writing did not come to its end."""
    for file in path.rglob("*.partial"):
        file.unlink()


def check_place(path: Path) -> None:
    """Refuse a place where no file can be.

    Raises:
        FileNotFoundError: its folder does not exist.
        IsADirectoryError: it is a folder.
    """
    if not path.parent.is_dir():
        raise FileNotFoundError(f"{path} cannot be written: the folder {path.parent} does not exist; make it first.")
    if path.is_dir():
        raise IsADirectoryError(f"{path} is a folder; give the name of a file.")


def check_writable(path: Path) -> None:
    """Refuse a place where no file can be written, before long work: a file is made beside `path` and removed again.

    Permissions alone do not tell: on a file system that is read-only, or for a name that is too long, only an attempt does.

    Raises:
        FileNotFoundError, IsADirectoryError: as of `check_place`.
        OSError: the folder or the file cannot be written.
    """
    path = path.resolve()
    check_place(path)
    if path.exists() and not os.access(path, os.W_OK):
        raise PermissionError(f"{path} cannot be written: there is a file that may not be changed; give another name.")
    if path.exists() and not path.is_file():  # a device
        return
    attempt = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        attempt.touch()
        attempt.unlink()
    except OSError as error:
        raise OSError(error.errno, f"{path} cannot be written: {error.strerror}. Give another place.") from error


def make_writable_folder(path: Path) -> None:
    """Make a folder with all folders above it, and refuse one in which no file can be written.

    Raises:
        OSError: it cannot be made, or no file can be made in it.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OSError(
            error.errno, f"the folder {path} cannot be made: {error.strerror}. Give another place."
        ) from error
    check_writable(path / "attempt")


def synchronize(path: Path) -> None:
    """Wait until a file, or the entries of a folder, are on disk."""
    if os.name == "nt":  # folders cannot be opened there, files only for writing
        return
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
