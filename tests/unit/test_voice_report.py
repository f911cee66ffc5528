"""Shares of time with voice activity, and the sounds that they are measured with."""

from pathlib import Path

import numpy as np
import pytest
import soundfile
from numpy.typing import NDArray

from kouxing.corpora.sounds import Sound, read_sounds
from kouxing.corpora.speech_corpus import Utterance
from kouxing.evaluation.recognizer import voice_activity
from kouxing.evaluation.recognizer.aligned_corpus import AlignedRecording
from kouxing.evaluation.recognizer.disturbances import add_sound, held_out_music
from kouxing.evaluation.recognizer.synthetic_sounds import held_vowels, varying_noise
from kouxing.evaluation.recognizer.voice_activity import evaluate_voice, labeled_audio, voice_states
from kouxing.evaluation.report.recognition_table import voice_table
from kouxing.services.recognizer.acoustic.load import load_model
from kouxing.shared.errors import UserError
from tests.corpora import RATE_HZ, write_manifest
from tests.lips import phone
from tests.system import VOWELS_FILE

PER_S = 50  # slices


@pytest.fixture
def sounds(tmp_path: Path) -> list[Sound]:
    """Return two pieces of music, of which the loud one is held out, and laughter."""
    rows = []
    for name, kind, level in (("a", "music", 0.5), ("b", "music", 0.1), ("ha", "laughter", 0.2)):
        soundfile.write(tmp_path / f"{name}.flac", np.full(RATE_HZ, level), RATE_HZ)
        rows.append(f"{name}.flac\t{kind}\tCC0")
    write_manifest(tmp_path, "path kind license", rows)
    return read_sounds([tmp_path], any_license=False)


@pytest.mark.slow
def test_voice_activity_follows_the_speech_of_the_live_recognizer() -> None:
    model = load_model("gmm")
    vowels, _ = soundfile.read(VOWELS_FILE, dtype="float32")
    silence = np.zeros(RATE_HZ, np.float32)
    speech = vowels[7_000:][:RATE_HZ]  # the first vowel starts here
    states = voice_states(model, np.concatenate([silence, speech, silence]))
    before, during, after = states[:, 0].reshape(3, PER_S)
    assert not states[:, 1:].any()  # no laughter or breath
    assert not before.any()
    assert during.mean() > 0.5
    assert not after[-PER_S // 4 :].any()


def test_measures_parts_with_and_without_a_voice(monkeypatch: pytest.MonkeyPatch) -> None:
    def first_half(_: object, samples: NDArray[np.float32]) -> NDArray[np.bool_]:
        first = np.arange(len(samples)) < len(samples) / 2
        return np.stack([first, ~first, first & ~first], axis=1)

    monkeypatch.setattr(voice_activity, "voice_states", first_half)
    masks = np.array([[True, True, True, False], [True, False, False, False]])
    pieces = [(np.zeros(4, np.float32), mask) for mask in masks]
    voiced = (np.zeros(2, np.float32), np.full(2, True))
    materials = [("mixed", pieces), ("voice", [voiced])]
    results = evaluate_voice(load_model("gmm"), materials)
    shares = results["mixed"]
    assert shares["seconds"] == {"voice": pytest.approx(0.08), "no_voice": pytest.approx(0.08)}
    assert shares["on"] == {"voice": 0.75, "no_voice": 0.25}
    assert (shares["laughter"], shares["breath"]) == (0.5, 0.0)
    assert results["voice"]["on"]["no_voice"] is None
    assert voice_table(results).rows[1] == ["voice", "0", "50.0", "-", "50.0", "0.0"]


def test_materials_have_a_voice_where_the_text_has_phones(
    sounds: list[Sound], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(voice_activity, "_SYNTHETIC_S", 1.0)
    vowels = Utterance(utterance_id="vowels", path=VOWELS_FILE)
    reference = AlignedRecording(vowels, [phone(0, "a", 0.2, 0.4)])
    materials = labeled_audio([reference], {"clean": np.copy}, varying_noise(1.0), sounds)
    by_kind = dict(materials)
    ((_, mask),) = by_kind["speech, clean"]
    assert np.flatnonzero(mask).tolist() == list(range(110, 130))  # after 2 s
    assert [len(mask) for _, mask in by_kind["laughter"]] == [PER_S / 2]  # the second half
    assert len(by_kind["music"]) == 1
    assert "breath" not in by_kind  # not in the folder
    assert all(mask.all() for _, mask in by_kind["held vowels"])
    assert not any(mask.any() for _, mask in by_kind["keyboard"])


def test_music_is_held_out_and_10_db_below_the_speech(sounds: list[Sound]) -> None:
    music = held_out_music(sounds)
    assert len(music) == RATE_HZ
    speech = held_vowels()[0]
    power = np.mean((add_sound(speech, music, 10.0) - speech) ** 2) / np.mean(speech**2)
    assert 10 * np.log10(power) == pytest.approx(-10, abs=0.1)
    with pytest.raises(UserError, match="the sounds contain no held-out music"):
        held_out_music([sound for sound in sounds if not sound.is_held_out])


@pytest.mark.parametrize(
    ("rows", "problem"),
    [
        ([], "has no rows"),
        (["a.flac\t"], "lacks the column license"),
        (["short row"], "this is a folder; expected a file"),
    ],
)
def test_reports_an_unusable_list_of_sounds(tmp_path: Path, rows: list[str], problem: str) -> None:
    write_manifest(tmp_path, "path kind" if "license" in problem else "kind license path", rows)
    with pytest.raises(UserError, match=problem):
        read_sounds([tmp_path], any_license=True)
