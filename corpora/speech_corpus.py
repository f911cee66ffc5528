"""Speech corpora: recordings with phones, in three layouts.

The files in the folder determine the layout:

- ``manifest.tsv``: columns ``utt_id path speaker source license split kind seconds text pinyin``.
  Only one of ``text`` and ``pinyin`` is required; ``pinyin`` takes precedence. If the ``kind`` is
  ``synthetic``, or the license contains this word, the speech is synthetic.
- A Kaldi data folder (``wav.scp``, ``text``, ``utt2spk``). If its name is ``dev`` or ``test``, it
  is that split.
- AISHELL-1 (``transcript/aishell_transcript_v0.8.txt`` and ``wav/<split>/<speaker>/*.wav``).

The inventory of the corpus's language converts text to phones. For universal phones, each row has
its own language (:mod:`kouxing.corpora.universal_phones`). Bad rows are reported, counted and
skipped, because large corpora always contain some.

Natural recordings are held out from all training, to measure recognizers on them.
``conversation.tsv`` lists the natural recordings that have a text: podcasts, a talk, a web seminar
and a prompt, with eight voices. The publishers of ``MOSS-TTSD`` and ``Step-Audio-EditX`` provide
their texts. Other texts contain errors, because they are the output of one large recognizer
(``RapidASR``) or a majority vote of several (``vad_example``). Long recordings and their texts are
cut into segments that overlap by 0.48 s.

``languages.tsv`` lists recordings in several languages, by speakers that no model was trained on,
and their phones. No setting of the universal model was chosen on these recordings, except for those
of two native speakers of English (``en-native``) and of one of Korean.
"""

import math
import re
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

from kouxing.corpora.tables import read_rows
from kouxing.corpora.universal_phones import has_labels, universal_words
from kouxing.shared.audio.audio_file import read_duration_s
from kouxing.shared.command.terminal import plural
from kouxing.shared.errors import UserError
from kouxing.shared.files.user_file import check_content, read_text, split_lines
from kouxing.shared.phones.inventory import UNIVERSAL, PhoneInventory, Syllable

LANGUAGES = Path(__file__).with_name("languages.tsv")  # held-out recordings in several languages

# Licenses that allow distributing a model trained on the data.
_FREE_LICENSE = re.compile(
    r"apache|\bmit\b|cc0|cc[ -]by(?!-nc|-nd)(?!-sa-nc)|unlicense|public domain|synthetic", re.I
)
# A restriction, or footage from films, excludes a license that matches the pattern above.
_CLOSED_LICENSE = re.compile(
    r"\bnc\b|\bnd\b|non-?commercial|no-?deriv|exceptions|film clip|youtube"
    r"|\bnot\b|-style|research only|academic",
    re.I,
)
_THIRD_PARTY = re.compile(r"\b(third|3rd)[ -]part", re.I)
_MIN_PHONE_S = 0.03
_MAX_WORD_PHONES = 8  # a recording with more phones is connected speech
_MAX_LIST_BYTES = 256 << 20
_AUDIO_SUFFIXES = {".wav", ".flac", ".ogg", ".opus"}
_KALDI_SPLITS = ("train", "dev", "test")
# Prefixes of the names of held-out files. They cover whole recordings, and all recordings of a
# speaker.
_HELD_OUT_PREFIXES = (
    "MOSS-TTSD_",
    "MOSS-TTS_reference_zh_3",
    "MiMo-Audio_aa7ed1",
    "RapidASR_",
    "Step-Audio-EditX_",
    "alibabacloud-bailian-speech-demo_",
    "paraformer-python_P9",
    "paraformer-python_vad",
    "websdk-java-demo_16K",
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Utterance:
    """One recording with its phones."""

    utterance_id: str
    path: Path
    speaker: str = ""
    license: str = ""
    is_synthetic: bool = False  # speech of a synthesizer
    language: str = ""  # ISO 639 code, if the corpus has several languages
    split: str = ""
    seconds: float = 0.0
    phones: tuple[int, ...] = ()  # indices into the inventory's phones
    syllables: tuple[int, ...] = ()  # number of phones in each syllable
    labels: Path | None = None  # table of hand-labeled universal phones with times

    @property
    def minutes(self) -> float:
        """Duration of the recording."""
        return self.seconds / 60

    @property
    def speech_kind(self) -> str:
        """The kind of speech: ``synthetic``, ``word`` (few phones) or ``sentence``."""
        if self.is_synthetic:
            return "synthetic"
        return "word" if len(self.phones) <= _MAX_WORD_PHONES else "sentence"


def syllables_of(utterance: Utterance, inventory: PhoneInventory) -> list[Syllable]:
    """Return the syllables of a recording's text, each with its phones."""
    symbols = iter([inventory.phones[index] for index in utterance.phones])
    return [tuple(next(symbols) for _ in range(length)) for length in utterance.syllables]


@dataclass(slots=True)
class RowErrors:
    """Rows that were skipped, and why."""

    messages: list[str] = field(default_factory=list)
    splits: Counter[str] = field(default_factory=Counter)  # number of all rows

    def add(self, row_name: str, problem: str) -> None:
        """Add a bad row."""
        self.messages.append(f"{row_name}: {problem}; row skipped")

    def report_to(self, report: Callable[[str], None]) -> None:
        """Report each skipped row, then their number."""
        for message in self.messages:
            report(message)
        if self.messages:
            report(f"{plural(len(self.messages), 'row')} skipped")

    def no_recording_error(self, where: str) -> UserError:
        """Make the error that no recording can be used, with the last reason and all splits."""
        last = f" (the last of them: {self.messages[-1]})" if self.messages else ""
        counts = ", ".join(f"{split} ({count})" for split, count in self.splits.items())
        splits = f"; rows by split: {counts}" if counts else ""
        return UserError(f"no usable recordings {where}{last}{splits}")


def may_distribute(license_name: str) -> bool:
    """Return whether a model trained on data under this license may be distributed."""
    return bool(_FREE_LICENSE.search(license_name)) and not _CLOSED_LICENSE.search(license_name)


def may_share(license_name: str) -> bool:
    """Return whether the data itself may be shared.

    A model may be trained on footage by third parties, but the footage may not be shared.
    """
    return may_distribute(license_name) and not _THIRD_PARTY.search(license_name)


def read_corpus(
    folder: Path,
    errors: RowErrors,
    inventory: PhoneInventory,
    *,
    split: str | None = None,
    audio: Path | None = None,
    any_license: bool = True,
) -> list[Utterance]:
    """Read a corpus folder, or a manifest, in any of the three layouts.

    ``errors`` receives a message for every row that cannot be used. Without ``split`` all splits
    are read. ``audio`` is the base folder of a manifest's paths, by default the manifest's folder.
    Without ``any_license``, rows whose license does not allow distributing a model are skipped.
    Raises ``UserError`` if the layout is unknown, or a list is missing or not UTF-8 text.
    """
    if folder.suffix == ".tsv" and not folder.is_dir():
        rows = _manifest_rows(folder, audio)
    elif (folder / "manifest.tsv").is_file():
        rows = _manifest_rows(folder / "manifest.tsv", audio)
    elif (folder / "wav.scp").is_file():
        rows = _kaldi_rows(folder)
    elif (folder / "transcript").is_dir() and (folder / "wav").is_dir():
        rows = _aishell_rows(folder)
    else:
        raise UserError(
            f"{folder} is not a corpus; use a folder with manifest.tsv, with Kaldi's wav.scp and "
            "text, or with AISHELL's wav and transcript folders"
        )
    with check_content(folder, "a corpus"):
        chosen = []
        for row_name, row in rows:
            errors.splits[_split_of(row)] += 1
            if split in (None, _split_of(row)):
                chosen.append((row_name, row))
    utterances = []
    for row_name, row in chosen:
        try:
            utterances.append(_utterance(row, inventory, any_license=any_license))
        except (UserError, ValueError, OSError) as error:  # OSError: invalid file name
            errors.add(row_name, str(error))
    return utterances


def audio_files(folder: Path) -> list[Path]:
    """Find and sort the recordings in a folder, at any depth, except those that are held out.

    Raises ``UserError`` if the folder contains no audio.
    """
    files = [path for path in sorted(folder.rglob("*")) if path.suffix in _AUDIO_SUFFIXES]
    if not files:
        raise UserError(f"{folder} contains no wav, flac, ogg or opus files")
    return [path for path in files if not path.name.startswith(_HELD_OUT_PREFIXES)]


def _split_of(row: dict[str, str]) -> str:
    return row.get("split") or "train"


def _utterance(row: dict[str, str], inventory: PhoneInventory, *, any_license: bool) -> Utterance:
    """Read a row; UserError, ValueError or OSError if it cannot be used."""
    path, license_name = Path(row["path"]), row.get("license", "")
    if not (any_license or may_distribute(license_name)):
        raise UserError(
            f"its license ({license_name or 'none'}) does not allow distributing a model;"
            " 'kouxing train --any-license' uses it"
        )
    if row["path"].endswith("|"):  # in Kaldi's wav.scp
        raise UserError("commands are not supported; write the path of an audio file")
    if not path.is_file():
        raise UserError(f"no audio file {path}")
    if inventory.language == UNIVERSAL:
        syllables = universal_words(row)
    else:
        syllables = inventory.pronounce(row.get("pinyin") or row["text"])
    seconds = float(row.get("seconds") or read_duration_s(path))
    phones = tuple(inventory.index[phone] for syllable in syllables for phone in syllable)
    if not phones:
        raise UserError("no text")
    if not len(phones) * _MIN_PHONE_S <= seconds < math.inf:
        raise UserError(f"{len(phones)} phones do not fit into {seconds:.2f} s")
    return Utterance(
        utterance_id=row["utt_id"],
        path=path,
        speaker=row.get("speaker") or row["utt_id"],
        license=license_name,
        is_synthetic=row.get("kind") == "synthetic" or "synthetic" in license_name.lower(),
        language=row.get("language", ""),
        split=_split_of(row),
        seconds=seconds,
        phones=phones,
        syllables=tuple(len(syllable) for syllable in syllables),
        labels=Path(row["phones_path"]) if has_labels(row) else None,
    )


def _manifest_rows(path: Path, audio: Path | None) -> Iterator[tuple[str, dict[str, str]]]:
    rows = read_rows(path, ("utt_id", "path", "pinyin or text"))
    for number, row in enumerate(rows, start=2):
        row_name = f"{path.name} row {number} ({row['utt_id']})"
        for name in ("path", "phones_path"):
            if row.get(name):
                row[name] = str((audio or path.parent) / row[name])
        yield row_name, {"text": "", **row}


def _kaldi_rows(folder: Path) -> Iterator[tuple[str, dict[str, str]]]:
    if (folder / "segments").is_file():
        raise UserError(
            f"{folder} has a file 'segments', which is not supported; write each segment as a file"
        )
    split = folder.name if folder.name in _KALDI_SPLITS else "train"
    speakers = dict(_read_pairs(folder / "utt2spk")) if (folder / "utt2spk").is_file() else {}
    texts = dict(_read_pairs(folder / "text"))
    for number, (utterance_id, where) in enumerate(_read_pairs(folder / "wav.scp"), start=1):
        path = Path(where) if Path(where).is_absolute() else folder / where
        yield (
            f"wav.scp line {number} ({utterance_id})",
            {
                "utt_id": utterance_id,
                "path": str(path),
                "speaker": speakers.get(utterance_id, ""),
                "split": split,
                "text": texts.get(utterance_id, ""),
            },
        )


def _aishell_rows(folder: Path) -> Iterator[tuple[str, dict[str, str]]]:
    audio = {path.stem: path for path in sorted((folder / "wav").rglob("*.wav"))}
    for transcript in sorted((folder / "transcript").glob("*.txt")):
        for number, (utterance_id, text) in enumerate(_read_pairs(transcript), start=1):
            path = audio.get(utterance_id, folder / "wav" / f"{utterance_id}.wav")
            yield (
                f"{transcript.name} line {number} ({utterance_id})",
                {
                    "utt_id": utterance_id,
                    "path": str(path),
                    "speaker": path.parent.name,
                    "license": "Apache-2.0",
                    # The split of a missing file is unknown; it is reported once, under train.
                    "split": path.relative_to(folder / "wav").parts[0]
                    if utterance_id in audio
                    else "train",
                    "text": text,
                },
            )


def _read_pairs(path: Path) -> Iterator[tuple[str, str]]:
    for line in split_lines(path, read_text(path, _MAX_LIST_BYTES)):
        if fields := line.split(maxsplit=1):  # at spaces or tabs
            yield fields[0], "".join(fields[1:]).strip()
