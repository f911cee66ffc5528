"""Count what follows what in texts, and keep what is worth knowing.

Sources: Witten and Bell 1991, "The zero-frequency problem", as interpolation (Chen and Goodman
1999, section 2.6); Seymore and Rosenfeld 1996, "Scalable backoff language models" (what to keep).

======== ===================================================== ============
symbol   meaning                                               shape
======== ===================================================== ============
g        n-gram: its units as digits to the base 60            (n-grams,)
c        how often it was seen                                 (n-grams,)
N, T     how often its context was, and before how many units  (n-grams,)
======== ===================================================== ============

    p(u | h) = (c + T p(u | h')) / (N + T)

An n-gram is worth ``c log(p(u | h) / (share of T p(u | h')))``: how much likelier it makes the
texts. The most worthy are kept, with all that they begin with.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.progress import track

from services.recognizer.model_file import (
    language_arrays,
    language_from,
    read_archive,
    write_archive,
)
from services.recognizer.unit_language import NUM_UNITS, UnitLanguage
from shared.errors import UserError
from shared.phones import SILENCE, UNIT_INDEX
from shared.pinyin import pinyin_of_text, units_of_pinyin
from training.corpus import RowErrors, is_synthetic, read_corpus
from training.examples import WORD_UNITS, Example

HANZI = re.compile(r"[\u3007\u4e00-\u9fff]+")
_SPOKEN_SHARE = 0.012  # of the sentences of the corpora, against other texts
_SIL = UNIT_INDEX[SILENCE]
_UNSEEN = 0.5  # added to the count of every single unit
_LEAST_LEFT = 1e-4

_Levels = dict[int, NDArray[np.int64]]
_Shares = dict[int, NDArray[np.float64]]


def stream_of(sentences: Sequence[Sequence[int]]) -> NDArray[np.int8]:
    """One stream of all sentences, with a pause before each."""
    return np.array([unit for units in sentences for unit in (_SIL, *units)], dtype=np.int8)


def estimate_language(
    streams: Sequence[NDArray[np.int8]], *, order: int = 6, most: int = 1_000_000
) -> UnitLanguage:
    """Estimate the language of units.

    Parameters
    ----------
    streams
        Texts as units, indices into ``shared.phones.UNITS``, with a pause (``sil``) between
        sentences or where a reader would make one. What stands in several streams counts as often.
    order
        Units in the longest n-grams, 2 to 10: so many fit into 64 bits.
    most
        N-grams to keep, about.
    """
    grams, counts = _counted(np.concatenate(streams), order)
    shares: _Shares = {1: _smoothed(grams[1], counts[1])}
    grams[1] = np.arange(NUM_UNITS)
    worth: dict[int, NDArray[np.float64]] = {}
    for n in range(2, order + 1):
        _, context = np.unique(grams[n] // NUM_UNITS, return_inverse=True)
        seen = np.bincount(context, weights=counts[n])
        different = np.bincount(context)
        shorter = shares[n - 1][np.searchsorted(grams[n - 1], grams[n] % NUM_UNITS ** (n - 1))]
        unseen = (different / (seen + different))[context] * shorter
        shares[n] = counts[n] / (seen + different)[context] + unseen
        worth[n] = counts[n] * np.log(shares[n] / unseen)
    all_worth = np.concatenate(list(worth.values()))
    least = np.partition(all_worth, -most)[-most] if len(all_worth) > most else 0.0
    needed = np.empty(0, np.int64)
    for n in range(order, 1, -1):
        kept = worth[n] >= least
        kept[np.searchsorted(grams[n], needed)] = True
        grams[n], shares[n] = grams[n][kept], shares[n][kept]
        needed = np.unique(grams[n] // NUM_UNITS)
    return _tree(grams, shares)


def language_of_corpora(examples: Sequence[Example]) -> UnitLanguage:
    """Estimate the language of the recordings' own texts."""
    return estimate_language([stream_of([example.units for example in examples])])


def train_language(
    corpora: Sequence[Path],
    texts: Sequence[Path],
    output: Path,
    *,
    drawn: NDArray[np.int8] | None = None,
    order: int = 6,
    most: int = 1_000_000,
    report: Callable[[str], None] = print,
) -> None:
    """Estimate a language and write it to a file.

    Parameters
    ----------
    corpora
        Folders of speech; the sentences of the split ``train`` that people have spoken count for
        one in a hundred units of the texts.
    texts
        Files of Chinese text, UTF-8.
    output
        The ``.npz`` file to write.
    drawn
        A stream of units, see :func:`training.open_gram.drawn_units`.
    order, most
        See :func:`estimate_language`.
    report
        Receives lines of progress.

    Raises
    ------
    UserError
        If a file cannot be read, or nothing is left.
    """
    errors = RowErrors()
    streams = [stream_of(_sentences(text)) for text in texts]
    if drawn is not None:
        streams.append(drawn)
    spoken = stream_of(
        sorted(
            {
                row.units
                for corpus in corpora
                for row in read_corpus(corpus, errors, split="train")
                if len(row.units) > WORD_UNITS and not is_synthetic(row.licence)
            }
        )
    )
    num_others = sum(map(len, streams))
    if len(spoken):
        streams += [spoken] * max(1, round(_SPOKEN_SHARE * num_others / len(spoken)))
    if not num_others + len(spoken):
        raise UserError("no text to count; give --text, --ngrams or a corpus with sentences")
    report(f"{num_others} units of text, {len(spoken)} of sentences of the corpora")
    language = estimate_language(streams, order=order, most=most)
    write_archive(output, language_arrays(language))
    levels = language.levels
    sizes = ", ".join(f"{end - first}" for first, end in pairwise(levels[1:]))
    errors.tell(report)
    report(f"n-grams of 1 to {len(levels) - 2} units kept: {sizes}")


def load_language(path: Path) -> UnitLanguage:
    """Read a language that :func:`train_language` has written, or that of a recognizer's model.

    Raises
    ------
    UserError
        If the file is missing or holds none.
    """
    try:
        return language_from(read_archive(path))
    except ValueError as error:
        raise UserError(
            f"no language in {path}: {error}; write one with: kouxing train language"
        ) from error


def _sentences(text: Path) -> list[tuple[int, ...]]:
    """Read what stands between other characters as sentences; leave out what has no reading."""
    try:
        lines = text.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"cannot read {text} as UTF-8: {error}") from error
    sentences = []
    for line in track(lines, description=text.name):
        for sentence in HANZI.findall(line):
            units = units_of_text(sentence)
            if units:
                sentences.append(units)
    return sentences


def units_of_text(hanzi: str) -> tuple[int, ...]:
    """Units of Chinese characters, indices; none if one of them has no reading."""
    try:
        units = units_of_pinyin(" ".join(pinyin_of_text(hanzi)))
    except UserError:  # a syllable like "ng"
        return ()
    return tuple(UNIT_INDEX[unit] for unit in units)


def _counted(stream: NDArray[np.int8], order: int) -> tuple[_Levels, dict[int, NDArray[np.int64]]]:
    """Count n-grams of 1 to ``order`` units; a pause may only be the first or the last unit."""
    units = stream.astype(np.int64)
    last = np.arange(1, len(units))  # where n-grams end; the first pause is not said
    pauses = np.maximum.accumulate(np.where(units == _SIL, np.arange(len(units)), 0))
    pause = pauses[last - 1]  # the one before
    code = units[last]
    grams, counts = {}, {}
    for n in range(1, order + 1):
        if n > 1:
            inside = last - (n - 1) >= pause
            last, pause, code = last[inside], pause[inside], code[inside]
            code = code + units[last - (n - 1)] * NUM_UNITS ** (n - 1)
        grams[n], counts[n] = np.unique(code, return_counts=True)
    return grams, counts


def _smoothed(units: NDArray[np.int64], counts: NDArray[np.int64]) -> NDArray[np.float64]:
    """Shares of single units; none is impossible."""
    smooth = np.full(NUM_UNITS, _UNSEEN)
    smooth[units] += counts
    shares: NDArray[np.float64] = smooth / smooth.sum()
    return shares


def _tree(grams: _Levels, shares: _Shares) -> UnitLanguage:
    """Lay the kept n-grams out as a tree, with the back-offs that make shares sum to one."""
    order = len(grams)
    back_offs: _Shares = {}
    for n in range(1, order):
        parent = np.searchsorted(grams[n], grams[n + 1] // NUM_UNITS)
        shorter = _share(grams[n + 1] % NUM_UNITS**n, n, grams, shares, back_offs)
        counted = np.bincount(parent, weights=shares[n + 1], minlength=len(grams[n]))
        replaced = np.bincount(parent, weights=shorter, minlength=len(grams[n]))
        back_offs[n] = np.maximum(1 - counted, _LEAST_LEFT) / np.maximum(1 - replaced, _LEAST_LEFT)
    back_offs[order] = np.ones(len(grams[order]))
    levels = [grams[n] for n in range(1, order + 1)]
    children = [
        np.bincount(np.searchsorted(above, below // NUM_UNITS), minlength=len(above))
        for above, below in pairwise(levels)
    ]
    num_children = np.concatenate([[NUM_UNITS], *children, np.zeros(len(levels[-1]), np.int64)])
    return UnitLanguage(
        num_children=num_children.astype(np.uint8),
        unit=np.concatenate([[0], *(level % NUM_UNITS for level in levels)]).astype(np.uint8),
        log_share=_logs(shares, order),
        log_back_off=_logs(back_offs, order),
    )


def _logs(shares: _Shares, order: int) -> NDArray[np.float32]:
    """Take logs of all levels, the root's first."""
    logs = np.log(np.concatenate([[1.0], *(shares[n] for n in range(1, order + 1))]))
    single: NDArray[np.float32] = logs.astype(np.float32)
    return single


def _share(
    wanted: NDArray[np.int64], n: int, grams: _Levels, shares: _Shares, back_offs: _Shares
) -> NDArray[np.float64]:
    """Shares of n-grams, by their context's back-off where they are not kept."""
    at = np.minimum(np.searchsorted(grams[n], wanted), len(grams[n]) - 1)
    found = shares[n][at]
    missing = np.flatnonzero(grams[n][at] != wanted)
    if len(missing):
        left = wanted[missing]
        context = left // NUM_UNITS
        at = np.minimum(np.searchsorted(grams[n - 1], context), len(grams[n - 1]) - 1)
        is_context = grams[n - 1][at] == context
        weight = np.where(is_context, back_offs[n - 1][at], 1.0)
        shorter = _share(left % NUM_UNITS ** (n - 1), n - 1, grams, shares, back_offs)
        found[missing] = weight * shorter
    return found
