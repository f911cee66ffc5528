"""Packs the clips whose licenses allow sharing."""

import zipfile
from pathlib import Path

from kouxing.corpora.lip_clips import read_clips
from kouxing.corpora.speech_corpus import may_distribute
from kouxing.shared.errors import UserError
from kouxing.shared.files.output_file import write_error

_SUFFIXES = (".flac", ".csv", ".json")
_COLUMNS = ("clip", "split", "language", "speaker", "license")


def write_clip_archive(folder: Path, archive: Path) -> int:
    """Write the clips of a folder that may be shared to a ZIP file, and return their number.

    ``held.txt`` names all held-out clips. ``clips.tsv`` lists split, language, speaker and license
    of each clip. Raises ``UserError`` if no clip may be shared, or the file cannot be written.
    """
    clips = [clip for clip in read_clips(folder, language=None) if _may_share(clip.license)]
    if not clips:
        raise UserError(f"{folder}: no clip has a license that allows sharing, such as CC BY")
    rows = [(c.name, c.split, c.language, c.speaker, c.license.replace("\t", " ")) for c in clips]
    table = "\n".join("\t".join(row) for row in [_COLUMNS, *rows]) + "\n"
    unfinished = archive.with_name(archive.name + ".part")
    try:
        with zipfile.ZipFile(unfinished, "w", zipfile.ZIP_DEFLATED) as file:
            file.writestr("clips.tsv", table)
            file.writestr("held.txt", "".join(f"{c.name}\n" for c in clips if c.split == "held"))
            for clip in clips:
                for suffix in _SUFFIXES:
                    file.write(folder / (clip.name + suffix), clip.name + suffix)
        unfinished.replace(archive)
    except OSError as error:
        unfinished.unlink(missing_ok=True)
        raise write_error(archive, error) from None
    return len(clips)


def _may_share(license_name: str) -> bool:
    """Return whether the clips may be shared: a model may use footage by third parties."""
    return may_distribute(license_name) and "third part" not in license_name
