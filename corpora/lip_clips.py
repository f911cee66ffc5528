"""Clips of lip motion with audio: tracked video, or an animator's rig.

A folder contains for each clip ``<clip>.flac``, ``<clip>.csv`` (a row for each video frame with
``t`` in seconds) and ``<clip>.json`` (kind, license, speaker, language, transcript). Columns are
FAPs of a tracked video (``F5_raise_b_midlip``) or weights of FACEGOOD's face rig
(``mouth_stretch_c``). A clip's source is the first part of its name: ``cmlr`` of ``cmlr_s1_3``.

Every clip belongs to one split: training (``train``), choosing settings (``choice``), or scoring
(``held``). The rule `split_of` decides, so clips cannot be picked by hand. ``held.txt`` in the
folder names additional clips and speakers to hold out.
"""

import csv
import itertools
import zipfile
import zlib
from collections import defaultdict
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.progress import track

from kouxing.corpora.feature_cache import read_audio
from kouxing.corpora.speech_corpus import may_distribute, may_share
from kouxing.services.mouth_profiles.learning import FilmedSpeech
from kouxing.services.mouth_profiles.lip_tracks import select_lip_faps
from kouxing.services.recognizer.acoustic.acoustic_model import AcousticModel
from kouxing.services.recognizer.lips.lip_predictor import LIP_FAPS, OTHER_SIDE
from kouxing.services.recognizer.offline.alignment import align_text
from kouxing.services.recognizer.offline.offline_recognition import recognize_recording
from kouxing.services.synthesizer.lips.dynamic_visemes.parameters import fap_columns
from kouxing.shared.arrays import Doubles, Floats
from kouxing.shared.clock import MEDIA_RATE_HZ
from kouxing.shared.errors import UserError
from kouxing.shared.face.faps import MOUTH_FAPS, NUM_MOUTH_FAPS, PROTRUSION_FAPS
from kouxing.shared.files.output_file import write_error
from kouxing.shared.files.user_file import check_content, parse_json, read_text, split_lines
from kouxing.shared.phones.events import Phone

_MAX_BYTES = 64 << 20  # limit for a table
_MAX_ROWS = 1_000_000
_FULL_PERCENTILE = 98.0
_FILMED = "tracked video"  # start of the kind of a filmed clip
CLOSED_FRACTION = 0.1  # lips that touch open at most this fraction of their tracked range
_OUT_OF_SYNC_GRADES = ("C",)  # audio and video were recorded or processed separately
_SUFFIXES = (".flac", ".csv", ".json")
_ARCHIVE_COLUMNS = ("clip", "split", "language", "speaker", "license")

# Change of ``LIP_FAPS`` when a shape of FACEGOOD's rig has weight 1. It was measured on the ARKit
# shape of the same name of MakeHuman's face (CC0), with both sides of a pair together. The rig's
# jaw opens wider than a speaker's, so it is scaled to the opening of filmed speakers. Pursed lips
# are scaled to half a centimeter. Real pursed lips nearly touch, but the shapes' lips do not, so
# their heights come from the filmed speakers' u. The head adds the backward swing of the jaw.
_JAW_SCALE = 0.6
_DEPTH_SCALE = 0.6
_RIG_DELAY_S = 0.04  # lag of its lips behind filmed speakers' lips
_RIG_SHAPES = {
    "mouth_stretch_c": [
        _JAW_SCALE * value
        for value in (1021, -47, -1995, -41, 153, -1649, -739, 0, 0, 129, -1884, -50, 276, -1438,
                      -716)
    ],
    "mouth_lowerLipDepress": [-58, 0, -222, 3, 0, -264, -53, 70, 0, 0, -188, 3, 0, -206, -23],
    "mouth_upperLipRaise": [0, -294, 0, -9, -311, 12, 76, 0, 24, -222, 0, -9, -270, 18, 82],
    "mouth_press": [24, -46, 188, 146, -141, 158, 270, 0, 24, 24, 246, 135, -35, 258, 288],
    "mouth_suck_d": [-65, 0, 188, 2, 0, 59, -41, -270, 0, 0, 317, -2, 0, 153, 0],
    "mouth_suck_u": [0, 70, 0, 9, 29, 0, 35, 0, -563, 434, 0, 2, 311, 0, 6],
    "mouth_pucker": [0, 60, 250, -130, 40, 190, 6, 511, 481, -106, 200, -125, -94, 140, -18],
    "mouth_funnel": [0, -100, -250, -70, 40, -100, -18, 293, 581, -150, -100, -86, -12, 20, 0],
    "mouth_oo_c": [0, 60, 250, -140, 40, 190, 6, 511, 481, -106, 200, -135, -94, 140, -18],
    "mouth_oh_c": [0, 60, 250, -130, 40, 190, 0, 450, 500, -100, 200, -120, -70, 140, -14],
    "mouth_lipStretch": [0, 12, -46, 121, 65, -77, -147, 0, 36, 46, -24, 121, 94, -41, -158],
    "mouth_lipCornerPull": [0, -188, 352, 169, -311, 393, 739, 24, 24, -130, 410, 168, -229, 511,
                            768],
    "mouth_dimple": [0, -46, 18, 118, -94, 71, 164, 12, 12, 24, 70, 121, -41, 135, 176],
    "mouth_chinRaise_u": [6, 0, 293, -2, 0, 170, 35, 246, 0, 0, 311, -2, 0, 164, 18],
}  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class LipClip:
    """A recording with the motion of its speaker's mouth."""

    name: str
    speaker: str = ""
    license: str = ""
    language: str = ""  # "zh", "en", ...
    split: str = "train"  # "train", "choice" or "held"
    is_in_sync: bool = True  # otherwise only shapes can be compared, not times
    is_filmed: bool = True  # otherwise captured with sensors, or animated
    is_rig: bool = False  # an animator's rig, whose mouth rests at 0
    transcript: str = ""  # empty if unknown
    time_s: Doubles  # (num_frames,)
    faps: Doubles  # (num_frames, num_mouth_faps), FAP units, NaN if not measured
    samples: Floats  # 16 kHz mono

    @property
    def source(self) -> str:
        """The first part of the clip's name."""
        return self.name.partition("_")[0]

    @property
    def minutes(self) -> float:
        """Duration of the audio."""
        return len(self.samples) / MEDIA_RATE_HZ / 60

    def filmed_speech(self) -> FilmedSpeech:
        """Return the clip as input for learning a mouth profile."""
        return FilmedSpeech(
            samples=self.samples, frame_s=self.time_s, lip_track=select_lip_faps(self.faps)
        )


def split_of(name: str, *, may_train: bool) -> str:
    """Return the split of a clip, by the CRC-32 of its name modulo 4.

    2 is ``held``, odd values are ``train`` if the license allows it, all others are ``choice``.
    """
    remainder = zlib.crc32(name.encode()) % 4
    if remainder == 2:
        return "held"
    return "train" if may_train and remainder % 2 else "choice"


def read_clips(
    folder: Path, *, any_license: bool = False, language: str | None = "zh"
) -> list[LipClip]:
    """Read the clips of a folder in one language, or in all with None.

    Without ``any_license``, clips whose license does not allow distributing a model are not in the
    split ``train``. A ``.json`` file without a ``.flac`` or ``.csv`` file of the same name is not
    a clip. Raises ``UserError`` if there are no clips, or one of them cannot be read.
    """
    held = folder / "held.txt"
    held_out = set(read_text(held, _MAX_BYTES).split()) if held.exists() else set()
    clips = [
        clip
        for path in sorted(folder.glob("*.json"))
        if any(path.with_suffix(suffix).exists() for suffix in (".flac", ".csv"))
        and (clip := _read_clip(path, language, any_license=any_license, held_out=held_out))
    ]
    if not clips:
        kind = {"zh": "Mandarin clips", None: "clips"}.get(language, f"clips in {language!r}")
        raise UserError(f"no {kind} in {folder}; use a folder with .flac, .csv and .json files")
    return clips


def training_clips(clips: Iterable[LipClip], *, any_license: bool = False) -> list[LipClip]:
    """Return the clips that a model may be trained on. By default, their license must allow it."""
    return [
        clip
        for clip in clips
        if clip.split != "held" and (any_license or may_distribute(clip.license))
    ]


def no_clip_error(folder: Path) -> UserError:
    """Make the error that a model cannot be trained on any clip of a folder."""
    return UserError(
        f"no clip in {folder} has a license that allows training; add clips with a free license,"
        " or use kouxing train --any-license"
    )


def read_clip(path: Path) -> LipClip:
    """Read the clip that a file belongs to; UserError if it cannot be read."""
    if path.suffix not in (".json", ".flac", ".csv"):
        raise UserError(f"{path}: not a clip; use the .json file that kouxing track wrote")
    clip = _read_clip(path.with_suffix(".json"), None, any_license=True)
    assert clip is not None  # noqa: S101 - in any language
    return clip


def _read_clip(
    path: Path, language: str | None, *, any_license: bool, held_out: Collection[str] = ()
) -> LipClip | None:
    """Read a clip; None if it is in another language."""
    with check_content(path, "a clip"):
        # a statistic of a clip with too few frames is NaN; this function does not use it
        metadata = parse_json(read_text(path, _MAX_BYTES), allow_nan=True)
        clip_language = str(metadata.get("language", "zh"))[:2]
        if language not in (None, clip_language):
            return None
        license_name = str(metadata.get("license", metadata.get("licence", "")))
        speaker = str(metadata.get("speaker", ""))
        table = path.with_suffix(".csv")
        lines = split_lines(table, read_text(table, _MAX_BYTES))
        rows = list(itertools.islice(csv.DictReader(lines), _MAX_ROWS + 1))
        if not rows or None in rows[0] or len(rows) > _MAX_ROWS:
            raise ValueError(
                f"its table has no rows, more than {_MAX_ROWS}, or rows longer than its header"
            )
        values = {name: np.array([float(row[name] or "nan") for row in rows]) for name in rows[0]}
        if not (np.diff(values["t"]) > 0.0).all() or not np.isfinite(values["t"]).all():
            raise ValueError("its times are not increasing")
        is_rig = "mouth_stretch_c" in values
        faps = _rig_faps(values) if is_rig else _tracked_faps(values)
        if np.isnan(faps).all():
            raise ValueError("it contains no FAP of the mouth")
        split = split_of(path.stem, may_train=any_license or may_distribute(license_name))
        return LipClip(
            name=path.stem,
            speaker=speaker,
            license=license_name,
            language=clip_language,
            split="held" if {path.stem, speaker} & {*held_out} else split,
            is_in_sync=metadata.get("grade") not in _OUT_OF_SYNC_GRADES,
            is_filmed=str(metadata.get("kind", _FILMED)).startswith(_FILMED),
            is_rig=is_rig,
            transcript=metadata.get("transcript") or "",
            time_s=values["t"] - (_RIG_DELAY_S if is_rig else 0.0),
            faps=faps,
            samples=read_audio(path.with_suffix(".flac")),
        )


def _tracked_faps(tracks: dict[str, Doubles]) -> Doubles:
    faps = np.full((len(tracks["t"]), NUM_MOUTH_FAPS), np.nan)
    for name, values in tracks.items():
        number = name[1:].partition("_")[0]
        if name.startswith("F") and number.isdigit() and int(number) in MOUTH_FAPS:
            faps[:, MOUTH_FAPS.index(int(number))] = values
    faps[tracks.get("ok", np.ones(len(faps))) == 0.0] = np.nan
    return faps


def _rig_faps(tracks: dict[str, Doubles]) -> Doubles:
    faps = np.full((len(tracks["t"]), NUM_MOUTH_FAPS), np.nan)
    faps[:, fap_columns(LIP_FAPS)] = 0.0
    for shape, effect in _RIG_SHAPES.items():
        # up to three letters are the side: mouth_suck_dl, mouth_press_l, mouth_funnel_dr
        sides = [
            values
            for name, values in tracks.items()
            if name.startswith(shape) and len(name) - len(shape) <= 3
        ]
        if not sides:
            raise KeyError(shape)
        weight = np.mean(np.stack(sides), axis=0)
        faps[:, fap_columns(LIP_FAPS)] += weight[:, None] * np.array(effect, dtype=float)
    faps[:, fap_columns(PROTRUSION_FAPS)] *= _DEPTH_SCALE
    for upper, lower in fap_columns((4, 5)), fap_columns((8, 10)):
        # lips do not pass through each other
        crossed = np.maximum(faps[:, upper] + faps[:, lower], 0.0)
        faps[:, upper] -= 0.5 * crossed
        faps[:, lower] -= 0.5 * crossed
    for left, right in OTHER_SIDE.items():
        faps[:, MOUTH_FAPS.index(right)] = faps[:, MOUTH_FAPS.index(left)]
    return faps


def opening_of(faps: Doubles) -> Doubles:
    """Return the opening between the inner lips relative to the neutral face, (num_frames,)."""
    return np.asarray(-faps[:, fap_columns((4, 5))].sum(axis=1))


def openings_of(
    speakers: Sequence[str], mouths: Sequence[Doubles]
) -> tuple[list[Doubles], dict[str, float]]:
    """Return the opening of each frame of mouth FAPs, and each speaker's widest one, FAP units.

    The widest opening is the 98th percentile of all frames of a speaker, at least 1.
    """
    openings = [opening_of(faps) for faps in mouths]
    by_speaker: dict[str, list[Doubles]] = defaultdict(list)
    for speaker, opening in zip(speakers, openings, strict=True):
        by_speaker[speaker].append(opening)
    return openings, {
        speaker: max(float(np.nanpercentile(np.concatenate(group), _FULL_PERCENTILE)), 1.0)
        for speaker, group in by_speaker.items()
    }


def aligned_phones(model: AcousticModel, clip: LipClip) -> list[Phone] | None:
    """Align a clip with its text; None if it has no text in the model's language."""
    if not clip.transcript or clip.language != model.inventory.code:
        return None
    try:
        return align_text(model, clip.samples, clip.transcript)
    except UserError:
        return None


def label_clips(model: AcousticModel, clips: Iterable[LipClip]) -> dict[str, list[Phone]]:
    """Find the phones of the clips in the model's language, by the names of the clips."""
    known = [clip for clip in clips if clip.language == model.inventory.code]
    return {clip.name: label_clip(model, clip) for clip in track(known, "phones of clips")}


def label_clip(model: AcousticModel, clip: LipClip) -> list[Phone]:
    """Find the phones of a clip: aligned if its text is known, otherwise recognized."""
    return aligned_phones(model, clip) or recognize_recording(model, clip.samples)


def write_clip_archive(folder: Path, archive: Path) -> tuple[int, set[str]]:
    """Write a ZIP file with the clips of a folder that may be shared.

    Returns their number, and the licenses of all other clips.

    ``held.txt`` names all held-out clips. ``clips.tsv`` lists split, language, speaker and license
    of each clip. Raises ``UserError`` if no clip may be shared, or the file cannot be written.
    """
    all_clips = read_clips(folder, language=None)
    clips = [clip for clip in all_clips if may_share(clip.license)]
    if not clips:
        raise UserError(f"{folder}: no clip has a license that allows sharing, such as CC BY")
    rows = [(c.name, c.split, c.language, c.speaker, c.license.replace("\t", " ")) for c in clips]
    table = "\n".join("\t".join(row) for row in [_ARCHIVE_COLUMNS, *rows]) + "\n"
    unfinished = archive.with_name(archive.name + ".part")
    try:
        with zipfile.ZipFile(unfinished, "w", zipfile.ZIP_DEFLATED) as file:
            file.writestr("clips.tsv", table)
            file.writestr("held.txt", "".join(f"{c.name}\n" for c in clips if c.split == "held"))
            for clip in clips:
                for suffix in _SUFFIXES:
                    file.write(folder / (clip.name + suffix), clip.name + suffix)
        unfinished.replace(archive)
    except OSError as error:
        unfinished.unlink(missing_ok=True)
        raise write_error(archive, error) from None
    return len(clips), {clip.license or "none" for clip in all_clips if clip not in clips}
