"""A study: one video of every sentence in every condition, listed in ``study.json``.

A judge sees the videos in the order of a Williams design (Williams 1949). It is a Latin square, or
two for an odd number of conditions, in which every condition also follows every other equally
often. A judge sees one row per sentence, drawn at random. Two videos for practice (ITU-T P.910)
come first and do not count.
"""

import random
import shlex
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from kouxing.shared.arrays import Integers
from kouxing.shared.audio.audio_file import check_video
from kouxing.shared.command.terminal import write_json
from kouxing.shared.errors import UserError
from kouxing.shared.files.user_file import check_content, parse_json, read_text

FILE_NAME = "study.json"
REFERENCE, ANCHOR = "reference", "anchor"  # the best condition, and one that is bad on purpose
SUFFIXES = {".mp4", ".webm", ".mov"}
LANGUAGES = ("zh", "en")  # languages of the page
_MAX_BYTES = 16 << 20
SCALES = ("sync", "realism")


@dataclass(frozen=True, slots=True)
class Study:
    """Contents of ``study.json``."""

    folder: Path
    sentences: tuple[str, ...]
    conditions: tuple[str, ...]
    files: dict[tuple[str, str], Path] = field(repr=False)  # by sentence and condition


def check_no_study(folder: Path) -> None:
    """Raise UserError if a folder already contains a study."""
    file = folder / FILE_NAME
    if file.exists():
        raise UserError(f"{file} exists, and answers may refer to it; use another folder")


def new_study(folder: Path) -> Study:
    """Find the videos ``CONDITION/SENTENCE.mp4`` of a folder and write ``study.json``.

    Raises ``UserError`` if the folder already is a study, lacks videos, or has one without sound.
    """
    check_no_study(folder)
    videos = [path for path in sorted(folder.glob("*/*")) if path.suffix.lower() in SUFFIXES]
    content = {"videos": [f"{path.parent.name}/{path.name}" for path in videos]}
    study = _parse(folder, content)
    for path in study.files.values():
        check_video(path)
    write_json(folder / FILE_NAME, content)
    return study


def load_study(folder: Path) -> Study:
    """Read the study of a folder; raises ``UserError`` if it is missing, invalid or incomplete."""
    file = folder / FILE_NAME
    if not file.exists():
        raise UserError(
            f"{file} is missing; create it with: kouxing mos new {shlex.quote(str(folder))}"
        )
    with check_content(file, "a valid study"):
        return _parse(folder, parse_json(read_text(file, _MAX_BYTES)))


def _parse(folder: Path, content: Any) -> Study:
    root = folder.resolve()
    files: dict[tuple[str, str], Path] = {}
    for name in content["videos"]:
        path = (root / name).resolve()
        if not path.is_relative_to(root) or path.suffix.lower() not in SUFFIXES:
            raise UserError(f"{name}: not a video inside {folder}")
        if not path.is_file():
            raise UserError(f"{name}: this video is missing from {folder}")
        files[Path(name).stem, Path(name).parent.name] = path
    if not files:
        raise UserError(f"{folder} has no videos; name them CONDITION/SENTENCE.mp4")
    sentences, conditions = (tuple(dict.fromkeys(names)) for names in zip(*files, strict=True))
    for sentence, condition in product(sentences, conditions):
        if (sentence, condition) not in files:
            raise UserError(f"sentence {sentence!r} has no video in condition {condition!r}")
    return Study(root, sentences, conditions, files)


def williams_design(num_conditions: int) -> Integers:
    """Return orders of conditions as rows: shape (n, n), for an odd n > 1 (2 n, n)."""
    n = num_conditions
    steps = np.arange(n)
    first = np.where(steps % 2, (steps + 1) // 2, -(steps // 2))  # 0, 1, -1, 2, -2 ...
    square = (first + steps[:, None]) % n
    return square if n % 2 == 0 or n == 1 else np.vstack([square, square[:, ::-1]])


def places_of_judge(judge: int, study: Study) -> dict[int, tuple[str, str]]:
    """Return the sentence and condition at every place of a judge; practice is below 0.

    If the number of judges is a multiple of the design's number of rows, every condition is equally
    frequent at every place.
    """
    sentences, conditions = study.sentences, study.conditions
    design = williams_design(len(conditions))
    rows = random.Random(0)  # noqa: S311 - no secret; the same for all judges
    shuffled = random.Random(judge).sample(sentences, len(sentences))  # noqa: S311 - no secret
    # The conditions use sentences as far apart as possible, so that a sentence returns late.
    offsets = design[judge % len(design)] * len(sentences) // len(conditions)
    order = [
        (shuffled[(block + offsets[condition]) % len(sentences)], conditions[condition])
        for block in range(len(sentences))
        for condition in design[(judge + rows.randrange(len(design))) % len(design)]
    ]
    extremes = [name for name in (REFERENCE, ANCHOR) if name in conditions]
    practice = [(order[-1][0], name) for name in dict.fromkeys((*extremes, *conditions))][:2]
    return dict(enumerate([*practice, *order], start=-len(practice)))
