"""Outputs are complete or absent."""

import errno
from pathlib import Path

import pytest

from kouxing.shared.errors import UserError
from kouxing.shared.output_file import open_output


def fill_the_disk(path: Path) -> None:
    with open_output(path) as file:
        file.write(b"glTF")
        raise OSError(errno.ENOSPC, "No space left on device")


def test_a_file_is_deleted_if_the_disk_is_full(tmp_path: Path) -> None:
    path = tmp_path / "head.glb"
    with pytest.raises(UserError, match="the disk is full"):
        fill_the_disk(path)
    assert not path.exists()


def test_an_error_names_the_folder_to_create(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="mkdir -p"), open_output(tmp_path / "new/head.glb"):
        pass


def test_an_error_names_the_folder_that_a_link_needs(tmp_path: Path) -> None:
    link = tmp_path / "head.glb"
    link.symlink_to(tmp_path / "new" / "head.glb")
    with pytest.raises(UserError, match=f"mkdir -p {tmp_path}/new"), open_output(link):
        pass


def test_a_device_is_not_deleted() -> None:
    with pytest.raises(UserError, match="the disk is full"), open_output(Path("/dev/full")) as file:
        file.write(b"text")
    assert Path("/dev/full").exists()
