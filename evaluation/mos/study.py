"""A study: the videos of every sentence in every condition, and what judges are told."""

from __future__ import annotations

import json
from collections.abc import Collection
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from typing import Any

from kouxing.shared.errors import UserError
from kouxing.shared.media_file import check_video

FILE_NAME = "study.json"
SUFFIXES = {".mp4", ".webm", ".mov"}
LANGUAGES = ("zh", "en")
SCALES = ("sync", "realism")
MAX_STIMULI = 2000


@dataclass(frozen=True, slots=True, kw_only=True)
class Study:
    """What ``study.json`` holds."""

    folder: Path
    title: str
    languages: tuple[str, ...]
    """The page's, of ``zh`` and ``en``."""
    sentences: tuple[str, ...]
    conditions: tuple[str, ...]
    reference: str
    """The condition that is the hidden reference; empty: none."""
    anchor: str
    """The condition that is the anchor, bad on purpose; empty: none."""
    files: dict[tuple[str, str], Path] = field(repr=False)
    """Of each sentence and condition, below the folder."""


def new_study(
    folder: Path,
    *,
    title: str,
    reference: str,
    anchor: str,
    languages: tuple[str, ...],
    conditions: Collection[str] = (),
) -> Study:
    """Find a folder's videos and write them down as a study.

    They are named ``CONDITION/SENTENCE.mp4``, or ``SENTENCE_CONDITION.mp4`` where the folder has no
    subfolders with videos; .webm and .mov are taken, too. ``conditions`` are those to take; empty:
    all.

    Raises
    ------
    UserError
        If the folder is a study, has no such videos, or lacks a sentence in a condition; if a file
        is no video with sound.
    """
    file = folder / FILE_NAME
    if file.exists():
        raise UserError(f"{file} is there already; its answers belong to it, take another folder")
    found = _in_subfolders(folder) or _by_name(folder)
    known = {condition for _, condition, _ in found}
    for name in conditions:
        if name not in known:
            raise UserError(f"there is no condition {name!r}; there are {', '.join(sorted(known))}")
    stimuli = [each for each in found if not conditions or each[1] in conditions]
    content = {
        "title": title or folder.resolve().name,
        "languages": languages,
        "reference": reference,
        "anchor": anchor,
        "stimuli": [
            {"sentence": sentence, "condition": condition, "file": path}
            for sentence, condition, path in stimuli
        ],
    }
    study = _parse(folder, content)
    for path in study.files.values():
        check_video(path)
    try:
        file.write_text(json.dumps(content, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    except OSError as error:
        raise UserError(f"{file}: cannot be written: {error.strerror}") from None
    return study


def load_study(folder: Path) -> Study:
    """Read a folder's study.

    Raises
    ------
    UserError
        If there is none, or it names a video that is not there or not below the folder.
    """
    file = folder / FILE_NAME
    try:
        return _parse(folder, json.loads(file.read_text(encoding="utf-8")))
    except FileNotFoundError:
        raise UserError(f"{file} is missing; first type: kouxing mos new {folder}") from None
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise UserError(f"{file}: this is no study: {error!r}") from None


def _in_subfolders(folder: Path) -> list[tuple[str, str, str]]:
    return [
        (path.stem, path.parent.name, str(path.relative_to(folder)))
        for path in sorted(folder.glob("*/*"))
        if path.suffix.lower() in SUFFIXES
    ]


def _by_name(folder: Path) -> list[tuple[str, str, str]]:
    parts = [
        (*path.stem.rpartition("_")[::2], path.name)
        for path in sorted(folder.glob("*_*"))
        if path.suffix.lower() in SUFFIXES
    ]
    return [(sentence, condition, path) for sentence, condition, path in parts if sentence]


def _parse(folder: Path, content: Any) -> Study:
    root = folder.resolve()
    files: dict[tuple[str, str], Path] = {}
    for each in content["stimuli"]:
        cell = str(each["sentence"]), str(each["condition"])
        path = (root / each["file"]).resolve()
        if not path.is_relative_to(root) or path.suffix.lower() not in SUFFIXES:
            raise UserError(f"{each['file']}: this is no video below {folder}")
        if not path.is_file():
            raise UserError(f"{each['file']}: this video of the study is missing in {folder}")
        if cell in files:
            raise UserError(f"{each['file']}: {' in '.join(cell)} has another video already")
        files[cell] = path
    if not files:
        raise UserError(
            f"{folder}: there are no videos; name them CONDITION/SENTENCE.mp4 or "
            "SENTENCE_CONDITION.mp4"
        )
    if len(files) > MAX_STIMULI:
        raise UserError(f"{folder}: {len(files)} videos are too many; {MAX_STIMULI} at most")
    study = Study(
        folder=root,
        title=str(content["title"]),
        languages=tuple(content["languages"]),
        sentences=tuple(dict.fromkeys(sentence for sentence, _ in files)),
        conditions=tuple(dict.fromkeys(condition for _, condition in files)),
        reference=str(content["reference"]),
        anchor=str(content["anchor"]),
        files=files,
    )
    _check(study)
    return study


def _check(study: Study) -> None:
    for cell in product(study.sentences, study.conditions):
        if cell not in study.files:
            raise UserError(f"there is no video of sentence {cell[0]!r} in condition {cell[1]!r}")
    if not study.languages or not set(study.languages) <= set(LANGUAGES):
        raise UserError(f"languages are {' and '.join(LANGUAGES)}, one or both")
    for role in ("reference", "anchor"):
        name = getattr(study, role)
        if name and name not in study.conditions:
            known = ", ".join(study.conditions)
            raise UserError(f"{role}: there is no condition {name!r}; there are {known}")
