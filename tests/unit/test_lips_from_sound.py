"""The lip predictor: its steps, its file, and the lip positions of a session."""

from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

from kouxing.services.recognizer.acoustic.load import load_model
from kouxing.services.recognizer.lips.lip_predictor import (
    CLOSURE,
    FORMAT,
    GruLipPredictor,
    join_features,
    load_lip_predictor,
)
from kouxing.shared.errors import UserError
from kouxing.shared.face.faps import MOUTH_FAPS
from kouxing.shared.phones.events import LipPositions
from kouxing.training.model_files import save_lip_predictor, write_archive
from tests.lip_predictors import NUM_FEATURES, NUM_LIPS, UNITS, random_lip_predictor
from tests.live_streams import recognize_live
from tests.system import VOWELS_FILE, samples_of_file

SAMPLES = samples_of_file(VOWELS_FILE)[:32_000]
MODEL = random_lip_predictor()


def arrays_of(model: GruLipPredictor) -> dict[str, np.ndarray]:
    arrays = {field.name: getattr(model, field.name) for field in fields(model)}
    return {"format": np.array(FORMAT), **arrays}


def test_a_step_matches_the_formulas() -> None:
    rng = np.random.default_rng(1)
    rows = rng.normal(size=(4, NUM_FEATURES)).astype(np.float32)
    stream = MODEL.create_stream(MODEL.delays_s)
    outputs = [stream.step(row) for row in rows]
    components = [(row - MODEL.feature_mean) @ MODEL.projection for row in rows]
    state = np.zeros(UNITS)
    for component in components:
        entered = np.maximum(component @ MODEL.entry_weights + MODEL.entry_bias, 0)
        from_input = np.split(entered @ MODEL.input_weights + MODEL.input_bias, 3)
        from_state = np.split(state @ MODEL.state_weights + MODEL.state_bias, 3)
        reset, update = (1 / (1 + np.exp(-from_input[k] - from_state[k])) for k in (0, 1))
        state = (1 - update) * np.tanh(from_input[2] + reset * from_state[2]) + update * state
    expected = (
        np.einsum("l,ldo->do", rows[-1, -NUM_LIPS:], MODEL.lip_weights)
        + np.einsum("u,udo->do", np.concatenate([state, entered]), MODEL.output_weights)
        + MODEL.output_bias
    )
    np.testing.assert_allclose(outputs[-1], expected, rtol=1e-4, atol=1e-4)


def test_each_delay_has_separate_outputs_and_times() -> None:
    frames, features = np.ones((2, 80), np.float32), np.ones(NUM_FEATURES - 160, np.float32)
    pair = MODEL.create_stream([-0.005, 0.155]).process_encoder_frame(1.0, frames, features)
    single = MODEL.create_stream([0.155]).process_encoder_frame(1.0, frames, features)
    assert [(lip.time_s, lip.delay_s) for lip in pair] == [(1.005, -0.005), (0.845, 0.155)]
    np.testing.assert_allclose(pair[1].faps, single[0].faps, rtol=1e-5)
    outputs = MODEL.create_stream([0.155]).step(join_features(frames, features))
    assert single[0].closure == pytest.approx(1 / (1 + np.exp(-outputs[0, CLOSURE])))
    with pytest.raises(UserError, match="no delay of 70 ms; choose -5, 55, 155"):
        MODEL.create_stream([0.07])


def test_rejects_a_predictor_for_another_encoder(tmp_path: Path) -> None:
    path = tmp_path / "lips.npz"
    save_lip_predictor(path, MODEL)
    assert load_lip_predictor(path).delays_s == MODEL.delays_s
    wider = np.pad(MODEL.projection, ((0, 2), (0, 0)))
    mean = np.pad(MODEL.feature_mean, (0, 2))
    write_archive(path, {**arrays_of(MODEL), "projection": wider, "feature_mean": mean})
    with pytest.raises(UserError, match="trained with another encoder"):
        load_lip_predictor(path)


def test_the_shipped_predictor_opens_rounds_and_closes_the_lips() -> None:
    outputs = recognize_live(
        load_model(), SAMPLES, lip_predictor=load_lip_predictor(), face_delay_s=0.2
    )
    lips = [output for output in outputs if isinstance(output, LipPositions)]

    def mean(fap: int, start_s: float, end_s: float) -> float:
        column = MOUTH_FAPS.index(fap)
        return float(np.mean([lip.faps[column] for lip in lips if start_s < lip.time_s < end_s]))

    assert mean(5, 0.45, 0.6) < -100  # er: the lower lip is down
    assert mean(6, 0.91, 1.0) < mean(6, 0.45, 0.6) - 30  # u: the corners are inwards
    assert min(lip.closure for lip in lips if lip.time_s > 1.45) > 0.5
