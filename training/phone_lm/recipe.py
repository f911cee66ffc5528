"""From texts and corpora to a file with a phone language model."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

from rich.progress import track

from kouxing.corpora.speech_corpus import RowErrors, is_synthetic, read_corpus
from kouxing.services.recognizer.acoustic.model_file import (
    phone_lm_arrays,
    phone_lm_from,
    read_archive,
    write_archive,
)
from kouxing.services.recognizer.search.phone_lm import PhoneLanguageModel
from kouxing.shared.errors import UserError
from kouxing.shared.phones.inventory import PhoneInventory
from kouxing.training.phone_lm.estimation import Stream, estimate_phone_lm, stream_of
from kouxing.training.training_set import MAX_WORD_PHONES, Example, Report

_CORPUS_WEIGHT = 0.012  # corpus phones per phone of other texts


def train_phone_lm(
    corpora: Sequence[Path],
    texts: Sequence[Path],
    output: Path,
    inventory: PhoneInventory,
    *,
    drawn: Stream | None = None,
    order: int = 6,
    max_ngrams: int = 1_000_000,
    report: Report = print,
) -> None:
    """Estimate a phone language model, and write it to a file.

    Texts are counted, and with about a hundredth of their weight the natural sentences of the
    corpora's split ``train``. ``drawn`` are phones from ``open_gram.draw_phones``. Raises UserError
    if a file cannot be read, or there is nothing to count.
    """
    errors = RowErrors()
    streams = [stream_of(_sentences(text, inventory), inventory) for text in texts]
    if drawn is not None:
        streams.append(drawn)
    sentences = {
        row.phones
        for corpus in corpora
        for row in read_corpus(corpus, errors, inventory, split="train")
        if len(row.phones) > MAX_WORD_PHONES and not is_synthetic(row.license)
    }
    corpus_stream = stream_of(sorted(sentences), inventory)
    num_text = sum(map(len, streams))
    if len(corpus_stream):
        streams += [corpus_stream] * max(1, round(_CORPUS_WEIGHT * num_text / len(corpus_stream)))
    if not num_text + len(corpus_stream):
        raise UserError(
            "there is no text to count; give --text, --ngrams or a corpus with sentences"
        )
    report(f"{num_text} phones of text, {len(corpus_stream)} of sentences of the corpora")
    phone_lm = estimate_phone_lm(streams, inventory, order=order, max_ngrams=max_ngrams)
    write_archive(output, phone_lm_arrays(phone_lm))
    levels = phone_lm.levels
    sizes = ", ".join(f"{end - first}" for first, end in pairwise(levels[1:]))
    errors.print_to(report)
    report(f"n-grams of 1 to {len(levels) - 2} phones kept: {sizes}")


def phone_lm_of(examples: Sequence[Example], inventory: PhoneInventory) -> PhoneLanguageModel:
    """Estimate a phone language model from the recordings' own texts."""
    stream = stream_of([example.phones for example in examples], inventory)
    return estimate_phone_lm([stream], inventory)


def load_phone_lm(path: Path, inventory: PhoneInventory) -> PhoneLanguageModel:
    """Read a file of :func:`train_phone_lm`, or the phone language model of a recognizer's model.

    Raises UserError if the file contains no phone language model, or one for another language.
    """
    try:
        phone_lm = phone_lm_from(read_archive(path))
    except ValueError as error:
        raise UserError(
            f"{path} has no phone language model: {error}; make one with: kouxing train phone-lm"
        ) from error
    if phone_lm.inventory.language != inventory.language:
        raise UserError(
            f"{path} is for {phone_lm.inventory.language}, not for {inventory.language}; give a "
            "phone language model for this language"
        )
    return phone_lm


def _sentences(text: Path, inventory: PhoneInventory) -> list[tuple[int, ...]]:
    try:
        lines = text.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"cannot read {text} as UTF-8: {error}") from error
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
