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


def synchronize(path: Path) -> None:
    """Wait until a file, or the entries of a folder, are on disk."""
    if os.name == "nt":  # folders cannot be opened there, files only for writing
        return
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
