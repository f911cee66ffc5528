"""Other lip sync on made-up sounds, and the linear map from its outputs to a mouth."""

from dataclasses import replace
from io import StringIO
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from rich.console import Console

from kouxing.corpora.lip_clips import SAMPLE_RATE_HZ, LipClip, label_clip
from kouxing.evaluation.lips.clip_scores import score_clip
from kouxing.evaluation.lips.report import print_comparison
from kouxing.evaluation.lips.rivals import rows as rivals_rows
from kouxing.evaluation.lips.rivals.comparison import as_it_comes, figure, mapped
from kouxing.evaluation.lips.rivals.linear_map import fit
from kouxing.evaluation.lips.rivals.rows import (
    HEAD_AUDIO_VISEMES,
    ROW_S,
    head_audio_rows,
    loudness_rows,
    wlipsync_profile,
    wlipsync_rows,
)
from kouxing.evaluation.lips.schemes import DELAYS_S, HeardClip
from kouxing.evaluation.lips.scores import pool
from kouxing.services.mouth_profiles.lip_tracks import level_track
from kouxing.services.recognizer.acoustic.load import load_model
from kouxing.shared.audio_file import read_audio
from kouxing.shared.errors import UserError
from kouxing.shared.face.faps import MOUTH_FAPS
from tests.lips import INVENTORY, clip_of
from tests.system import VOWELS_FILE

pytestmark = pytest.mark.unit

Array = NDArray[np.float64]
VOWEL_SHAPES = ("a", "o", "e", "i", "u", "v")


def clip_with(samples: NDArray[np.float32], name: str = "made_up") -> LipClip:
    no_lips = np.full((1, len(MOUTH_FAPS)), np.nan)
    return replace(clip_of(np.zeros(1), no_lips), samples=samples, name=name)


def heard(clip: LipClip) -> HeardClip:
    return HeardClip(
        clip=clip,
        num_frames=int(len(clip.samples) / SAMPLE_RATE_HZ * 50.0) + 1,
        levels=level_track(clip.samples),
        events={delay_s: [] for delay_s in DELAYS_S},
        inventory=INVENTORY,
        recognised=[],
        aligned=None,
    )


@pytest.fixture(scope="module")
def vowels() -> LipClip:
    samples, rate_hz = read_audio(VOWELS_FILE)
    assert rate_hz == SAMPLE_RATE_HZ
    return replace(clip_with(samples[:, 0]), transcript="啊喔鹅衣乌迂")


def test_wlipsync_finds_the_vowels_that_its_profile_is_made_from(vowels: LipClip) -> None:
    model = load_model()
    profile = wlipsync_profile(model, [vowels])
    names = [phoneme["name"] for phoneme in profile["mfccs"]]
    assert {"rest", *VOWEL_SHAPES} <= set(names)
    rows = wlipsync_rows(profile)(vowels)
    num = len(names)
    volume, found = rows[:, 0], rows[:, 1 + num : 1 + 2 * num]
    np.testing.assert_allclose(rows[:, 1 + 2 * num :], volume[:, None] * rows[:, 1 : 1 + 2 * num])
    hits = []
    for phone in label_clip(model, vowels):
        # the window of 64 ms around the middle
        middle = round((phone.onset_s + phone.duration_s / 2.0 + 0.032) / ROW_S)
        shape = INVENTORY.visemes[phone.symbol][0][0]
        if shape in VOWEL_SHAPES:
            assert volume[middle] > 0.5
            hits.append(names[int(found[middle].argmax())] == shape)
    assert len(hits) >= 6
    assert np.mean(hits) > 0.6
    assert volume[-1] < 0.1  # silence follows


def test_outputs_tell_nothing_of_the_sound_to_come(vowels: LipClip) -> None:
    cut_s = 1.5
    cut = vowels.samples.copy()
    cut[round(cut_s * SAMPLE_RATE_HZ) :] = np.random.default_rng(0).normal(
        0.0, 0.1, len(cut) - round(cut_s * SAMPLE_RATE_HZ)
    )
    blank = {
        **rivals_rows._PROFILE,
        "mfccs": [{"name": str(k), "values": [k] * 12} for k in range(12)],
    }
    for rows in (head_audio_rows, wlipsync_rows(blank), loudness_rows):
        whole, changed = rows(vowels), rows(clip_with(cut))
        same = round(cut_s / ROW_S) - 1  # the change of rate looks 0.6 ms ahead
        if rows is not loudness_rows:  # which knows how loud the recording gets
            np.testing.assert_array_equal(whole[:same], changed[:same])
        assert whole.shape == changed.shape
        assert (whole[same:] != changed[same:]).any()
    weights = head_audio_rows(vowels)[:, : len(HEAD_AUDIO_VISEMES)]
    assert weights.max() > 0.5
    np.testing.assert_allclose(weights[-1], 0.0, atol=1e-6)  # half a second after the sound


def test_loudness_is_the_level_of_the_newest_sound() -> None:
    samples = np.zeros(SAMPLE_RATE_HZ, np.float32)
    samples[8000:] = 0.1
    level = loudness_rows(clip_with(samples))[:, 0]
    assert level[50] == 0.0
    np.testing.assert_allclose(level[52:101], 1.0)
    assert level[51] == pytest.approx(1.0 - 3.01 / 40.0, abs=1e-3)  # half of the window


def made_up_lips(rows: Array, lag_s: float) -> LipClip:
    """A clip whose opening is the only output, so much later than it is known."""
    time_s = np.arange(0.0, 12.0, 0.04)
    faps = np.zeros((len(time_s), len(MOUTH_FAPS)))
    value = rows[np.round((time_s + lag_s) / ROW_S).astype(int), 0]
    faps[:, MOUTH_FAPS.index(5)] = -150.0 - 150.0 * value
    faps[:, MOUTH_FAPS.index(6)] = faps[:, MOUTH_FAPS.index(7)] = 20.0 * value
    faps[:, MOUTH_FAPS.index(3)] = 50.0 * value
    return replace(clip_of(time_s, faps), samples=np.zeros(12 * SAMPLE_RATE_HZ, np.float32))


def test_the_linear_map_makes_up_for_a_lag_that_the_delay_allows() -> None:
    rng = np.random.default_rng(0)
    rows = np.convolve(rng.normal(size=1280), np.hanning(12), "same")[:, None]
    rows = np.tanh(rows / rows.std())
    clip = made_up_lips(rows, lag_s=0.1)
    lips = heard(clip)
    schemes = mapped("other", {clip.name: rows}, [clip])
    assert [scheme.delay_s for scheme in schemes] == [0.0, 0.05, 0.1, 0.16]
    scores = [score for scheme in schemes if (score := score_clip(lips, scheme)) is not None]
    found = {score.delay_ms: score for score in pool(scores) if score.kind == "language"}
    for measure in ("opening", "width", "jaw"):
        correlations = [found[delay_ms].curves[measure].correlation for delay_ms in found]
        assert correlations[0] is not None
        assert correlations[0] < 0.5  # the sound is not known yet
        assert correlations[2] is not None
        assert correlations[2] > 0.9
    rmse = found[160].curves["opening"].rmse
    assert rmse is not None
    assert rmse < 30.0  # of an extent of 100: nothing shrinks it
    assert found[160].closures.real > 10
    assert found[160].closures.f1 is not None
    assert found[160].closures.f1 > 0.8
    console = Console(record=True, width=80, file=StringIO())
    print_comparison(list(found.values()), console)
    text = console.export_text()
    assert "other, mapped, 160" in text
    assert "…" not in text
    assert len(figure(list(found.values())).axes) == 4


def test_what_was_not_measured_is_not_fitted() -> None:
    rows = np.random.default_rng(0).normal(size=(1280, 1))
    clip = made_up_lips(rows, lag_s=0.0)
    blind = replace(clip, name="blind", faps=np.full_like(clip.faps, np.nan))
    both = fit([clip, blind], {clip.name: rows, "blind": rows}, 0.0)
    np.testing.assert_array_equal(both.weights, fit([clip], {clip.name: rows}, 0.0).weights)


def test_head_audio_as_it_is_shuts_the_lips_for_p() -> None:
    rows = np.zeros((150, 2 * len(HEAD_AUDIO_VISEMES)))
    rows[:, HEAD_AUDIO_VISEMES.index("aa")] = 0.65
    rows[50:80] = 0.0
    rows[50:80, HEAD_AUDIO_VISEMES.index("PP")] = 0.75
    clip = clip_with(np.zeros(SAMPLE_RATE_HZ, np.float32))
    for delay_s, lead in ((0.0, 0), (0.1, 5), (0.3, 7)):  # never more than it lags
        faps = as_it_comes({clip.name: rows}, delay_s).frames(heard(clip))
        assert faps is not None
        opening = -faps[:, 3] - faps[:, 4]
        np.testing.assert_array_equal(np.flatnonzero(opening < 20.0), np.arange(25, 40) - lead)
        assert opening.max() > 100.0


def test_missing_packages_are_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    clip = clip_with(np.zeros(1600, np.float32))
    with pytest.raises(UserError, match="headaudio failed"):
        rivals_rows.package_rows("no-headaudio", clip.samples)
    monkeypatch.setattr(rivals_rows, "FOLDER", tmp_path)
    with pytest.raises(UserError, match="npm ci"):
        head_audio_rows(clip)
    monkeypatch.setattr("shutil.which", lambda *_args, **_kwargs: None)
    with pytest.raises(UserError, match="kouxing\\[page\\]"):
        head_audio_rows(clip)
