"""Live Ferguson lips: phone shapes at the times of the sound, without jumps."""

from collections.abc import Sequence

import numpy as np
import pytest
from numpy.typing import NDArray

from kouxing.services.live_chain import LiveChain
from kouxing.services.recognizer.acoustic.load import load_model
from kouxing.services.recognizer.front_end.resample import to_16_khz
from kouxing.services.synthesizer.config import SynthesizerConfig
from kouxing.services.synthesizer.face_animator import FaceAnimator
from kouxing.services.synthesizer.lips.ferguson.contour import faps_of
from kouxing.services.synthesizer.lips.ferguson.table import load_table
from kouxing.services.synthesizer.lips.load import load_lip_model
from kouxing.shared.audio_file import read_audio
from kouxing.shared.face.faps import MOUTH_FAPS
from kouxing.shared.phones.events import Phone, Progress, SoundEvent, SpeechChange
from kouxing.shared.phones.inventory import load_inventory
from kouxing.shared.records import replace
from tests.lips import phone
from tests.system import DEMO

LIPS = load_lip_model(name="ferguson")
TABLE = load_table(load_inventory())
LOWER_LIP = 4  # column of FAP 5
WIDEST = float(faps_of([5.0])[0, MOUTH_FAPS.index(5)])
DELAY_S = 0.16


def progress(start_s: float, end_s: float, *, loud: bool) -> list[SoundEvent]:
    return [
        Progress(time_s=round(number * 0.02, 2), level_db=-20.0 if loud else -70.0)
        for number in range(round(start_s / 0.02) + 1, round(end_s / 0.02) + 1)
    ]


def openings(events: Sequence[SoundEvent], face: FaceAnimator | None = None) -> NDArray[np.float64]:
    """Return R of the frames at 50 Hz."""
    face = face or FaceAnimator(LIPS, frame_rate_hz=50.0, delay_s=DELAY_S)
    frames = [faps for event in events for _, faps in face.process(event)]
    return 5.0 * np.array(frames, dtype=np.float64)[:, LOWER_LIP] / WIDEST


SAID: list[SoundEvent] = [
    *progress(0.0, 0.5, loud=False),
    SpeechChange(active=True, time_s=0.5),
    *progress(0.5, 0.6, loud=True),
    phone(0, "m", 0.5, 0.1),
    *progress(0.6, 0.7, loud=True),
    phone(1, "a", 0.6, 0.4),
    *progress(0.7, 1.0, loud=True),
    *progress(1.0, 2.0, loud=False),
]


def test_openings_of_phones_and_rest_in_silence() -> None:
    made = openings(SAID)
    assert made[:15].max() == 0.0
    assert made[25] == pytest.approx(TABLE.opening["m"], abs=0.7)
    assert made[31] == pytest.approx(TABLE.opening["a"], abs=0.7)
    assert np.argmax(made) < 36
    assert made[60:].max() < 0.05  # energy shows the end long before voice activity does


def test_no_jump_at_revisions_and_interruptions() -> None:
    phones = [event for event in SAID if isinstance(event, Phone)]
    made = openings([*SAID[:-60], phones[0], replace(phones[1], symbol="u")])
    assert np.abs(np.diff(made)).max() < 2.0
    face = FaceAnimator(LIPS, frame_rate_hz=50.0, delay_s=DELAY_S)
    before = openings(SAID[:42], face)
    assert before[-1] > 2.0
    face.flush()
    after = openings(progress(0.74, 1.2, loud=False), face)
    assert np.abs(np.diff([before[-1], *after])).max() < 2.0
    assert after[8:].max() < 0.05


def test_lips_stay_within_their_travel_at_any_chunk_size() -> None:
    samples = to_16_khz(*read_audio(DEMO / "hello-female.wav"))[:32_000]
    settings = SynthesizerConfig(
        lips="ferguson", idle_motion_seed=0, expressiveness=1.0, feeling=0.0
    )
    made = []
    for chunk in (32_000, 333):
        chain = LiveChain(load_model(), LIPS, synthesizer=settings)
        frames = []
        for begin in range(0, len(samples), chunk):
            frames += chain.accept_waveform(samples[begin : begin + chunk])
        made.append(np.array([faps for _, faps in frames + chain.input_finished()]))
    np.testing.assert_array_equal(made[0], made[1])
    opening = 5.0 * made[0][:, LOWER_LIP] / WIDEST
    assert opening.min() >= 0.0
    assert 2.5 < opening.max() <= 5.0
