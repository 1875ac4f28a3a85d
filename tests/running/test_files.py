"""Files are replaced as a whole, or stay."""

import errno

import pytest

from vmri_jax.running.files import check_place, replaced


def test_a_file_is_replaced_when_all_is_written(tmp_path):
    path, link = tmp_path / "file", tmp_path / "link"
    path.write_bytes(b"old")
    link.symlink_to(path)
    with pytest.raises(KeyboardInterrupt), replaced(path):
        raise KeyboardInterrupt
    with replaced(link) as file:
        file.write(b"new")
        assert path.read_bytes() == b"old"
    assert link.is_symlink()
    assert path.read_bytes() == b"new"
    assert {path.name for path in tmp_path.iterdir()} == {"file", "link"}


def test_a_device_is_written_to():
    """The device that is always full."""
    with pytest.raises(OSError, match="No space left") as caught, replaced("/dev/full") as file:
        file.write(b"new")
    assert caught.value.errno == errno.ENOSPC


def test_places_where_no_file_can_be(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"the folder .*nowhere does not exist; make it first"):
        check_place(tmp_path / "nowhere" / "run.npz")
    with pytest.raises(IsADirectoryError, match="is a folder; give the name of a file"):
        check_place(tmp_path)
