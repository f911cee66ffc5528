"""Checking and writing output files."""

from pathlib import Path

import pytest

from kouxing.shared.errors import UserError
from kouxing.shared.terminal import check_output, write_text

pytestmark = pytest.mark.unit


def test_check_output_changes_no_file(tmp_path: Path) -> None:
    old, new = tmp_path / "old.json", tmp_path / "new.json"
    old.write_text("kept")
    check_output(None, old, new)
    assert old.read_text() == "kept"
    assert not new.exists()
    for wrong in (tmp_path, old / "below.json"):
        with pytest.raises(UserError, match="cannot be written"):
            check_output(None, new, wrong)


def test_creates_no_folder_for_an_output(tmp_path: Path) -> None:
    missing = tmp_path / "folder"
    for write in (check_output, lambda path: write_text(path, "text")):
        with pytest.raises(UserError, match=f"mkdir -p {missing}"):
            write(missing / "new.json")
    assert not missing.exists()
