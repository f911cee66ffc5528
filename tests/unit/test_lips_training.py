"""Training lips from sound, on made-up speakers."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import soundfile
import torch

from kouxing.corpora.lip_clips import SAMPLE_RATE_HZ, LipClip, part_of
from kouxing.services.recognizer.lip_predictor import (
    CLOSURE,
    LIP_FAPS,
    NUM_OUTPUTS,
    load_lip_predictor,
)
from kouxing.shared.errors import UserError
from kouxing.shared.face.faps import MOUTH_FAPS
from kouxing.training.lips import recipe
from kouxing.training.lips.positions import Speech
from kouxing.training.lips.recipe import (
    DELAYS_S,
    HISTORY,
    Units,
    basis_of,
    examples_of,
    fit,
    fit_ridge,
    history_of,
    joined,
    train_lips,
)
from kouxing.training.lips.recurrent import LipNetwork
from kouxing.training.lips.targets import closed_below
from kouxing.training.neural.network import Shape
from kouxing.training.neural.teacher import WholeEncoder
from tests.e2e.following import samples_of_file
from tests.lips import clip_of
from tests.system import VOWELS_FILE

pytestmark = pytest.mark.slow

NUM_FEATURES = 160 + 8
FRAME_S = 0.04
POSITIONS_S = 0.02 * np.arange(150, dtype=np.float64)
CLOSED_AT = 20.0


def clip_with(height: np.ndarray) -> LipClip:
    """Make a clip whose lower lip opens so far at each frame."""
    time_s = FRAME_S * np.arange(len(height), dtype=np.float64)
    faps = np.full((len(height), len(MOUTH_FAPS)), np.nan)
    faps[:, MOUTH_FAPS.index(4)] = 0.0
    faps[:, MOUTH_FAPS.index(5)] = -height
    faps[:, MOUTH_FAPS.index(3)] = height
    faps[:, MOUTH_FAPS.index(6)], faps[:, MOUTH_FAPS.index(7)] = 10.0, 30.0
    return clip_of(time_s, faps)


def test_lips_touch_in_the_lowest_tenth_of_the_range() -> None:
    limits = closed_below([clip_with(np.linspace(50.0, 250.0, 1001))])
    assert limits == {"nobody": pytest.approx(70.0, abs=3.0)}


def test_ridge_fits_a_linear_map_of_the_past() -> None:
    rng = np.random.default_rng(0)
    components = rng.normal(size=(20_000, 3)).astype(np.float32)
    history = history_of(components)
    targets = np.stack([components[:, 0], np.roll(components[:, 1], 2)], axis=1)[:, None]
    targets[:2, 0, 1] = 0.0
    targets[::3, 0, 0] = np.nan
    weights = fit_ridge([history], [targets.astype(np.float32)])
    made = np.einsum("nx,xdo->ndo", history[::3], weights)
    assert np.corrcoef(made[:, 0, 0], components[::3, 0])[0, 1] > 0.99
    assert np.corrcoef(made[5:, 0, 1], targets[::3][5:, 0, 1])[0, 1] > 0.99


@pytest.mark.usefixtures("one_thread")
def test_learns_lips_in_each_speakers_units() -> None:
    rng = np.random.default_rng(0)
    speech, targets = [], []
    for speaker, scale in (("one", 200.0), ("two", 100.0)):
        clip = replace(clip_with(np.zeros(2)), speaker=speaker)
        for _ in range(12):
            features = rng.normal(size=(150, NUM_FEATURES)).astype(np.float16)
            features[:, 3] *= 5  # so it is a principal component
            smooth = np.convolve(features[:, 3], np.ones(5) / 11, "full")[:150]
            target = np.full((150, len(DELAYS_S), NUM_OUTPUTS), np.nan, np.float32)
            target[..., LIP_FAPS.index(5)] = -scale * (2 + smooth[:, None])
            target[..., CLOSURE] = smooth[:, None] < -1
            speech.append(Speech(clip=clip, features=features, known_s=POSITIONS_S, speed=1.0))
            targets.append(target)
    train = [number for number in range(24) if number % 12]
    basis = basis_of(speech, targets)
    examples = examples_of([speech[k] for k in train], [targets[k] for k in train], basis)
    model, losses = fit(examples, [], basis, seed=3, num_epochs=6)
    assert losses[-1] < losses[0]
    for held in (0, 12):
        stream = model.create_stream(model.delays_s)
        rows = [stream.step(row)[2] for row in speech[held].features.astype(np.float32)]
        made = np.stack(rows)
        lower = LIP_FAPS.index(5)
        assert np.corrcoef(made[:, lower], targets[held][:, 2, lower])[0, 1] > 0.8
        assert not made[:, LIP_FAPS.index(16)].any()  # nobody tracked it


def test_widens_the_width_and_predicts_closures_from_a_third() -> None:
    torch.manual_seed(0)
    network = LipNetwork(3, len(DELAYS_S), 1)
    linear = np.zeros((3 * HISTORY + 1, len(DELAYS_S), len(LIP_FAPS)))
    mean = np.arange(1.0, 1.0 + len(LIP_FAPS), dtype=np.float32)
    units = Units(mean, np.full(len(LIP_FAPS), 2.0, np.float32))
    model = joined(np.zeros(9, np.float32), np.ones((9, 3), np.float32), network, linear, units)
    bias = network.output.bias.detach().numpy().reshape(-1, NUM_OUTPUTS)
    for fap, gain in ((5, 1.0), (6, 1.3), (53, 1.3)):
        column = LIP_FAPS.index(fap)
        made = model.output_bias[:, column] - mean[column]
        np.testing.assert_allclose(made, gain * bias[:, column], rtol=1e-4, atol=1e-5)
    even = 1 / (1 + np.exp(model.output_bias[:, CLOSURE] - bias[:, CLOSURE]))
    np.testing.assert_allclose(even, 1 / 3, rtol=1e-5)
    np.testing.assert_allclose(model.output_bias[:, CLOSURE + 1], bias[:, CLOSURE + 1])


def write_clip(folder: Path, name: str, speaker: str, license_name: str) -> None:
    samples = samples_of_file(VOWELS_FILE)[: 2 * SAMPLE_RATE_HZ]
    soundfile.write(folder / f"{name}.flac", samples, SAMPLE_RATE_HZ)
    about = {"speaker": speaker, "licence": license_name, "language": "en"}
    (folder / f"{name}.json").write_text(json.dumps(about))
    rows = [
        f"{k * FRAME_S},{100 + 50 * np.sin(k)},0,{-200 - 100 * np.sin(k)},{5 * np.cos(k)},0"
        for k in range(50)
    ]
    head = "t,F3_open_jaw,F4_upper,F5_lower,F6_left,F7_right"
    (folder / f"{name}.csv").write_text("\n".join([head, *rows]) + "\n")


def name_for(part: str) -> str:
    """Return a name that the rule gives this part."""
    return next(name for k in range(100) if part_of(name := f"clip_{k}", may_train=True) == part)


@pytest.mark.usefixtures("one_thread")
def test_writes_a_model_and_its_card(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    folder, output = tmp_path / "clips", tmp_path / "lips.npz"
    folder.mkdir()
    write_clip(folder, name_for("train"), "anna", "CC0")
    write_clip(folder, name_for("choice"), "berta", "MIT")
    write_clip(folder, name_for("held"), "clara", "CC0")
    write_clip(folder, "closed", "dora", "academic use only")
    train_lips(folder, output, seed=1)
    assert load_lip_predictor(output).delays_s == DELAYS_S
    card = output.with_suffix(".md").read_text()
    assert "| CC0 | 1 | 1 | 0.0 |" in card
    assert "| MIT | 1 | 1 | 0.0 |" in card
    assert "academic" not in card
    assert "gated recurrent unit" in card


@pytest.mark.usefixtures("one_thread")
def test_labels_speech_without_video(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    folder, output = tmp_path / "clips", tmp_path / "lips.npz"
    folder.mkdir()
    write_clip(folder, name_for("train"), "anna", "CC0")
    with pytest.raises(UserError, match="also give --whisper"):
        train_lips(folder, output, speech=[folder])
    small = Shape(num_states=0, look_aheads=(), width=32, heads=2, layers=4, inner=48)
    monkeypatch.setattr(recipe, "load_encoder", lambda _: WholeEncoder(small, (0, 1, 2, 3)).eval())
    train_lips(folder, output, speech=[folder], whisper=tmp_path)
    assert load_lip_predictor(output).delays_s == DELAYS_S
    card = output.with_suffix(".md").read_text()
    assert "labeled 0.0 hours of speech" in card


def test_rejects_clips_without_a_free_license(tmp_path: Path) -> None:
    write_clip(tmp_path, "closed", "dora", "academic use only")
    with pytest.raises(UserError, match=r"no clip .* may be used"):
        train_lips(tmp_path, tmp_path / "lips.npz")
