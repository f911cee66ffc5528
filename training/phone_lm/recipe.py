"""Estimates a phone language model: counts n-grams, smooths them, and keeps the most informative.

Sources: Witten and Bell 1991, "The zero-frequency problem", as interpolation (Chen and Goodman
1999, section 2.6); Seymore and Rosenfeld 1996, "Scalable backoff language models" (pruning).

======== ======================================================== ============
symbol   meaning                                                  shape
======== ======================================================== ============
g        n-gram: its phones as digits to the base num_phones      (n-grams,)
c        count of the n-gram                                      (n-grams,)
N, T     count of its context, and number of phones seen after it (n-grams,)
======== ======================================================== ============

    p(u | h) = (c + T p(u | h')) / (N + T)

The gain of an n-gram, ``c log(p(u | h) / (T p(u | h') / (N + T)))``, is how much it raises the log
likelihood of the texts. The n-grams with the highest gains and their prefixes are kept.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.progress import track

from kouxing.corpora.speech_corpus import RowErrors, read_corpus
from kouxing.services.recognizer.acoustic.model_file import (
    parse_phone_lm,
    phone_lm_arrays,
    read_archive,
)
from kouxing.services.recognizer.search.phone_lm import PhoneLanguageModel
from kouxing.shared.arrays import Doubles, Floats, Integers, UInt8
from kouxing.shared.command.terminal import print_message
from kouxing.shared.errors import UserError
from kouxing.shared.files.user_file import read_text
from kouxing.shared.phones.inventory import PhoneInventory
from kouxing.training.model_files import write_archive
from kouxing.training.training_set import Example

PhoneStream = UInt8  # phones of a text, with a pause before each sentence

_MAX_TEXT_BYTES = 1 << 30
_UNSEEN_COUNT = 0.5  # added to the count of each single phone
_MIN_REMAINDER = 1e-4
_MAX_CODE = np.iinfo(np.int64).max

_NgramCodes = dict[int, Integers]  # by n, ascending
_Probs = dict[int, Doubles]  # by n


def join_sentences(sentences: Sequence[Sequence[int]], inventory: PhoneInventory) -> PhoneStream:
    """Join sentences, given as indices of phones, with a pause before each."""
    silence = inventory.index[inventory.silence]
    phones = [phone for sentence in sentences for phone in (silence, *sentence)]
    return np.array(phones, dtype=np.uint8)


def estimate_phone_lm(
    streams: Sequence[PhoneStream],
    inventory: PhoneInventory,
    *,
    order: int = 6,
    max_ngrams: int = 1_000_000,
) -> PhoneLanguageModel:
    """Estimate a phone language model of about ``max_ngrams`` n-grams.

    ``streams`` are texts as indices of phones, with a pause between sentences or where a reader
    would pause. A text counts once for each stream that contains it. ``order`` is the number of
    phones in the longest n-grams, 2 or more. UserError if it is too high for 64-bit codes.
    """
    num_phones = len(inventory)
    if num_phones**order > _MAX_CODE:
        raise UserError(f"order {order} is too high for {num_phones} phones; use a lower one")
    silence = inventory.index[inventory.silence]
    grams, counts = _count_ngrams(np.concatenate(streams), order, silence, num_phones)
    unigram_counts = np.full(num_phones, _UNSEEN_COUNT)
    unigram_counts[grams[1]] += counts[1]
    probs: _Probs = {1: unigram_counts / unigram_counts.sum()}
    grams[1] = np.arange(num_phones)
    gains: dict[int, Doubles] = {}
    for n in range(2, order + 1):
        _, context = np.unique(grams[n] // num_phones, return_inverse=True)
        total = np.bincount(context, weights=counts[n])  # N
        distinct = np.bincount(context)  # T
        shorter = np.searchsorted(grams[n - 1], grams[n] % num_phones ** (n - 1))
        backoff = (distinct / (total + distinct))[context] * probs[n - 1][shorter]
        probs[n] = counts[n] / (total + distinct)[context] + backoff
        gains[n] = counts[n] * np.log(probs[n] / backoff)
    _prune(grams, probs, gains, max_ngrams, num_phones)
    return _NgramTree(grams, probs, inventory).phone_lm()


def _count_ngrams(
    stream: PhoneStream, order: int, silence: int, num_phones: int
) -> tuple[_NgramCodes, dict[int, Integers]]:
    """Count n-grams of 1 to ``order`` phones; a pause may only be the first or the last phone."""
    phones = stream.astype(np.int64)
    last = np.arange(1, len(phones))  # where n-grams end; the first pause is only context
    pauses = np.maximum.accumulate(np.where(phones == silence, np.arange(len(phones)), 0))
    pause = pauses[last - 1]  # the pause before
    code = phones[last]
    grams, counts = {}, {}
    for n in range(1, order + 1):
        if n > 1:
            inside = last - (n - 1) >= pause
            last, pause, code = last[inside], pause[inside], code[inside]
            code = code + phones[last - (n - 1)] * num_phones ** (n - 1)
        grams[n], counts[n] = np.unique(code, return_counts=True)
    return grams, counts


def _prune(
    grams: _NgramCodes, probs: _Probs, gains: dict[int, Doubles], max_ngrams: int, num_phones: int
) -> None:
    """Keep the n-grams with the highest gains, and their prefixes, in place."""
    all_gains = np.concatenate(list(gains.values()))
    threshold = 0.0
    if len(all_gains) > max_ngrams:
        threshold = np.partition(all_gains, -max_ngrams)[-max_ngrams]
    prefixes = np.empty(0, np.int64)
    for n in range(max(gains), 1, -1):
        is_kept = gains[n] >= threshold
        is_kept[np.searchsorted(grams[n], prefixes)] = True
        grams[n], probs[n] = grams[n][is_kept], probs[n][is_kept]
        prefixes = np.unique(grams[n] // num_phones)


@dataclass(frozen=True, slots=True)
class _NgramTree:
    """Arranges n-grams as a tree with back-off weights."""

    grams: _NgramCodes
    probs: _Probs
    inventory: PhoneInventory

    def phone_lm(self) -> PhoneLanguageModel:
        """Compute back-off weights such that the probabilities after each context sum to 1."""
        order, num_phones = len(self.grams), len(self.inventory)
        backoffs: _Probs = {}
        for n in range(1, order):
            parent = np.searchsorted(self.grams[n], self.grams[n + 1] // num_phones)
            shorter = self._smoothed_prob(self.grams[n + 1] % num_phones**n, n, backoffs)
            num_parents = len(self.grams[n])
            counted = np.bincount(parent, weights=self.probs[n + 1], minlength=num_parents)
            replaced = np.bincount(parent, weights=shorter, minlength=num_parents)
            backoffs[n] = _remainder(counted) / _remainder(replaced)
        backoffs[order] = np.ones(len(self.grams[order]))
        levels = [self.grams[n] for n in range(1, order + 1)]
        children = [
            np.bincount(np.searchsorted(above, below // num_phones), minlength=len(above))
            for above, below in pairwise(levels)
        ]
        leaves = np.zeros(len(levels[-1]), np.int64)
        num_children = np.concatenate([[num_phones], *children, leaves])
        phone = np.concatenate([[0], *(level % num_phones for level in levels)])
        return PhoneLanguageModel(
            inventory=self.inventory,
            num_children=num_children.astype(np.uint8),
            phone=phone.astype(np.uint8),
            log_prob=_log_probs(self.probs),
            log_backoff=_log_probs(backoffs),
        )

    def _smoothed_prob(self, wanted: Integers, n: int, backoffs: _Probs) -> Doubles:
        num_phones = len(self.inventory)
        index = np.minimum(np.searchsorted(self.grams[n], wanted), len(self.grams[n]) - 1)
        probs = self.probs[n][index]
        missing = np.flatnonzero(self.grams[n][index] != wanted)
        if len(missing):
            pruned = wanted[missing]
            context, contexts = pruned // num_phones, self.grams[n - 1]
            index = np.minimum(np.searchsorted(contexts, context), len(contexts) - 1)
            weight = np.where(contexts[index] == context, backoffs[n - 1][index], 1.0)
            shorter = self._smoothed_prob(pruned % num_phones ** (n - 1), n - 1, backoffs)
            probs[missing] = weight * shorter
        return probs


def _remainder(total: NDArray[Any]) -> Doubles:
    """Return what a sum of probabilities leaves of 1, at least a little."""
    return np.asarray(np.maximum(1 - total, _MIN_REMAINDER))


def _log_probs(values: _Probs) -> Floats:
    """Return the logarithms of all levels in order, the root's (0) first."""
    logs = np.log(np.concatenate([[1.0], *(values[n] for n in range(1, len(values) + 1))]))
    return np.asarray(logs.astype(np.float32))


_CORPUS_WEIGHT = 0.012  # corpus phones per phone of other texts


def train_phone_lm(
    corpora: Sequence[Path],
    texts: Sequence[Path],
    output: Path,
    inventory: PhoneInventory,
    *,
    drawn: PhoneStream | None = None,
) -> None:
    """Estimate a phone language model, and write it to a file.

    Texts are counted, and with about a hundredth of their weight the natural sentences of the
    corpora's split ``train``. ``drawn`` are phones from ``open_gram.draw_phones``. Raises
    ``UserError`` if a file cannot be read, or there is nothing to count.
    """
    errors = RowErrors()
    streams = [join_sentences(_read_sentences(text, inventory), inventory) for text in texts]
    if drawn is not None:
        streams.append(drawn)
    sentences = {
        row.phones
        for corpus in corpora
        for row in read_corpus(corpus, errors, inventory, split="train")
        if row.speech_kind == "sentence"
    }
    corpus_stream = join_sentences(sorted(sentences), inventory)
    num_text = sum(map(len, streams))
    if len(corpus_stream):
        streams += [corpus_stream] * max(1, round(_CORPUS_WEIGHT * num_text / len(corpus_stream)))
    if not num_text + len(corpus_stream):
        raise UserError("no text to count; add --text, --word-model or a corpus with sentences")
    print_message(f"{num_text} phones of text, {len(corpus_stream)} of sentences of the corpora")
    phone_lm = estimate_phone_lm(streams, inventory)
    write_archive(output, phone_lm_arrays(phone_lm))
    levels = phone_lm.levels
    sizes = ", ".join(f"{end - first}" for first, end in pairwise(levels[1:]))
    errors.report_to(print_message)
    print_message(f"n-grams of 1 to {len(levels) - 2} phones kept: {sizes}")


def phone_lm_of(examples: Sequence[Example], inventory: PhoneInventory) -> PhoneLanguageModel:
    """Estimate a phone language model from the recordings' own texts."""
    stream = join_sentences([example.phones for example in examples], inventory)
    return estimate_phone_lm([stream], inventory)


def load_phone_lm(path: Path, inventory: PhoneInventory) -> PhoneLanguageModel:
    """Read a file of :func:`train_phone_lm`, or the phone language model of a recognizer's model.

    Raises ``UserError`` if the file contains no phone language model, or one for another language.
    """
    try:
        phone_lm = parse_phone_lm(read_archive(path))
    except ValueError as error:
        raise UserError(
            f"{path} has no phone language model: {error}; make one with: kouxing train phone-lm"
        ) from error
    if phone_lm.inventory.language != inventory.language:
        raise UserError(
            f"{path} is for {phone_lm.inventory.language}, not for {inventory.language}; use a "
            "phone language model for this language"
        )
    return phone_lm


def _read_sentences(text: Path, inventory: PhoneInventory) -> list[tuple[int, ...]]:
    lines = read_text(text, _MAX_TEXT_BYTES).splitlines()
    sentences = []
    for line in track(lines, description=text.name):
        for sentence in inventory.readable.findall(line):
            phones = phones_of_text(sentence, inventory)
            if phones:
                sentences.append(phones)
    return sentences


def phones_of_text(text: str, inventory: PhoneInventory) -> tuple[int, ...]:
    """Return the indices of a text's phones; empty if a part of it cannot be pronounced."""
    try:
        syllables = inventory.pronounce(text)
    except UserError:
        return ()
    return tuple(inventory.index[phone] for syllable in syllables for phone in syllable)
