"""From clips of tracked lips and speech corpora to the table of the ferguson lip model."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from kouxing.corpora.feature_cache import read_audio
from kouxing.corpora.lip_clips import label_clip, read_clips
from kouxing.corpora.speech_corpus import RowErrors, Utterance, may_ship, read_corpus, syllables_of
from kouxing.services.recognizer.acoustic.acoustic_model import AcousticModel
from kouxing.services.recognizer.acoustic.load import load_model
from kouxing.services.recognizer.alignment import align_phones, spoken
from kouxing.services.recognizer.front_end.pcm import progress_of
from kouxing.services.synthesizer.lips.ferguson.contour import lip_points
from kouxing.services.synthesizer.lips.ferguson.table import COLUMNS, PhoneTable
from kouxing.shared.clock import MEDIA_RATE_HZ
from kouxing.shared.errors import UserError
from kouxing.shared.face.faps import MOUTH_FAPS
from kouxing.shared.phones.inventory import PhoneInventory
from kouxing.training.ferguson.lengths import AlignedSpeech, phone_table
from kouxing.training.ferguson.openings import fit_openings, travel_of
from kouxing.training.training_set import Report

_MIN_SYLLABLES = 3  # isolated words are slower than connected speech
_MAX_OF_SPEAKER = 60  # recordings


def train_ferguson(
    clips: Path, corpora: Sequence[Path], output: Path, report: Report, *, any_license: bool = False
) -> None:
    """Learn the table from the training clips and recordings.

    Raises UserError if no data may be used, or the file cannot be written.
    """
    model = load_model()
    inventory = model.inventory
    used = [clip for clip in read_clips(clips, any_license=any_license) if clip.part == "train"]
    if not used:
        raise UserError(
            f"no clip in {clips} may be used; give clips with a free license, or --any-license"
        )
    openings = fit_openings(used, [label_clip(model, clip) for clip in used], inventory)
    errors = RowErrors()
    rows = training_rows(corpora, inventory, errors, any_license=any_license)
    table = phone_table(openings, aligned_speech(model, rows, errors), inventory)
    errors.print_to(report)
    of_fap = dict(zip(MOUTH_FAPS, travel_of(used), strict=True))
    for name, point in lip_points().items():
        if point.fap is not None:
            travel = of_fap[point.fap]
            result = f"travel {travel:.1f} FAP units" if travel else "not measured; keep its value"
            report(f"lip_points.tsv: point {name}, FAP {point.fap}: {result}")
    licenses = sorted({clip.license for clip in used} | {row.license for row in rows})
    about = [
        "Made by `kouxing train ferguson`; least squares, no seed.",
        f"Openings from the clips {', '.join(clip.name for clip in used)}; "
        f"the rest from {len(rows)} recordings.",
        f"Under: {'; '.join(licenses)}",
    ]
    try:
        output.write_text(format_table(table, inventory, about), encoding="utf-8")
    except OSError as error:
        raise UserError(f"cannot write {output}: {error.strerror}") from None


def training_rows(
    corpora: Sequence[Path], inventory: PhoneInventory, errors: RowErrors, *, any_license: bool
) -> list[Utterance]:
    """Read sentences of the training split, at most ``_MAX_OF_SPEAKER`` of each speaker.

    Raises UserError if there are no usable sentences.
    """
    chosen: list[Utterance] = []
    of_speaker: dict[str, int] = {}
    for corpus in corpora:
        for row in read_corpus(corpus, errors, inventory, split="train"):
            number = of_speaker.get(row.speaker, 0)
            is_free = any_license or may_ship(row.license)
            if is_free and len(row.syllables) >= _MIN_SYLLABLES and number < _MAX_OF_SPEAKER:
                of_speaker[row.speaker] = number + 1
                chosen.append(row)
    if not chosen:
        raise errors.nothing_left(f"in {', '.join(map(str, corpora))}")
    return chosen


def aligned_speech(
    model: AcousticModel, rows: Sequence[Utterance], errors: RowErrors
) -> Iterator[AlignedSpeech]:
    """Align recordings with their texts; report those that do not fit."""
    for row in rows:
        syllables = syllables_of(row, model.inventory)
        try:
            samples = read_audio(row.path)
            phones = align_phones(model, samples, MEDIA_RATE_HZ, syllables)
        except (UserError, OSError, ValueError) as error:
            errors.add(row.utterance_id, str(error))
            continue
        yield AlignedSpeech(progress_of(samples), syllables, spoken(phones, model.inventory))


def format_table(table: PhoneTable, inventory: PhoneInventory, about: list[str]) -> str:
    """Return a table as text, after comment lines about its origin."""
    rows = [
        (
            phone,
            f"{table.opening[phone]:.2f}",
            f"{table.duration_s[phone]:.3f}",
            f"{table.crossings[phone]:.2f}",
            str(table.level.get(phone, "")),
            f"{table.influence[phone]:.2f}" if phone in table.influence else "",
        )
        for phone in inventory.phones
    ]
    lines = [*(f"# {line}" for line in about), *("\t".join(row) for row in (COLUMNS, *rows))]
    return "\n".join(lines) + "\n"
