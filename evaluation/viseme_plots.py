"""Pictures of the dynamic visemes: faces, dominance curves, and a sentence's curves.

After Li et al. 2011, fig. 4 (a viseme between the two silences: control functions above, the
parameter below), fig. 5 and 6 (the same for several visemes, made live pair by pair), and Wang &
Cai 2003, fig. 2 (pauses of several lengths).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evaluation.figures import new_figure, save_figure
from evaluation.lips import DEFAULT_LOOK_AHEAD_S, FRAME_RATE_HZ, hear, live_frames
from services.driver.head import Head
from services.driver.render import Camera, Renderer
from services.offline import mono_16k
from services.recognizer.load import load_model
from services.recognizer.pipeline import recognize
from services.synthesizer.blending import around, blend, log_weights, softmax
from services.synthesizer.full import synthesize
from services.synthesizer.live import FapFrame, LiveSynthesizer
from services.synthesizer.parameters import VisemeParameters, load_parameters
from services.synthesizer.timeline import Timeline, build_timeline
from services.synthesizer.visemes import MOUTH_FAPS, REST, SHAPES, VISEMES
from shared.errors import UserError
from shared.faps import FAPS, NUM_FAPS
from shared.phones import SILENCE, Phone, SpeechChange
from training.lip_clips import SAMPLE_RATE_HZ, level_track

Array = NDArray[np.float64]

_FACE_WIDTH_PX, _FACE_HEIGHT_PX = 190, 230
# From the front, nose to chin: from the side the hollow of the cheek shows at one corner alone.
_FACE_CAMERA = Camera(
    position=(0.0, -0.023, 0.62), target=(0.0, -0.031, 0.0), field_of_view_deg=9.8
)
_FACES_A_ROW = 9
_SHOWN_FAPS = (3, 4, 5, 6, 17)  # jaw, both lips, a corner, protrusion
_CURVE_RATE_HZ = 200.0
_JAW = MOUTH_FAPS.index(3)
_SYLLABLE = (("sil", 0.30), ("a", 0.30), ("sil", 0.30))
_WORD = (("sil", 0.25), ("n", 0.08), ("i", 0.14), ("m", 0.08), ("en", 0.20), ("sil", 0.30))


def plot_visemes(folder: Path, audio: Path, parameters_file: Path | None) -> list[Path]:
    """Write the pictures of the visemes and of a sentence into a folder; return their files.

    Raises
    ------
    UserError
        If the sound cannot be read or the pictures cannot be written.
    """
    parameters = load_parameters(parameters_file)
    samples = mono_16k(audio)
    pictures: dict[str, Callable[[], Any]] = {
        "faces.png": lambda: faces_figure(parameters),
        "dominance.png": lambda: dominance_figure(parameters),
        "sentence.png": lambda: sentence_figure(parameters, samples),
    }
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"{folder}: cannot be made: {error.strerror}") from None
    for name, draw in pictures.items():
        save_figure(draw(), folder / name)
    return [folder / name for name in pictures]


def spoken(units: Sequence[tuple[str, float]]) -> list[Phone]:
    """Phones one after the other from units and durations in seconds; ``sil`` is a hole."""
    phones: list[Phone] = []
    onset_s = 0.0
    for unit, duration_s in units:
        if unit != SILENCE:
            phones.append(
                Phone(
                    index=len(phones),
                    unit=unit,
                    onset_s=onset_s,
                    duration_s=duration_s,
                    confidence=1.0,
                    final=True,
                )
            )
        onset_s += duration_s
    return phones


def faces_figure(parameters: VisemeParameters) -> Any:
    """Draw a face for every viseme, at its static targets, with the units that have it."""
    renderer = Renderer(Head.load(), _FACE_WIDTH_PX, _FACE_HEIGHT_PX, camera=_FACE_CAMERA)
    num_rows = -(-len(VISEMES) // _FACES_A_ROW)
    figure = new_figure(1.6 * _FACES_A_ROW, 2.35 * num_rows)
    axes = figure.subplots(num_rows, _FACES_A_ROW).ravel()
    for place, (axis, viseme) in enumerate(zip(axes, VISEMES, strict=False)):
        faps = np.zeros(NUM_FAPS, dtype=np.float32)
        faps[np.array(MOUTH_FAPS) - 1] = parameters.target[place]
        axis.imshow(renderer.draw(faps))
        axis.set_title(_title(viseme), fontsize=9)
    for axis in axes:
        axis.set_axis_off()
    renderer.close()
    return figure


def _title(viseme: str) -> str:
    group, _, variant = viseme.partition("_")
    if viseme == REST:
        return "rest"
    units = [unit for unit, shapes in SHAPES.items() if shapes == ((group, 1.0),)]
    return " ".join(units) + ("\nbefore a rounded final" if variant else "\n")


def dominance_figure(parameters: VisemeParameters) -> Any:
    """Draw dominances and the curve they make: one vowel, a word, and the word live."""
    figure = new_figure(14.0, 7.0)
    axes = figure.subplots(2, 3, sharex="col", sharey="row")
    for column, (units, is_live, title) in enumerate(
        (
            (_SYLLABLE, False, "a vowel between silences (Li 2011, fig. 4)"),
            (_WORD, False, "a word, all visemes at once (Wang & Cai 2003)"),
            (_WORD, True, "the same live, pair by pair, look-ahead 0 (Li 2011, fig. 5, 6)"),
        )
    ):
        upper, lower = axes[:, column]
        phones = spoken(units)
        length_s = sum(duration_s for _, duration_s in units)
        time_s = np.arange(0.0, length_s, 1.0 / _CURVE_RATE_HZ)
        timeline = build_timeline(phones)
        full = blend(parameters, timeline, time_s)[:, _JAW]
        _draw_weights(upper, parameters, timeline, time_s, pairs=is_live)
        if is_live:
            lower.plot(time_s, full, color="0.6", label="full model")
            full = np.interp(time_s, *_live_curve(parameters, phones, length_s))
        lower.plot(time_s, full, color="black", label="live" if is_live else "full model")
        for row, viseme in enumerate(timeline.viseme):
            centre_s = (timeline.centre_start_s[row] + timeline.centre_end_s[row]) / 2.0
            lower.plot(centre_s, parameters.target[viseme, _JAW], "o", color=f"C{row}")
        for phone in phones:
            lower.axvline(phone.onset_s, color="0.85", zorder=0)
            lower.text(phone.onset_s + 0.005, -12.0, phone.unit, color="0.4")
        upper.set_title(title, fontsize=10)
        lower.legend(fontsize=8, loc="upper right")
        lower.set_xlabel("s")
    axes[0, 0].set_ylabel("share of the dominance, jaw")
    axes[1, 0].set_ylabel("open_jaw, FAP units (dots: targets)")
    return figure


def _draw_weights(
    axis: Any, parameters: VisemeParameters, timeline: Timeline, time_s: Array, *, pairs: bool
) -> None:
    """Draw shares of visemes and silence; in pairs, only of those that Li 2011, eq. 11 takes."""
    log_shares = log_weights(parameters, timeline, time_s)[:, :, _JAW]
    num_visemes = len(timeline.viseme)
    if pairs:
        acting = np.array([around(timeline, float(now_s), 0.0) for now_s in time_s]).T
        log_shares[:num_visemes][~acting] = -np.inf
    shares = softmax(log_shares)
    for row, viseme in enumerate(timeline.viseme):
        axis.plot(time_s, shares[row], label=VISEMES[viseme], color=f"C{row}")
    silence = shares[num_visemes:].sum(axis=0)
    axis.plot(time_s, silence, color="0.5", linestyle="--", label="silence")
    axis.legend(fontsize=8, loc="center right")


def _live_curve(
    parameters: VisemeParameters, phones: Sequence[Phone], length_s: float
) -> tuple[Array, Array]:
    """Return times and jaw of the live model, told of each unit when it begins."""
    live = LiveSynthesizer(parameters, frame_rate_hz=_CURVE_RATE_HZ, look_ahead_s=0.0)
    frames: list[FapFrame] = []
    for phone in phones:
        frames += live.advance(phone.onset_s)
        live.accept_phone(phone)
    end_s = phones[-1].onset_s + phones[-1].duration_s
    frames += live.advance(end_s)
    live.accept_speech(SpeechChange(active=False, time_s=end_s))
    frames += live.advance(length_s)
    return np.array([time_s for time_s, _ in frames]), np.array([faps[2] for _, faps in frames])


def sentence_figure(parameters: VisemeParameters, samples: NDArray[np.float32]) -> Any:
    """Draw FAP curves of a sentence under its waveform and phones, full model and live."""
    model = load_model()
    phones = recognize(model, samples, SAMPLE_RATE_HZ)
    live = live_frames(parameters, hear(model, samples), DEFAULT_LOOK_AHEAD_S)
    live_s = np.arange(len(live)) / FRAME_RATE_HZ
    num_frames = int(len(samples) / SAMPLE_RATE_HZ * _CURVE_RATE_HZ) + 1
    full = synthesize(parameters, phones, num_frames, _CURVE_RATE_HZ, level_track(samples))
    time_s = np.arange(num_frames) / _CURVE_RATE_HZ
    figure = new_figure(14.0, 7.5)
    sound, *curves = figure.subplots(
        1 + len(_SHOWN_FAPS), 1, sharex=True, height_ratios=(1.5, *([1.0] * len(_SHOWN_FAPS)))
    )
    draw_sound(sound, samples, phones)
    for axis, fap in zip(curves, _SHOWN_FAPS, strict=True):
        axis.plot(time_s, full[:, fap - 1], color="0.6", label="full model")
        axis.plot(live_s, live[:, fap - 1], color="black", linewidth=1.0, label="live")
        axis.set_ylabel(f"{fap}\n{FAPS[fap - 1].name}", fontsize=7)
        for phone in phones:
            axis.axvline(phone.onset_s, color="0.9", zorder=0)
    curves[0].legend(fontsize=8, loc="upper right")
    curves[-1].set_xlim(0.0, num_frames / _CURVE_RATE_HZ)
    curves[-1].set_xlabel("s (FAP units; each FAP number with its name)")
    return figure


def draw_sound(
    axis: Any, samples: NDArray[np.float32], phones: Sequence[Phone], start_s: float = 0.0
) -> None:
    """Draw a waveform that begins at ``start_s``, with its units above."""
    time_s = start_s + np.arange(len(samples)) / SAMPLE_RATE_HZ
    axis.plot(time_s, samples, color="0.6", linewidth=0.3)
    top = 1.1 * float(np.abs(samples).max(initial=1e-3))
    for number, phone in enumerate(phones):
        axis.axvline(phone.onset_s, color="0.9", zorder=0)
        if phone.unit != SILENCE:
            # two heights, so that short units do not overlap
            axis.text(phone.onset_s, top * (1.0 + 0.25 * (number % 2)), phone.unit, fontsize=8)
    axis.set_ylim(-top, 1.5 * top)
    axis.set_yticks([])
