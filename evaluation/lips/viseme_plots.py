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

from kouxing.corpora.figures import new_figure, save_figure
from kouxing.corpora.lip_clips import SAMPLE_RATE_HZ
from kouxing.evaluation.lips.schemes import DEFAULT_DELAY_S, FRAME_RATE_HZ, live_frames
from kouxing.services.cli.sound_file import read_mono_16k
from kouxing.services.driver.head.head import Head
from kouxing.services.driver.render.camera import Camera
from kouxing.services.driver.render.renderer import Renderer
from kouxing.services.live_chain import sound_events
from kouxing.services.mouth_profiles.lip_tracks import level_track
from kouxing.services.recognizer.acoustic.acoustic_model import AcousticModel
from kouxing.services.recognizer.acoustic.load import load_live_model
from kouxing.services.recognizer.offline import recognize
from kouxing.services.recognizer.stream import SILENT_DB
from kouxing.services.synthesizer.lips.dynamic_visemes.blending import (
    active_visemes,
    blend,
    log_weights,
    softmax,
)
from kouxing.services.synthesizer.lips.dynamic_visemes.model import DynamicVisemes
from kouxing.services.synthesizer.lips.dynamic_visemes.parameters import load_parameters
from kouxing.services.synthesizer.lips.dynamic_visemes.timeline import Timeline, build_timeline
from kouxing.services.synthesizer.lips.dynamic_visemes.visemes import REST, VISEMES
from kouxing.services.synthesizer.offline import synthesize
from kouxing.shared.errors import UserError
from kouxing.shared.face.faps import FAPS, MOUTH_FAPS, NUM_FAPS
from kouxing.shared.phones.events import EndOfSound, Phone, Progress, SoundEvent
from kouxing.shared.phones.inventory import PhoneInventory

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
    model = load_live_model()
    lips = DynamicVisemes(load_parameters(parameters_file), model.inventory)
    samples = read_mono_16k(audio)
    pictures: dict[str, Callable[[], Any]] = {
        "faces.png": lambda: faces_figure(lips),
        "dominance.png": lambda: dominance_figure(lips),
        "sentence.png": lambda: sentence_figure(lips, model, samples),
    }
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"{folder}: cannot be made: {error.strerror}") from None
    for name, draw in pictures.items():
        save_figure(draw(), folder / name)
    return [folder / name for name in pictures]


def spoken(symbols: Sequence[tuple[str, float]], inventory: PhoneInventory) -> list[Phone]:
    """Phones one after the other from symbols and durations in seconds; silence is a hole."""
    phones: list[Phone] = []
    onset_s = 0.0
    for symbol, duration_s in symbols:
        if symbol != inventory.silence:
            phones.append(
                Phone(
                    index=len(phones),
                    symbol=symbol,
                    onset_s=onset_s,
                    duration_s=duration_s,
                    confidence=1.0,
                    final=True,
                )
            )
        onset_s += duration_s
    return phones


def faces_figure(lips: DynamicVisemes) -> Any:
    """Draw a face for every viseme, at its static targets, with the phones that have it."""
    renderer = Renderer(Head.load(), _FACE_WIDTH_PX, _FACE_HEIGHT_PX, camera=_FACE_CAMERA)
    num_rows = -(-len(VISEMES) // _FACES_A_ROW)
    figure = new_figure(1.6 * _FACES_A_ROW, 2.35 * num_rows)
    axes = figure.subplots(num_rows, _FACES_A_ROW).ravel()
    for place, (axis, viseme) in enumerate(zip(axes, VISEMES, strict=False)):
        faps = np.zeros(NUM_FAPS, dtype=np.float32)
        faps[np.array(MOUTH_FAPS) - 1] = lips.parameters.target[place]
        axis.imshow(renderer.draw(faps))
        axis.set_title(_title(viseme, lips.inventory), fontsize=9)
    for axis in axes:
        axis.set_axis_off()
    renderer.close()
    return figure


def _title(viseme: str, inventory: PhoneInventory) -> str:
    group, _, variant = viseme.partition("_")
    if viseme == REST:
        return "rest"
    phones = [phone for phone, shares in inventory.visemes.items() if shares == ((group, 1.0),)]
    return " ".join(phones) + ("\nbefore a rounded final" if variant else "\n")


def dominance_figure(lips: DynamicVisemes) -> Any:
    """Draw dominances and the curve they make: one vowel, a word, and the word live."""
    parameters = lips.parameters
    figure = new_figure(14.0, 7.0)
    axes = figure.subplots(2, 3, sharex="col", sharey="row")
    for column, (symbols, is_live, title) in enumerate(
        (
            (_SYLLABLE, False, "a vowel between silences (Li 2011, fig. 4)"),
            (_WORD, False, "a word, all visemes at once (Wang & Cai 2003)"),
            (_WORD, True, "the same live, pair by pair, without delay (Li 2011, fig. 5, 6)"),
        )
    ):
        upper, lower = axes[:, column]
        phones = spoken(symbols, lips.inventory)
        length_s = sum(duration_s for _, duration_s in symbols)
        time_s = np.arange(0.0, length_s, 1.0 / _CURVE_RATE_HZ)
        timeline = build_timeline(phones, lips.inventory)
        full = blend(parameters, timeline, time_s)[:, _JAW]
        _draw_weights(upper, lips, timeline, time_s, pairs=is_live)
        if is_live:
            lower.plot(time_s, full, color="0.6", label="full model")
            full = np.interp(time_s, *_live_curve(lips, phones))
        lower.plot(time_s, full, color="black", label="live" if is_live else "full model")
        for row, viseme in enumerate(timeline.viseme):
            apex_s = (timeline.apex_start_s[row] + timeline.apex_end_s[row]) / 2.0
            lower.plot(apex_s, parameters.target[viseme, _JAW], "o", color=f"C{row}")
        for phone in phones:
            lower.axvline(phone.onset_s, color="0.85", zorder=0)
            lower.text(phone.onset_s + 0.005, -12.0, phone.symbol, color="0.4")
        upper.set_title(title, fontsize=10)
        lower.legend(fontsize=8, loc="upper right")
        lower.set_xlabel("s")
    axes[0, 0].set_ylabel("share of the dominance, jaw")
    axes[1, 0].set_ylabel("open_jaw, FAP units (dots: targets)")
    return figure


def _draw_weights(
    axis: Any, lips: DynamicVisemes, timeline: Timeline, time_s: Array, *, pairs: bool
) -> None:
    """Draw shares of visemes and silence; in pairs, only of those that Li 2011, eq. 11 takes."""
    log_shares = log_weights(lips.parameters, timeline, time_s)[:, :, _JAW]
    num_visemes = len(timeline.viseme)
    if pairs:
        acting = np.array([active_visemes(timeline, float(now_s), 0.0) for now_s in time_s]).T
        log_shares[:num_visemes][~acting] = -np.inf
    shares = softmax(log_shares)
    for row, viseme in enumerate(timeline.viseme):
        axis.plot(time_s, shares[row], label=VISEMES[viseme], color=f"C{row}")
    silence = shares[num_visemes:].sum(axis=0)
    axis.plot(time_s, silence, color="0.5", linestyle="--", label="silence")
    axis.legend(fontsize=8, loc="center right")


def _live_curve(lips: DynamicVisemes, phones: Sequence[Phone]) -> tuple[Array, Array]:
    """Return times and jaw of the live model, told of each phone when it begins."""
    events: list[SoundEvent] = []
    for phone in phones:
        events += [Progress(time_s=phone.onset_s, level_db=SILENT_DB), phone]
    end_s = phones[-1].onset_s + phones[-1].duration_s
    events += [Progress(time_s=end_s, level_db=SILENT_DB), EndOfSound(time_s=end_s)]
    frames = live_frames(lips, events, 0.0, _CURVE_RATE_HZ)
    time_s = np.arange(len(frames)) / _CURVE_RATE_HZ
    return time_s, frames[:, 2]


def sentence_figure(
    lips: DynamicVisemes, model: AcousticModel, samples: NDArray[np.float32]
) -> Any:
    """Draw FAP curves of a sentence under its waveform and phones, full model and live."""
    phones = recognize(model, samples, SAMPLE_RATE_HZ)
    live = live_frames(lips, sound_events(model, samples), DEFAULT_DELAY_S, FRAME_RATE_HZ)
    live_s = np.arange(len(live)) / FRAME_RATE_HZ
    num_frames = int(len(samples) / SAMPLE_RATE_HZ * _CURVE_RATE_HZ) + 1
    full = synthesize(lips, phones, num_frames, _CURVE_RATE_HZ, level_track(samples))
    time_s = np.arange(num_frames) / _CURVE_RATE_HZ
    figure = new_figure(14.0, 7.5)
    sound, *curves = figure.subplots(
        1 + len(_SHOWN_FAPS), 1, sharex=True, height_ratios=(1.5, *([1.0] * len(_SHOWN_FAPS)))
    )
    draw_sound(sound, samples, phones, lips.inventory.silence)
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
    axis: Any,
    samples: NDArray[np.float32],
    phones: Sequence[Phone],
    silence: str,
    start_s: float = 0.0,
) -> None:
    """Draw a waveform that begins at ``start_s``, with its phones above."""
    time_s = start_s + np.arange(len(samples)) / SAMPLE_RATE_HZ
    axis.plot(time_s, samples, color="0.6", linewidth=0.3)
    top = 1.1 * float(np.abs(samples).max(initial=1e-3))
    for number, phone in enumerate(phones):
        axis.axvline(phone.onset_s, color="0.9", zorder=0)
        if phone.symbol != silence:
            # two heights, so that short phones do not overlap
            axis.text(phone.onset_s, top * (1.0 + 0.25 * (number % 2)), phone.symbol, fontsize=8)
    axis.set_ylim(-top, 1.5 * top)
    axis.set_yticks([])
