"""Judges and their answers: lines of JSON, flushed to disk before they are acknowledged."""

import contextlib
import fcntl
import json
import os
import secrets
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from kouxing.shared.errors import UserError
from kouxing.shared.files.output_file import write_error
from kouxing.shared.files.user_file import check_content, parse_json, read_text

FILE_NAME = "answers.jsonl"
MAX_JUDGES = 10_000
_MAX_BYTES = 256 << 20
_CONTENT = "a file of listening-test answers"


@dataclass(frozen=True, slots=True)
class Answer:
    """One score."""

    judge: int  # determines the order of the videos
    place: int  # position in that order; negative: practice
    sentence: str
    condition: str
    scale: str
    score: int  # 1 (bad) to 5 (excellent)
    language: str  # language of the page: zh or en
    unix_s: float


class AnswerStore:
    """Adds judges and answers to a study's file, which only its owner can read."""

    def __init__(self, folder: Path) -> None:
        path = folder / FILE_NAME
        try:
            path.touch(mode=0o600)
            path.chmod(0o600)  # in case it existed
            self._file = path.open("a", encoding="utf-8")
        except OSError as error:
            raise write_error(path, error) from None
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            self._file.close()
            raise UserError(
                f"{folder}: another process is serving this study; stop it first"
            ) from None
        self.judges: dict[str, int] = {}  # number by token
        self.last_places: dict[int, int] = {}  # newest place that each judge has scored
        try:
            with check_content(path, _CONTENT):
                for line in _read_lines(path):
                    self._index_line(line)
        except UserError:
            self._file.close()
            raise
        self._file.write("\n")  # ends a line that a crash has cut

    def close(self) -> None:
        """Close the file, so that another process can serve the study."""
        self._file.close()

    def add_judge(self) -> str | None:
        """Add a judge and return their token, or None if there are MAX_JUDGES."""
        if len(self.judges) >= MAX_JUDGES:
            return None
        token = secrets.token_urlsafe(16)
        self._append([{"judge": len(self.judges), "token": token, "unix_s": time.time()}])
        return token

    def add(self, answers: Sequence[Answer]) -> None:
        """Save the scores of one video."""
        self._append([asdict(answer) for answer in answers])

    def _append(self, lines: Sequence[dict[str, Any]]) -> None:
        self._file.write("".join(json.dumps(line, ensure_ascii=False) + "\n" for line in lines))
        self._file.flush()
        os.fsync(self._file.fileno())
        for line in lines:
            self._index_line(line)

    def _index_line(self, line: dict[str, Any]) -> None:
        if "token" in line:
            self.judges[line["token"]] = line["judge"]
        else:
            self.last_places[line["judge"]] = line["place"]


def read_answers(folder: Path) -> list[Answer]:
    """Read all answers; raises ``UserError`` if the file cannot be read."""
    path = folder / FILE_NAME
    with check_content(path, _CONTENT):
        return [Answer(**line) for line in _read_lines(path) if "token" not in line]


def _read_lines(path: Path) -> list[dict[str, Any]]:
    lines = []
    if path.exists():
        for text in read_text(path, _MAX_BYTES).splitlines():
            # lines may be empty, or cut by a crash before they were acknowledged
            with contextlib.suppress(ValueError):
                lines.append(parse_json(text))
    return lines
