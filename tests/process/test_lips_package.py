"""The package ``kouxing-lips`` has the same faces and phones as the server."""

import difflib
import json
import subprocess
from collections.abc import Iterator, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import soxr

from kouxing.evaluation.system.lips_package import exported_models, package_faps, server_events
from kouxing.services.recognizer.front_end.resample import to_16_khz
from kouxing.services.synthesizer.face_animator import FaceAnimator
from kouxing.services.synthesizer.lips.load import load_lip_model
from kouxing.shared.face.shapes import SHAPE_SETS
from kouxing.shared.phones.events import LipPositions, Phone, Progress, SoundEvent, SpeechChange
from tests.lips_package import (
    DELAY_S,
    FRAME_RATE_HZ,
    RATE_HZ,
    Frames,
    closure_at_the_end_of_speech,
    faps_of,
    package_output,
    server_faps,
)
from tests.system import DEMO, HELLO, NODE, ROOT, VOWELS_FILE, samples_of_file

SCRIPTS = ROOT / "clients" / "kouxing-lips" / "tests"
HEAD_TURN = slice(47, 50)  # FAPs 48 to 50
FILES = [
    *(DEMO / f"{name}.wav" for name in ("bilabials-female", "lake-male", "fast-female")),
    VOWELS_FILE,
]


@pytest.fixture(scope="module")
def models() -> Iterator[Path]:
    with exported_models() as folder:
        yield folder


@cache
def output_of(models: Path, file: Path) -> dict[str, Any]:
    return package_output(models, samples_of_file(file))


def opening(faps: Frames) -> Frames:
    return -(faps[:, 3] + faps[:, 4])


def assert_equal(ours: Frames, theirs: Frames) -> None:
    """Rounding to 8 bits amplifies differences in the last digit, so a few frames may differ."""
    assert ours.shape == theirs.shape
    difference = np.abs(ours - theirs)
    difference[:, HEAD_TURN] /= 100  # in 1e-5 radians; a hundredth of a degree is not visible
    assert difference.mean() < 0.3
    assert np.percentile(difference.max(axis=1), 90) < 3
    assert np.corrcoef(opening(ours), opening(theirs))[0, 1] > 0.999


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_frames_and_first_phones_equal_the_servers(models: Path, file: Path) -> None:
    check_frames_and_phones(output_of(models, file), server_events(samples_of_file(file)))


def test_frames_and_final_phones_equal_the_servers(models: Path) -> None:
    # The package's block network is slow; it uses the last 2.5 s.
    samples = samples_of_file(DEMO / "hello-male.wav")[: 3 * RATE_HZ]
    output = package_output(models, samples, phones="final")
    check_frames_and_phones(output, server_events(samples, "blocks"))


def check_frames_and_phones(output: dict[str, Any], events: Sequence[SoundEvent]) -> None:
    assert_equal(package_faps(output), server_faps(events))
    ours = [p for p in output["phones"] if p["isFinal"] and p["durationS"] > 0]
    theirs = [e for e in events if isinstance(e, Phone) and e.final and e.duration_s > 0]
    different = edit_distance([p["symbol"] for p in ours], [phone.symbol for phone in theirs])
    assert different <= 1  # rounding can decide between two phones
    if different == 0:
        onsets_s = [p["onsetS"] for p in ours]
        assert onsets_s == pytest.approx([phone.onset_s for phone in theirs], abs=0.05)


def edit_distance(ours: list[str], theirs: list[str]) -> int:
    matcher = difflib.SequenceMatcher(a=ours, b=theirs, autojunk=False)
    return max(len(ours), len(theirs)) - sum(block.size for block in matcher.get_matching_blocks())


def test_pauses_and_loud_and_quiet_speech(models: Path) -> None:
    speech, other = (
        samples_of_file(DEMO / f"{name}.wav")[: round(1.5 * RATE_HZ)]
        for name in ("lake-male", "fast-female")
    )
    samples = np.concatenate([np.zeros(7001, np.float32), 0.1 * speech, np.zeros(20_000), other])
    assert_equal(faps_of(models, samples), server_faps(server_events(samples.astype(np.float32))))


def test_without_phones_only_the_sound_closes_the_lips(models: Path) -> None:
    samples = samples_of_file(DEMO / "bilabials-female.wav")
    without = [event for event in server_events(samples) if not isinstance(event, Phone)]
    assert_equal(faps_of(models, samples, phones=False), server_faps(without))


@pytest.mark.parametrize("rate_hz", [8_000, 47_999, 48_000])
def test_resampling_equals_the_servers(models: Path, rate_hz: int) -> None:
    samples = samples_of_file(DEMO / "hello-female.wav")[: 2 * RATE_HZ]
    resampled = soxr.resample(samples, RATE_HZ, rate_hz)
    ours = faps_of(models, resampled, sampleRateHz=rate_hz)
    assert_equal(ours, server_faps(server_events(to_16_khz(resampled, rate_hz))))


def test_any_chunks_give_the_same_frames(models: Path) -> None:
    assert np.array_equal(
        package_faps(output_of(models, VOWELS_FILE)),
        faps_of(models, samples_of_file(VOWELS_FILE), chunk=97),
    )


def test_weights_equal_the_servers(models: Path) -> None:
    output = output_of(models, DEMO / "bilabials-female.wav")
    for name, shapes in SHAPE_SETS.items():
        assert output["names"][name] == list(shapes.names)
        for frame in output["frames"]:
            expected = shapes.weights(np.array(frame["faps"], np.float32))
            np.testing.assert_allclose(frame[name], expected, atol=1e-4)


def server_faps_of_events(events: Sequence[SoundEvent]) -> Frames:
    face = FaceAnimator(load_lip_model(), frame_rate_hz=FRAME_RATE_HZ, delay_s=DELAY_S)
    return np.array([faps for event in events for _, faps in face.process(event)])


def package_faps_of_events(models: Path, events: Sequence[SoundEvent]) -> Frames:
    printed = subprocess.run(
        [NODE, SCRIPTS / "face.mjs", models, str(DELAY_S)],
        input=json.dumps([*map(plain_event, events)]).encode(),
        capture_output=True,
        check=True,
        timeout=120,
    )
    return np.array(json.loads(printed.stdout), np.float32)


def plain_event(event: SoundEvent) -> dict[str, Any]:
    """Return an event as the package's objects, except phones and expressions."""
    match event:
        case LipPositions(time_s=time_s, delay_s=delay_s, faps=faps, closure=closure):
            values = {"delayS": delay_s, "faps": faps.tolist(), "closure": closure}
            return {"type": "lips", "timeS": time_s, **values}
        case SpeechChange(time_s=time_s, active=active):
            return {"type": "speech", "timeS": time_s, "active": active}
        case Progress(time_s=time_s, level_db=level_db, is_laughter=is_laughter):
            values = {"levelDb": level_db, "isLaughter": is_laughter}
            return {"type": "progress", "timeS": time_s, **values}
    raise AssertionError(event)


def test_lips_do_not_pass_through_each_other_at_the_end_of_speech(models: Path) -> None:
    events = closure_at_the_end_of_speech()
    ours, theirs = package_faps_of_events(models, events), server_faps_of_events(events)
    assert (opening(theirs) >= 0).all()
    np.testing.assert_allclose(ours, theirs, atol=0.1)


def test_laughter_follows_its_notes_as_on_the_server(models: Path) -> None:
    levels_db = [-50.0] * 10 + [-20.0, -15.0, -25.0, -45.0, -50.0] * 5 + [-60.0] * 30
    events = [
        Progress(
            time_s=(number + 1) / FRAME_RATE_HZ, level_db=level_db, is_laughter=10 <= number < 35
        )
        for number, level_db in enumerate(levels_db)
    ]
    theirs = server_faps_of_events(events)
    ours = package_faps_of_events(models, events)
    assert np.ptp(opening(theirs)) > 300  # the mouth opens at the notes
    np.testing.assert_allclose(ours, theirs, atol=0.1)


def test_voice_state_follows_the_speech(models: Path) -> None:
    samples = np.concatenate([np.zeros(RATE_HZ, np.float32), HELLO])
    speaking = [frame["isSpeaking"] for frame in package_output(models, samples)["frames"]]
    assert not any(speaking[:45])
    assert any(speaking[60:])
    for file in FILES:
        assert not any(frame["isLaughing"] for frame in output_of(models, file)["frames"])
