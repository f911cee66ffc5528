"""Answers on disk: each is there once it is acknowledged, and only once.

SQLite with a write-ahead log that is flushed with every answer, so that neither a crash nor a power
cut loses one. The first answer counts: a second one, of a double click or a reload, is dropped.
Nobody but the file's owner reads it; SQLite gives its log the same rights.
"""

from __future__ import annotations

import secrets
import sqlite3
import time
from dataclasses import dataclass
from pathlib import Path

from evaluation.mos.study import SCALES
from shared.errors import UserError

FILE_NAME = "answers.sqlite"
MAX_JUDGES = 10_000  # nobody fills the disk
MAX_BEEPS = 6
_TABLES = """
CREATE TABLE IF NOT EXISTS judges (
    number INTEGER PRIMARY KEY,
    token TEXT NOT NULL UNIQUE,
    beeps INTEGER NOT NULL,
    hears INTEGER NOT NULL DEFAULT 0
);
CREATE TABLE IF NOT EXISTS answers (
    judge INTEGER NOT NULL REFERENCES judges,
    sentence TEXT NOT NULL,
    condition TEXT NOT NULL,
    scale TEXT NOT NULL,
    score INTEGER NOT NULL CHECK (score BETWEEN 1 AND 5),
    unix_s REAL NOT NULL,
    PRIMARY KEY (judge, sentence, condition, scale)
) WITHOUT ROWID;
"""


@dataclass(frozen=True, slots=True)
class Judge:
    """One who judges."""

    number: int
    """From 0, in the order in which they came."""
    beeps: int
    """How many beeps the sound check plays."""
    hears: bool
    """Whether the beeps have been counted."""


@dataclass(frozen=True, slots=True)
class Answer:
    """One score."""

    judge: int
    sentence: str
    condition: str
    scale: str
    score: int
    """From 1 (bad) to 5 (excellent)."""
    unix_s: float


class Store:
    """A study's judges and answers.

    Parameters
    ----------
    folder
        The study's.

    Raises
    ------
    UserError
        If the file cannot be opened.
    """

    def __init__(self, folder: Path) -> None:
        path = folder / FILE_NAME
        try:
            path.touch(mode=0o600)
            path.chmod(0o600)  # where it was there already
            self._database = sqlite3.connect(path, isolation_level=None)
            self._database.execute("PRAGMA journal_mode = WAL")
            self._database.execute("PRAGMA synchronous = FULL")
            self._database.executescript(_TABLES)
        except (OSError, sqlite3.Error) as error:
            raise UserError(f"{path}: cannot be opened: {error}") from None

    def close(self) -> None:
        """Close the file."""
        self._database.close()

    def add_judge(self) -> str | None:
        """Return the token of a new judge, or None if there are too many."""
        token = secrets.token_urlsafe(16)
        added = self._database.execute(
            "INSERT INTO judges (number, token, beeps) "
            "SELECT n, ?, ? FROM (SELECT count(*) AS n FROM judges) WHERE n < ?",
            (token, _draw_beeps(), MAX_JUDGES),
        )
        return token if added.rowcount else None

    def find_judge(self, token: str) -> Judge | None:
        """Return the judge with a token, or None."""
        found = self._database.execute(
            "SELECT number, beeps, hears FROM judges WHERE token = ?", (token,)
        ).fetchone()
        return found and Judge(found[0], found[1], bool(found[2]))

    def check_sound(self, judge: Judge, beeps: int) -> None:
        """Note whether a judge has counted the beeps; if not, draw another number."""
        self._database.execute(
            "UPDATE judges SET hears = hears OR beeps = ?, beeps = ? WHERE number = ?",
            (beeps, _draw_beeps(), judge.number),
        )

    def add(self, judge: Judge, sentence: str, condition: str, scores: dict[str, int]) -> None:
        """Keep the scores of one video by scale, unless there are some already."""
        now_s = time.time()
        rows = [(judge.number, sentence, condition, name, scores[name], now_s) for name in SCALES]
        self._database.execute("BEGIN IMMEDIATE")
        with self._database:
            self._database.executemany(
                "INSERT INTO answers VALUES (?, ?, ?, ?, ?, ?) ON CONFLICT DO NOTHING", rows
            )

    def answered(self, judge: Judge) -> set[tuple[str, str]]:
        """Return the sentences and conditions that a judge has scored."""
        return set(
            self._database.execute(
                "SELECT sentence, condition FROM answers WHERE judge = ?", (judge.number,)
            )
        )

    def answers(self) -> list[Answer]:
        """Return all answers, judge by judge."""
        rows = self._database.execute(
            "SELECT judge, sentence, condition, scale, score, unix_s FROM answers "
            "ORDER BY judge, unix_s, sentence, condition, scale"
        )
        return [Answer(*row) for row in rows]


def read_answers(folder: Path) -> list[Answer]:
    """Return all answers of a study; raises as ``Store``."""
    store = Store(folder)
    try:
        return store.answers()
    finally:
        store.close()


def _draw_beeps() -> int:
    return 2 + secrets.randbelow(MAX_BEEPS - 1)
