"""Sentences drawn from a word language model, as units: what a language of units is counted from.

The model is Open-gram, a trigram of 72,000 Chinese words (CC BY-SA 3.0), as the SunPinyin input
method comes with it (Debian package ``sunpinyin-data``). Its text form is what ``tslminfo -v
lm_sc.t3g`` prints (Debian package ``sunpinyin-utils``); its words are those of ``pydict_sc.bin``.

A word comes after the two before it with its share among those counted there; the rest of the
probability goes to the words counted after the one before it, and what is left of that to all
words. Words that are no Chinese characters (punctuation, too) are pauses.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.progress import track

from shared.errors import UserError
from shared.phones import SILENCE, UNIT_INDEX
from training.unit_language import HANZI, units_of_text

_SIL = UNIT_INDEX[SILENCE]
_BASE = 100_000  # more than there are words
_CHAINS = 100_000  # drawn side by side
_WORDS_BEFORE = 2
_NUM_LEVELS = 4  # of no word, one, two and three
_WORDS_AT = slice(8, 12)  # where a dictionary says where its words begin
_MOST_TRIES = 8  # to draw a word that is not among those counted


@dataclass(frozen=True, slots=True)
class _Level:
    """N-grams in ascending order, their number's last digit to the base ``_BASE`` the last word."""

    key: NDArray[np.int64]
    sum: NDArray[np.float64]  # of the shares of all n-grams before, and of all

    def draw(
        self, context: NDArray[np.int64], rng: np.random.Generator
    ) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        """Draw a word after each context; say which draws fell on a counted one."""
        first, end = (np.searchsorted(self.key, (context + n) * _BASE) for n in (0, 1))
        height = rng.random(len(context))
        at = np.searchsorted(self.sum, self.sum[first] + height, side="right") - 1
        counted = (height < self.sum[end] - self.sum[first]) & (first < end)
        return self.key[np.minimum(at, len(self.key) - 1)] % _BASE, counted

    def holds(self, key: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Say which n-grams are counted."""
        at = np.minimum(np.searchsorted(self.key, key), len(self.key) - 1)
        held: NDArray[np.bool_] = self.key[at] == key
        return held


def drawn_units(
    ngrams: Path, dictionary: Path, *, num_words: int, seed: int = 0
) -> NDArray[np.int8]:
    """Draw so many words; return their units in a stream with pauses between sentences.

    Parameters
    ----------
    ngrams
        What ``tslminfo -v`` has printed.
    dictionary
        The file ``pydict_sc.bin``.
    num_words
        Words to draw, about.
    seed
        The same seed draws the same words.

    Raises
    ------
    UserError
        If a file is missing or not of this kind.
    """
    words = _words(dictionary)
    levels = _levels(ngrams)
    if max(int((level.key % _BASE).max()) for level in levels) >= len(words):
        raise UserError(f"{ngrams} has words that {dictionary} has not; give files of one version")
    units = [_units_of(word) for word in words]
    lengths = np.array([len(one) for one in units])
    starts = np.cumsum(lengths) - lengths
    all_units = np.concatenate(units)
    rng = np.random.default_rng(seed)
    chains = min(_CHAINS, num_words)
    drawn = np.zeros((chains, _WORDS_BEFORE + max(1, num_words // chains)), np.int64)
    for place in track(range(_WORDS_BEFORE, drawn.shape[1]), description="words"):
        before = drawn[:, place - _WORDS_BEFORE : place]
        drawn[:, place] = _next_word(levels, before, rng)
    said = drawn.ravel()  # word 0 is a pause
    ends = np.cumsum(lengths[said])
    at = np.arange(ends[-1]) - np.repeat(ends - lengths[said] - starts[said], lengths[said])
    stream = all_units[at]
    again = (stream[1:] == _SIL) & (stream[:-1] == _SIL)
    single: NDArray[np.int8] = stream[np.concatenate([[True], ~again])]
    return single


def _next_word(
    levels: Sequence[_Level], said: NDArray[np.int64], rng: np.random.Generator
) -> NDArray[np.int64]:
    """Draw a word after each row of words."""
    num_before = said.shape[1]
    context = said @ _BASE ** np.arange(num_before - 1, -1, -1)
    level = levels[num_before]
    word, counted = level.draw(context, rng)
    left = np.flatnonzero(~counted)
    for _ in range(_MOST_TRIES):
        if not (num_before and len(left)):
            break
        word[left] = _next_word(levels, said[left, 1:], rng)
        left = left[level.holds(context[left] * _BASE + word[left])]
    return word


def _levels(path: Path) -> list[_Level]:
    """Read words, pairs and triples with their negative log shares."""
    rows: list[list[tuple[int, float]]] = []
    try:
        with path.open(encoding="ascii") as lines:
            for line in track(lines, description="n-grams"):
                if line.startswith("\\"):
                    rows.append([])
                    continue
                columns = line.split()
                key = 0
                for word in columns[: len(rows) - 1]:
                    key = key * _BASE + int(word)
                rows[-1].append((key, float(columns[len(rows) - 1])))
    except (OSError, ValueError, IndexError) as error:
        raise UserError(f"{path} is not what `tslminfo -v` prints: {error}") from error
    if len(rows) != _NUM_LEVELS or not all(rows):
        raise UserError(f"{path} has {len(rows)} levels of n-grams, expected {_NUM_LEVELS}")
    levels = []
    for level in rows[1:]:
        keys, log_shares = zip(*level, strict=True)
        sums = np.concatenate([[0.0], np.cumsum(np.exp(-np.array(log_shares)))])
        levels.append(_Level(np.array(keys, np.int64), sums))
    return levels


def _words(path: Path) -> list[str]:
    """Read the words in the order of their numbers."""
    try:
        content = path.read_bytes()
        (start,) = struct.unpack("<I", content[_WORDS_AT])
        return content[start:].decode("utf-32-le").split("\0")
    except (OSError, struct.error, UnicodeDecodeError) as error:
        raise UserError(f"{path} is no dictionary of SunPinyin: {error}") from error


def _units_of(word: str) -> NDArray[np.int8]:
    """Read a word; what cannot be read is a pause."""
    units = units_of_text(word) if HANZI.fullmatch(word) else ()
    return np.array(units or (_SIL,), np.int8)
