"""From clips of tracked lips and speech corpora to the table of the ferguson lip model.

Source: Zhang et al. 2021.

Table 2 gives vowels four levels of influence. Their factors are learned here from each final's mean
fraction of the syllable that is the initial. Finals are grouped into levels such that the fractions
deviate least from their level's mean.

Section 4 measures each opening on photographs. Here the tracked opening is R(t). Between key frames
it is linear in the openings of the two phones (eq. 6), so the openings are the solution of a
bounded linear least-squares problem. Rare phones are shrunk toward the values of their visemes in
other phones. Silence and bilabials are closed: R is 0.
"""

from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, islice, pairwise
from pathlib import Path

import numpy as np
from scipy.optimize import lsq_linear

from kouxing.corpora.feature_cache import read_audio
from kouxing.corpora.lip_clips import LipClip, label_clip, no_clip_error, openings_of, read_clips
from kouxing.corpora.speech_corpus import RowErrors, Utterance, read_corpus, syllables_of
from kouxing.services.recognizer.acoustic.acoustic_model import AcousticModel
from kouxing.services.recognizer.acoustic.load import load_model
from kouxing.services.recognizer.front_end.slices import measure_slices
from kouxing.services.recognizer.offline.alignment import align_syllables, drop_pauses
from kouxing.services.synthesizer.lips.dynamic_visemes.visemes import REST
from kouxing.services.synthesizer.lips.ferguson.contour import load_lip_points
from kouxing.services.synthesizer.lips.ferguson.key_frames import build_anchors
from kouxing.services.synthesizer.lips.ferguson.phone_table import COLUMNS, MAX_OPENING, PhoneTable
from kouxing.services.synthesizer.lips.ferguson.timing import OnsetCrossings
from kouxing.shared.arrays import Doubles
from kouxing.shared.command.terminal import print_message, write_text
from kouxing.shared.errors import UserError
from kouxing.shared.face.faps import MOUTH_FAPS
from kouxing.shared.phones.events import Phone, Progress
from kouxing.shared.phones.inventory import PhoneInventory, Syllable

NUM_LEVELS = 4
_KIND_RIDGE = 5.0  # weight of the mean of all phones of a kind, phones


@dataclass(frozen=True, slots=True)
class AlignedSpeech:
    """A recording with its syllables and the times of their phones."""

    slices: Sequence[Progress]
    syllables: Sequence[Syllable]
    phones: Sequence[Phone]  # without silence


def phone_table(
    opening: dict[str, float], speech: Iterable[AlignedSpeech], inventory: PhoneInventory
) -> PhoneTable:
    """Add durations, zero crossings and influence to the openings of the phones."""
    durations: dict[str, list[float]] = defaultdict(list)
    crossings: dict[str, list[float]] = defaultdict(list)
    initial_fractions: dict[str, list[float]] = defaultdict(list)
    for recording in speech:
        onset_crossings = OnsetCrossings(recording.slices)
        remaining = iter(recording.phones)
        for syllable in recording.syllables:
            phones = list(islice(remaining, len(syllable)))
            for phone in phones:
                durations[phone.symbol].append(phone.duration_s)
            crossings[syllable[0]].append(
                float(onset_crossings.at(np.array([phones[0].onset_s]))[0])
            )
            if len(syllable) > 1 and syllable[0] in inventory.initials:
                length_s = phones[0].duration_s + phones[1].duration_s
                initial_fractions[syllable[1]].append(phones[0].duration_s / length_s)
    kind = dict(zip(inventory.phones, inventory.kinds, strict=True))
    mean_fractions = _means(initial_fractions, sorted(inventory.vowels), lambda _: "vowel")
    counts = {phone: len(initial_fractions[phone]) + _KIND_RIDGE for phone in mean_fractions}
    level, influence = influence_levels(mean_fractions, counts)
    return PhoneTable(
        opening=opening,
        duration_s=_means(durations, inventory.phones, kind.__getitem__),
        crossings=_means(crossings, inventory.phones, kind.__getitem__),
        level=level,
        influence=influence,
    )


def influence_levels(
    fractions: Mapping[str, float], weight: Mapping[str, float]
) -> tuple[dict[str, int], dict[str, float]]:
    """Group finals by the fraction of their initials; return level and factor of each.

    ``fractions`` has the mean fraction of the syllable that is the initial, for at least
    ``NUM_LEVELS`` finals.
    """
    finals = sorted(fractions, key=lambda final: (-fractions[final], final))
    values = np.array([fractions[final] for final in finals])
    weights = np.array([weight[final] for final in finals])

    def split_levels(cuts: tuple[int, ...]) -> list[slice]:
        return [slice(start, end) for start, end in pairwise((0, *cuts, len(finals)))]

    def factor(group: slice) -> float:
        return float(np.average(values[group], weights=weights[group]))

    def misfit(cuts: tuple[int, ...]) -> float:
        return sum(
            float(weights[group] @ (values[group] - factor(group)) ** 2)
            for group in split_levels(cuts)
        )

    best = split_levels(min(combinations(range(1, len(finals)), NUM_LEVELS - 1), key=misfit))
    level = {final: row for row, group in enumerate(best, start=1) for final in finals[group]}
    factors = [factor(group) for group in best]
    return level, {final: factors[level[final] - 1] for final in finals}


def _means(
    by_phone: Mapping[str, list[float]], phones: Sequence[str], kind: Callable[[str], str]
) -> dict[str, float]:
    """Compute the mean of each phone; rare phones are shrunk toward the mean of their kind."""
    values_by_kind: dict[str, list[float]] = defaultdict(list)
    for phone in phones:
        values_by_kind[kind(phone)] += by_phone.get(phone, [])
    everything = [value for values in values_by_kind.values() for value in values]
    means = {}
    for phone in phones:
        values = by_phone.get(phone, [])
        kind_mean = np.mean(values_by_kind[kind(phone)] or everything)
        means[phone] = float((sum(values) + _KIND_RIDGE * kind_mean) / (len(values) + _KIND_RIDGE))
    return means


_OPENING_RIDGE = 10.0  # weight of the value from a phone's visemes, video frames
_CLOSED = (REST, "b")  # visemes whose lips touch
_DEFAULT_OPENING = 2.0  # opening of a viseme without data


def relative_openings(clips: Sequence[LipClip]) -> list[Doubles]:
    """Compute R of the frames of each clip, (num_frames,); NaN if not measured.

    R is 0 for a closed mouth and 5 for the speaker's widest.
    """
    openings, widest = openings_of([clip.speaker for clip in clips], [clip.faps for clip in clips])
    return [
        np.clip(MAX_OPENING * opening / widest[clip.speaker], 0.0, MAX_OPENING)
        for clip, opening in zip(clips, openings, strict=True)
    ]


def fit_openings(
    clips: Sequence[LipClip], labels: Sequence[list[Phone]], inventory: PhoneInventory
) -> dict[str, float]:
    """Estimate the opening of each phone from clips and their phones."""
    is_open = np.array(
        [inventory.visemes[phone][0][0] not in _CLOSED for phone in inventory.phones]
    )
    parts, heights = [], []
    for clip, phones, opening in zip(clips, labels, relative_openings(clips), strict=True):
        is_measured = np.isfinite(opening)
        parts.append(_opening_weights(clip.time_s[is_measured], phones, inventory) * is_open)
        heights.append(opening[is_measured])
    weights, height = np.concatenate(parts), np.concatenate(heights)
    fractions = _viseme_fractions(inventory) * is_open[:, None]
    viseme_heights = _least_squares(
        weights @ fractions, height, np.full(fractions.shape[1], _DEFAULT_OPENING)
    )
    fitted = _least_squares(weights, height, fractions @ viseme_heights)
    return dict(zip(inventory.phones, (fitted * is_open).tolist(), strict=True))


def measure_travel(clips: Sequence[LipClip]) -> Doubles:
    """Measure the travel of each mouth FAP from a closed to the widest mouth, FAP units.

    These are the coefficients of motion of Zhang et al. 2021, section 3, by least squares through
    the closed mouth, (num_mouth_faps,); 0 for FAPs that were not measured.
    """
    opening = np.concatenate(relative_openings(clips)) / MAX_OPENING
    faps = np.concatenate([clip.faps for clip in clips])
    travel = np.zeros(len(MOUTH_FAPS))
    for column in range(len(MOUTH_FAPS)):
        is_measured = np.isfinite(opening) & np.isfinite(faps[:, column])
        x, y = opening[is_measured], faps[is_measured, column]
        if len(x):
            travel[column] = float(x @ y) / max(float(x @ x), 1.0)
    return travel


def _opening_weights(
    times_s: Doubles, phones: Sequence[Phone], inventory: PhoneInventory
) -> Doubles:
    """Compute the weight of each phone's opening in R at some times, (num_times, num_phones)."""
    anchors = build_anchors(phones)
    weights = np.zeros((len(times_s), len(inventory)))
    anchors_s = [time_s for time_s, _ in anchors]
    for number, (_, symbol) in enumerate(anchors):
        tent = np.zeros(len(anchors))
        tent[number] = 1.0
        weights[:, inventory.index[symbol]] += np.interp(times_s, anchors_s, tent)
    return weights


def _viseme_fractions(inventory: PhoneInventory) -> Doubles:
    """Return the fraction of each viseme in each phone, (num_phones, num_visemes)."""
    names = sorted({name for fractions in inventory.visemes.values() for name, _ in fractions})
    fractions = np.zeros((len(inventory), len(names)))
    for row, phone in enumerate(inventory.phones):
        for name, fraction in inventory.visemes[phone]:
            fractions[row, names.index(name)] += fraction
    return fractions


def _least_squares(weights: Doubles, height: Doubles, start: Doubles) -> Doubles:
    ridge = np.sqrt(_OPENING_RIDGE)
    result = lsq_linear(
        np.vstack([weights, ridge * np.eye(len(start))]),
        np.concatenate([height, ridge * start]),
        (0.0, MAX_OPENING),
    )
    return np.asarray(np.clip(result.x, 0.0, MAX_OPENING))


_MIN_SYLLABLES = 3  # isolated words are slower than connected speech
_MAX_OF_SPEAKER = 60  # recordings


def train_ferguson(
    clips: Path, corpora: Sequence[Path], output: Path, *, any_license: bool
) -> None:
    """Learn the table from the training clips and recordings.

    Raises ``UserError`` if no data may be used, or the file cannot be written.
    """
    model = load_model()
    inventory = model.inventory
    used = [clip for clip in read_clips(clips, any_license=any_license) if clip.split == "train"]
    if not used:
        raise no_clip_error(clips)
    openings = fit_openings(used, [label_clip(model, clip) for clip in used], inventory)
    errors = RowErrors()
    rows = training_rows(corpora, inventory, errors, any_license=any_license)
    table = phone_table(openings, aligned_speech(model, rows, errors), inventory)
    errors.report_to(print_message)
    travel_by_fap = dict(zip(MOUTH_FAPS, measure_travel(used), strict=True))
    for name, point in load_lip_points().items():
        if point.fap is not None:
            travel = travel_by_fap[point.fap]
            result = f"travel {travel:.1f} FAP units" if travel else "not measured; keep its value"
            print_message(f"lip_points.tsv: point {name}, FAP {point.fap}: {result}")
    licenses = sorted({clip.license for clip in used} | {row.license for row in rows})
    about = [
        "Made by `kouxing train ferguson`; least squares, no seed.",
        f"Openings from the clips {', '.join(clip.name for clip in used)}; "
        f"the rest from {len(rows)} recordings.",
        f"Under: {'; '.join(licenses)}",
    ]
    write_text(output, format_table(table, inventory, about))


def training_rows(
    corpora: Sequence[Path], inventory: PhoneInventory, errors: RowErrors, *, any_license: bool
) -> list[Utterance]:
    """Read sentences of the training split, at most ``_MAX_OF_SPEAKER`` of each speaker.

    Raises ``UserError`` if there are no usable sentences.
    """
    chosen: list[Utterance] = []
    num_by_speaker: Counter[str] = Counter()
    for corpus in corpora:
        rows = read_corpus(corpus, errors, inventory, split="train", any_license=any_license)
        for row in rows:
            if (
                len(row.syllables) >= _MIN_SYLLABLES
                and num_by_speaker[row.speaker] < _MAX_OF_SPEAKER
            ):
                num_by_speaker[row.speaker] += 1
                chosen.append(row)
    if not chosen:
        raise errors.no_recording_error(f"in {', '.join(map(str, corpora))}")
    return chosen


def aligned_speech(
    model: AcousticModel, rows: Sequence[Utterance], errors: RowErrors
) -> Iterator[AlignedSpeech]:
    """Align recordings with their texts; report those that do not fit."""
    for row in rows:
        syllables = syllables_of(row, model.inventory)
        try:
            samples = read_audio(row.path)
            phones = align_syllables(model, samples, syllables).phones
        except UserError as error:
            errors.add(row.utterance_id, str(error))
            continue
        yield AlignedSpeech(
            measure_slices(samples), syllables, drop_pauses(phones, model.inventory)
        )


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
