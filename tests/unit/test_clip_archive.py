"""The archive of clips contains only those whose licenses allow sharing, with their parts."""

import json
import shutil
import zipfile
from pathlib import Path

import pytest

from kouxing.corpora.lip_clips import read_clips, write_clip_archive
from kouxing.shared.errors import UserError
from tests.lip_clips import write_held_out_clip


def test_packs_the_clips_that_may_be_shared(tmp_path: Path) -> None:
    folder, archive = tmp_path / "clips", tmp_path / "clips.zip"
    folder.mkdir()
    write_held_out_clip(folder)
    about = folder / "cam_1.json"
    for name in (
        "MIT; footage by third parties", "CC BY 4.0 (3rd-party clips)", "CC BY-NC 4.0", "not CC0",
        "CC BY 4.0 (footage by Third Parties)",
    ):  # fmt: skip
        about.write_text(json.dumps({"language": "zh", "license": name}))
        with pytest.raises(UserError, match="no clip has a license that allows sharing"):
            write_clip_archive(folder, archive)
    assert not archive.exists()
    about.write_text(json.dumps({"speaker": "ann", "language": "zh", "license": "CC BY 4.0"}))
    for path in folder.glob("cam_1.*"):
        shutil.copy(path, path.with_name("cam_2" + path.suffix))
    (folder / "cam_2.json").write_text(json.dumps({"license": "CC BY-NC 4.0"}))
    assert write_clip_archive(folder, archive) == (1, {"CC BY-NC 4.0"})
    with zipfile.ZipFile(archive) as file:
        file.extractall(tmp_path / "copy")
    (copy,) = read_clips(tmp_path / "copy")
    assert (copy.name, copy.split, copy.license) == ("cam_1", "held", "CC BY 4.0")
    assert "cam_1\theld\tzh\tann\tCC BY 4.0" in (tmp_path / "copy" / "clips.tsv").read_text()
