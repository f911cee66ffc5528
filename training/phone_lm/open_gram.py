"""Draws sentences from a word language model, as phones for a phone language model.

The word model is Open-gram, a trigram of 72,000 Chinese words (CC BY-SA 3.0), as the SunPinyin
input method ships it (Debian package ``sunpinyin-data``). ``tslminfo -v lm_sc.t3g`` (Debian package
``sunpinyin-utils``) prints it as text. Its words are in ``pydict_sc.bin``.

Words are drawn by their probability after the two words before. The probability that the counted
words leave is distributed over the words counted after one word, and the rest over all words. Words
that the language does not write (punctuation, foreign words) become pauses.
"""

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.progress import track

from kouxing.shared.arrays import Doubles, Integers, Mask
from kouxing.shared.errors import UserError
from kouxing.shared.files.user_file import open_file, read_file
from kouxing.shared.phones.inventory import PhoneInventory
from kouxing.training.phone_lm.recipe import PhoneStream, phones_of_text
from kouxing.training.seed import SEED

NGRAMS, DICTIONARY = "ngrams.txt", "pydict_sc.bin"  # files of a word model
_MAX_BYTES = 4 << 30
_BASE = 100_000  # base of the n-grams' codes, greater than the number of words
_NUM_CHAINS = 100_000  # drawn in parallel
_CONTEXT_WORDS = 2
_NUM_LEVELS = 4  # n-grams of 0 to 3 words
_WORDS_OFFSET = slice(8, 12)  # bytes of a dictionary with the offset of its words
_MAX_TRIES = 8  # to draw a word that is not counted after its context


@dataclass(frozen=True, slots=True)
class _Level:
    """N-grams of one length, ascending; a code's digits to the base ``_BASE`` are the words."""

    code: Integers  # (n-grams,)
    cumulative: Doubles  # (n-grams + 1,) sum of the probabilities before each n-gram

    def draw(self, context: Integers, rng: np.random.Generator) -> tuple[Integers, Mask]:
        """Draw a word after each context; return the words and which of them are counted there."""
        first, end = (np.searchsorted(self.code, (context + n) * _BASE) for n in (0, 1))
        start = self.cumulative[first]
        height = rng.random(len(context))
        index = np.searchsorted(self.cumulative, start + height, side="right") - 1
        counted = (height < self.cumulative[end] - start) & (first < end)
        return self.code[np.minimum(index, len(self.code) - 1)] % _BASE, counted

    def has(self, code: Integers) -> Mask:
        """Return which n-grams are counted."""
        index = np.minimum(np.searchsorted(self.code, code), len(self.code) - 1)
        return np.asarray(self.code[index] == code)


def draw_phones(
    folder: Path, inventory: PhoneInventory, *, num_words: int = 30_000_000
) -> PhoneStream:
    """Draw about ``num_words`` words; return their phones, with pauses between sentences.

    ``folder`` has ``ngrams.txt``, the output of ``tslminfo -v``, and ``pydict_sc.bin``. Raises
    UserError if a file is missing or invalid.
    """
    ngrams, dictionary = folder / NGRAMS, folder / DICTIONARY
    words = _read_words(dictionary)
    levels = _read_levels(ngrams)
    if max(int((level.code % _BASE).max()) for level in levels) >= len(words):
        raise UserError(
            f"{ngrams} has words that {dictionary} lacks; use files of the same version"
        )
    rng = np.random.default_rng(SEED)
    num_chains = min(_NUM_CHAINS, num_words)
    num_drawn = max(1, num_words // num_chains)
    drawn = np.zeros((num_chains, _CONTEXT_WORDS + num_drawn), np.int64)
    for step in track(range(_CONTEXT_WORDS, drawn.shape[1]), description="words"):
        context = drawn[:, step - _CONTEXT_WORDS : step]
        drawn[:, step] = _next_words(levels, context, rng)
    # word 0, before each chain, is a pause
    return _phones_of_words(drawn.ravel(), words, inventory)


def _phones_of_words(
    drawn: Integers, words: Sequence[str], inventory: PhoneInventory
) -> PhoneStream:
    silence = inventory.index[inventory.silence]
    phones = [
        (inventory.readable.fullmatch(word) and phones_of_text(word, inventory)) or (silence,)
        for word in words
    ]
    lengths = np.array([len(word_phones) for word_phones in phones])
    starts = np.cumsum(lengths) - lengths
    ends = np.cumsum(lengths[drawn])
    shift = np.repeat(ends - lengths[drawn] - starts[drawn], lengths[drawn])
    all_phones = np.concatenate([np.array(word_phones, np.uint8) for word_phones in phones])
    stream = all_phones[np.arange(ends[-1]) - shift]
    repeated = (stream[1:] == silence) & (stream[:-1] == silence)
    return np.asarray(stream[np.concatenate([[True], ~repeated])])


def _next_words(levels: Sequence[_Level], context: Integers, rng: np.random.Generator) -> Integers:
    """Draw a word after each row of words, shape (rows, words before)."""
    num_before = context.shape[1]
    code = context @ _BASE ** np.arange(num_before - 1, -1, -1)
    level = levels[num_before]
    word, counted = level.draw(code, rng)
    left = np.flatnonzero(~counted)
    for _ in range(_MAX_TRIES):
        if not (num_before and len(left)):
            break
        word[left] = _next_words(levels, context[left, 1:], rng)
        left = left[level.has(code[left] * _BASE + word[left])]
    return word


def _read_levels(path: Path) -> list[_Level]:
    rows: list[list[tuple[int, float]]] = []
    try:
        with open_file(path, _MAX_BYTES) as lines:
            for line in track(lines, description="n-grams"):
                if line.startswith(b"\\"):
                    rows.append([])
                    continue
                columns = line.split()
                code = 0
                for word in columns[: len(rows) - 1]:
                    code = code * _BASE + int(word)
                rows[-1].append((code, float(columns[len(rows) - 1])))
    except (OSError, ValueError, IndexError) as error:
        raise UserError(f"{path} is not output of `tslminfo -v`: {error}") from error
    if len(rows) != _NUM_LEVELS or not all(rows):
        raise UserError(f"{path} has {len(rows)} levels of n-grams instead of {_NUM_LEVELS}")
    levels = []
    for level in rows[1:]:
        codes, costs = zip(*level, strict=True)
        cumulative = np.concatenate([[0.0], np.cumsum(np.exp(-np.array(costs)))])
        levels.append(_Level(np.array(codes, np.int64), cumulative))
    return levels


def _read_words(path: Path) -> list[str]:
    try:
        content = read_file(path, _MAX_BYTES)
        (start,) = struct.unpack("<I", content[_WORDS_OFFSET])
        return content[start:].decode("utf-32-le").split("\0")
    except (OSError, struct.error, UnicodeDecodeError) as error:
        raise UserError(f"{path} is not a SunPinyin dictionary: {error}") from error
