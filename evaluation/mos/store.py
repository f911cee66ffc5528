"""Answers on disk: each is there once it is acknowledged, and only once.

SQLite with a write-ahead log that is flushed with every answer, so that neither a crash nor a power
cut loses one. The first answer counts: a second one, of a double click or a reload, is dropped.
Nobody but the file's owner reads it; SQLite gives its log the same rights.

A judge has a number, and by it a row of the design, once the sound check is passed. Who begins and
scores nothing is forgotten, so that neither numbers nor places for judges are used up.
"""

from __future__ import annotations

import contextlib
import secrets
import sqlite3
import time
from collections.abc import Iterable
from dataclasses import astuple, dataclass
from pathlib import Path

from kouxing.shared.errors import UserError

FILE_NAME = "answers.sqlite"
MAX_JUDGES = 10_000  # nobody fills the disk
FORGOTTEN_AFTER_S = 24 * 3600.0
MAX_BEEPS = 6
_TABLES = """
CREATE TABLE IF NOT EXISTS judges (
    token TEXT PRIMARY KEY,
    unix_s REAL NOT NULL,
    beeps INTEGER NOT NULL,
    number INTEGER UNIQUE,
    fetched INTEGER
);
CREATE INDEX IF NOT EXISTS judges_by_age ON judges (unix_s);
CREATE TABLE IF NOT EXISTS answers (
    judge INTEGER NOT NULL REFERENCES judges (number) ON DELETE CASCADE,
    place INTEGER NOT NULL,
    sentence TEXT NOT NULL,
    condition TEXT NOT NULL,
    scale TEXT NOT NULL,
    score INTEGER NOT NULL CHECK (score BETWEEN 1 AND 5),
    language TEXT NOT NULL,
    unix_s REAL NOT NULL,
    PRIMARY KEY (judge, place, scale)
) WITHOUT ROWID;
CREATE VIEW IF NOT EXISTS without_scores AS
    SELECT token, unix_s, number FROM judges
    WHERE NOT EXISTS (SELECT 1 FROM answers WHERE judge = number AND place >= 0);
"""


@dataclass(frozen=True, slots=True)
class Judge:
    """One who judges."""

    token: str
    beeps: int
    """How many beeps the sound check plays."""
    number: int | None
    """From 0; None until the beeps have been counted."""
    fetched: int | None
    """Last place whose video was sent; None: there is none."""


@dataclass(frozen=True, slots=True)
class Answer:
    """One score."""

    judge: int
    place: int
    """In the judge's order, from 0; below 0: practice, which does not count."""
    sentence: str
    condition: str
    scale: str
    score: int
    """From 1 (bad) to 5 (excellent)."""
    language: str
    """In which the page asked: ``zh`` or ``en``."""
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
            self._database.execute("PRAGMA foreign_keys = ON")
            self._database.executescript(_TABLES)
        except (OSError, sqlite3.Error) as error:
            raise UserError(f"{path}: cannot be opened: {error}") from None

    def close(self) -> None:
        """Close the file."""
        self._database.close()

    def add_judge(self) -> str | None:
        """Return the token of a new judge, or None if there are too many who have scored.

        Those without a score are forgotten after a day; where room is needed, one of them at once:
        who has not passed the sound check, then who began first.
        """
        token = secrets.token_urlsafe(16)
        now_s = time.time()
        self._database.execute("BEGIN IMMEDIATE")
        with self._database:
            self._database.execute(
                "DELETE FROM judges WHERE token IN "
                "(SELECT token FROM without_scores WHERE unix_s < ?)",
                (now_s - FORGOTTEN_AFTER_S,),
            )
            self._database.execute(
                "DELETE FROM judges WHERE (SELECT count(*) FROM judges) >= ? AND token = "
                "(SELECT token FROM without_scores ORDER BY number IS NOT NULL, unix_s LIMIT 1)",
                (MAX_JUDGES,),
            )
            added = self._database.execute(
                "INSERT INTO judges (token, unix_s, beeps) SELECT ?, ?, ? "
                "WHERE (SELECT count(*) FROM judges) < ?",
                (token, now_s, _draw_beeps(), MAX_JUDGES),
            )
        return token if added.rowcount else None

    def find_judge(self, token: str) -> Judge | None:
        """Return the judge with a token, or None."""
        found = self._database.execute(
            "SELECT token, beeps, number, fetched FROM judges WHERE token = ?", (token,)
        ).fetchone()
        return found and Judge(*found)

    def check_sound(self, judge: Judge, beeps: int) -> None:
        """Give a judge who has counted the beeps the first free number; else draw other beeps."""
        if beeps != judge.beeps:
            self._database.execute(
                "UPDATE judges SET beeps = ? WHERE token = ?", (_draw_beeps(), judge.token)
            )
            return
        self._database.execute(
            "UPDATE judges SET number = (SELECT min(n) FROM "
            "(SELECT 0 AS n UNION SELECT number + 1 FROM judges) "
            "WHERE NOT EXISTS (SELECT 1 FROM judges WHERE number = n)) "
            "WHERE token = ? AND number IS NULL",
            (judge.token,),
        )

    def note_fetched(self, judge: Judge, place: int) -> None:
        """Note that a judge was sent the video of a place."""
        if judge.fetched != place:
            self._database.execute(
                "UPDATE judges SET fetched = ? WHERE token = ?", (place, judge.token)
            )

    def add(self, answers: Iterable[Answer]) -> None:
        """Keep the scores of one video, unless there are some already."""
        rows = [astuple(answer) for answer in answers]
        self._database.execute("BEGIN IMMEDIATE")
        with self._database:
            self._database.executemany(
                "INSERT INTO answers VALUES (?, ?, ?, ?, ?, ?, ?, ?) ON CONFLICT DO NOTHING", rows
            )

    def last_place(self, judge: Judge) -> int | None:
        """Return the last place that a judge has scored; None: there is none."""
        found: tuple[int | None] = self._database.execute(
            "SELECT max(place) FROM answers WHERE judge = ?", (judge.number,)
        ).fetchone()
        return found[0]


def read_answers(folder: Path) -> list[Answer]:
    """Return all answers of a study, judge by judge in their order; nothing is written.

    Raises
    ------
    UserError
        If the file cannot be read.
    """
    path = folder / FILE_NAME
    if not path.exists():
        return []
    # Without a log nobody has the file open; then SQLite needs no files of its own beside it.
    mode = "mode=ro" if path.with_name(f"{FILE_NAME}-wal").exists() else "immutable=1"
    address = f"{path.resolve().as_uri()}?{mode}"
    try:
        with contextlib.closing(sqlite3.connect(address, uri=True)) as database:
            rows = database.execute(
                "SELECT judge, place, sentence, condition, scale, score, language, unix_s "
                "FROM answers ORDER BY judge, place, scale"
            )
            return [Answer(*row) for row in rows]
    except sqlite3.Error as error:
        raise UserError(f"{path}: cannot be read: {error}") from None


def _draw_beeps() -> int:
    return 2 + secrets.randbelow(MAX_BEEPS - 1)
