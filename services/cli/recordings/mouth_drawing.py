"""``kouxing lips``: the 2-D mouth of a recording, as a video, a picture of key frames, or a table.

Method: Zhang et al. 2021. A text and its timing give key frames of the opening R.
Interpolation gives R(t), and R(t) gives the contour. The paper's mouth has one width. Here, another
lip model gives the width, so that the mouth is round for u, ü and o.
"""

import codecs
import csv
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from kouxing.services.cli.options import TimingMethod, WidthSource
from kouxing.services.cli.recordings.captions import spell_syllables
from kouxing.services.cli.recordings.curve_exporters import item_at, phone_at
from kouxing.services.cli.texts.spoken_text import print_mismatch, read_transcript, report_mismatch
from kouxing.services.driver.video.video_writer import VideoWriter, write_picture
from kouxing.services.mono_audio import read_mono_16k
from kouxing.services.recognizer.acoustic.languages import load_model_for_language
from kouxing.services.recognizer.front_end.slices import measure_slices
from kouxing.services.recognizer.lips.lip_predictor import load_lip_predictor
from kouxing.services.recognizer.offline.alignment import align_syllables, drop_pauses
from kouxing.services.recognizer.offline.offline_recognition import (
    WithProgress,
    recognize_recording,
)
from kouxing.services.recognizer.offline.transcriber import Transcriber
from kouxing.services.recording_pipeline import analyze_recording, animate_recording
from kouxing.services.synthesizer.config import SynthesizerConfig
from kouxing.services.synthesizer.lips.ferguson import drawing
from kouxing.services.synthesizer.lips.ferguson.contour import LINES, compute_rounded_contour
from kouxing.services.synthesizer.lips.ferguson.key_frames import (
    KeyFrames,
    build_anchors,
    build_key_frames,
)
from kouxing.services.synthesizer.lips.ferguson.phone_table import load_table
from kouxing.services.synthesizer.lips.ferguson.timing import (
    MAX_SPEECH_RATIO,
    MAX_SYLLABLES,
    MIN_SPEECH_RATIO,
    speech_ratio,
    time_text,
)
from kouxing.services.synthesizer.lips.load import load_lip_model
from kouxing.shared.arrays import Doubles, Floats
from kouxing.shared.clock import MEDIA_RATE_HZ
from kouxing.shared.command.terminal import open_progress, plural, print_message, write_text
from kouxing.shared.errors import UserError
from kouxing.shared.face.faps import FAP_UNITS_PER_FAPU
from kouxing.shared.files.output_file import open_output
from kouxing.shared.fonts import NO_CHINESE_FONT, can_draw
from kouxing.shared.phones.events import Phone
from kouxing.shared.phones.inventory import DEFAULT_LANGUAGE, PhoneInventory, load_inventory
from kouxing.shared.phones.transcript import TimedSyllable, Transcript

NUM_POINTS = 21  # on each line of the contour, in a table
FRAME_RATE_HZ = 25.0
CSV_COLUMNS = ("time_s", "opening", "line", "point", "x", "y", "phone")
_VIDEO_SIZE_PX = (640, 480)
_MOUTHS_PER_ROW, _MOUTH_PX = 8, 150.0
_MAX_MOUTHS = 400  # maximum number of mouths in one picture
_STRETCH = slice(5, 7)  # FAP 6 and 7, of the corners
_BLOCK_FRAMES = 250  # number of contours to compute at once


@dataclass(frozen=True, slots=True, kw_only=True)
class _MouthMotion:
    """The motion of a mouth, and its labels in the drawing."""

    samples: Floats  # 16 kHz mono, shape (n,)
    phones: Sequence[Phone]
    syllables: Sequence[TimedSyllable]
    key_frames: KeyFrames
    widths: tuple[Doubles, Doubles]  # times, and the width at each, relative to the mouth at rest
    inventory: PhoneInventory
    shows_text: bool  # whether labels show characters next to their spelling

    def widths_at(self, times_s: Sequence[float] | Doubles) -> Doubles:
        """Return the width at times (n,), relative to the mouth at rest."""
        return np.interp(times_s, *self.widths)

    def sample(self) -> tuple[Doubles, Doubles, Doubles]:
        """Return the times of the video's frames, and the opening and the width at each of them."""
        num_frames = int(len(self.samples) / MEDIA_RATE_HZ * FRAME_RATE_HZ) + 1
        times_s = np.arange(num_frames) / FRAME_RATE_HZ
        openings = self.key_frames.openings_at(times_s)
        return times_s, openings, self.widths_at(times_s)

    def label(self, syllable: TimedSyllable) -> str:
        """Return the spelling of a syllable, after its characters if they can be drawn."""
        if self.shows_text and syllable.text != syllable.spelling:
            return f"{syllable.text} {syllable.spelling}"
        return syllable.spelling


def draw_mouth(
    source: Path,
    text: str | None,
    output: Path,
    *,
    lips: WidthSource = WidthSource.VISEMES,
    timing: TimingMethod | None = None,
    speech_to_text: Path | None = None,
    track: int | None = None,
    language: str = DEFAULT_LANGUAGE,
) -> bool:
    """Draw the mouth of an audio file, in the format of the output's suffix.

    ``.svg`` and ``.png`` show the mouth at the key frames, ``.mp4`` is a video with audio, and
    ``.csv`` has the contour of every frame with ``NUM_POINTS`` for each line. Without a text, the
    model in the folder ``speech_to_text`` recognizes the text. Without that folder, phones are
    recognized. ``lips`` gives the width. Returns False if the text does not fit the audio.

    Raises ``UserError`` if a file cannot be read or written, or the options do not fit each other.
    """
    suffix = output.suffix.lower()
    write = _WRITERS.get(suffix)
    if write is None:
        raise UserError(f"{output}: use a name that ends in {', '.join(_WRITERS)}")
    if text is not None and speech_to_text is not None:
        raise UserError("use either a text or --speech-to-text, not both")
    if text is None and speech_to_text is None and timing is not None:
        raise UserError("--timing needs a text; write the spoken text before the output file")
    inventory = load_inventory(language)
    with open_progress() as progress:
        samples = read_mono_16k(source, track, progress)
    if speech_to_text is not None:
        text = Transcriber(speech_to_text).transcribe(samples) or None
        print_message(f"{source}: {text or 'no words were recognized'}")
    transcript = None if text is None else read_transcript(text, inventory)
    texts = [] if transcript is None else [syllable.text for syllable in transcript.syllables]
    shows_text = suffix in (".svg", ".csv") or can_draw("".join(texts))
    if not shows_text:
        print_message(f"labels show only pinyin: {NO_CHINESE_FONT}")
    with open_progress() as progress:
        with_progress = partial(progress.track, description="timing")
        timed, fits = _time_phones(source, samples, transcript, timing, inventory, with_progress)
        with_progress = partial(progress.track, description="finding the width")
        widths = _find_widths(lips, samples, timed, inventory, with_progress)
    phones = drop_pauses(timed, inventory)
    if not phones:
        print_message(f"{source}: no speech was found; the mouth stays closed")
    mouth = _MouthMotion(
        samples=samples,
        phones=phones,
        syllables=spell_syllables(phones, transcript, inventory),
        key_frames=build_key_frames(phones, load_table(inventory)),
        widths=widths,
        inventory=inventory,
        shows_text=shows_text,
    )
    print_message(f"wrote {output}: {write(output, mouth)}")
    return fits


def _time_phones(
    source: Path,
    samples: Floats,
    transcript: Transcript | None,
    timing: TimingMethod | None,
    inventory: PhoneInventory,
    with_progress: WithProgress,
) -> tuple[list[Phone], bool]:
    """Return the phones, and whether the text fits the audio."""
    if transcript is not None and timing is None:
        is_long = len(transcript.syllables) > MAX_SYLLABLES
        timing = TimingMethod.ALIGN if is_long else TimingMethod.ENDPOINTS
    if transcript is not None and timing is TimingMethod.ENDPOINTS:
        recording = measure_slices(samples, with_progress), transcript.phones, load_table(inventory)
        phones = time_text(*recording)
        ratio = speech_ratio(*recording)
        fits = MIN_SPEECH_RATIO <= ratio <= MAX_SPEECH_RATIO
        if not fits:
            print_mismatch(source, f"the speech is {ratio:.1f} times the text's usual duration")
        return phones, fits
    model = load_model_for_language(inventory.language)
    if transcript is None:
        return recognize_recording(model, samples, with_progress), True
    alignment = align_syllables(model, samples, transcript.phones, with_progress)
    report_mismatch(source, alignment)
    return alignment.phones, alignment.fits


def _find_widths(
    lips: WidthSource,
    samples: Floats,
    timed: Sequence[Phone],
    inventory: PhoneInventory,
    with_progress: WithProgress,
) -> tuple[Doubles, Doubles]:
    """Return times, and the distance of the corners at each, relative to the mouth at rest."""
    if lips is WidthSource.FERGUSON:
        return np.zeros(1), np.ones(1)
    predictor = load_lip_predictor() if lips is WidthSource.LEARNED else None
    recording = analyze_recording(samples, timed, predictor, with_progress=with_progress)
    lip_model = load_lip_model(inventory.language, lips)
    frames = animate_recording(
        recording, lip_model, SynthesizerConfig(lips=lips, expressiveness=1.0), with_progress
    )
    stretch = [faps[_STRETCH].sum() / FAP_UNITS_PER_FAPU for _, faps in frames]
    return np.array([time_s for time_s, _ in frames]), 1.0 + np.array(stretch)


def _key_frame_mouths(mouth: _MouthMotion) -> list[drawing.LabeledMouth]:
    """Return the mouth at each key frame. Closed mouths before and after speech have no phone."""
    syllables = {syllable.onset_s: mouth.label(syllable) for syllable in mouth.syllables}
    anchors = build_anchors(mouth.phones) or [(0.0, mouth.inventory.silence)]
    write = mouth.inventory.write
    middles_s = {phone.onset_s: phone.onset_s + phone.duration_s / 2 for phone in mouth.phones}
    widths = mouth.widths_at([middles_s.get(time_s, time_s) for time_s, _ in anchors])
    return [
        drawing.LabeledMouth(
            time_s,
            float(opening),
            "" if phone == mouth.inventory.silence else write(phone),
            syllables.get(time_s, ""),
            float(width),
        )
        for (time_s, phone), opening, width in zip(
            anchors, mouth.key_frames.openings, widths, strict=True
        )
        if time_s >= 0.0
    ]


def _write_picture(output: Path, mouth: _MouthMotion) -> str:
    is_svg = output.suffix.lower() == ".svg"
    mouths = _key_frame_mouths(mouth)
    if len(mouths) > _MAX_MOUTHS:
        raise UserError(
            f"{output}: a picture can show {_MAX_MOUTHS} mouths, but this recording has"
            f" {len(mouths)}; cut the recording, or write .mp4 or .csv"
        )
    picture = drawing.draw_strip(mouths, _MOUTHS_PER_ROW, _MOUTH_PX)
    if is_svg:
        write_text(output, drawing.to_svg(picture))
    else:
        write_picture(output, drawing.rasterize(picture))
    return f"{plural(len(mouths), 'key frame')}, {plural(len(mouth.phones), 'phone')}"


def _write_video(output: Path, mouth: _MouthMotion) -> str:
    frames = list(zip(*(values.tolist() for values in mouth.sample()), strict=True))
    with (
        VideoWriter(output, *_VIDEO_SIZE_PX, FRAME_RATE_HZ, MEDIA_RATE_HZ) as writer,
        open_progress() as progress,
    ):
        num_sent = 0
        for time_s, opening, width in progress.track(frames, description="drawing"):
            end = round((time_s + 1.0 / FRAME_RATE_HZ) * MEDIA_RATE_HZ)
            writer.write_audio(mouth.samples[num_sent:end])
            num_sent = end
            phone, syllable = item_at(mouth.phones, time_s), item_at(mouth.syllables, time_s)
            moment = drawing.LabeledMouth(
                time_s,
                opening,
                mouth.inventory.write(phone.symbol) if phone else "",
                mouth.label(syllable) if syllable else "",
                width,
            )
            writer.write_image(drawing.rasterize(drawing.draw_image(moment, *_VIDEO_SIZE_PX)))
    return f"{plural(len(frames), 'image')}, {plural(len(mouth.phones), 'phone')}"


def _write_csv(output: Path, mouth: _MouthMotion) -> str:
    times_s, openings, widths = mouth.sample()
    with open_output(output) as file, open_progress() as progress:
        table = csv.writer(codecs.getwriter("utf-8")(file), lineterminator="\n")
        table.writerow(CSV_COLUMNS)
        block_starts = progress.track(range(0, len(times_s), _BLOCK_FRAMES), description="writing")
        for first in block_starts:
            block = slice(first, first + _BLOCK_FRAMES)
            contours = compute_rounded_contour(openings[block], widths[block], NUM_POINTS)
            for time_s, opening, lines in zip(
                times_s[block], openings[block], contours, strict=True
            ):
                time, phone = f"{time_s:.3f}", phone_at(mouth.phones, time_s)
                table.writerows(
                    (time, f"{opening:.4f}", name, number, f"{x:.5f}", f"{y:.5f}", phone)
                    for name, line in zip(LINES, lines, strict=True)
                    for number, (x, y) in enumerate(line)
                )
    return plural(len(times_s), "frame")


_WRITERS: dict[str, Callable[[Path, _MouthMotion], str]] = {
    ".svg": _write_picture,
    ".png": _write_picture,
    ".mp4": _write_video,
    ".csv": _write_csv,
}
