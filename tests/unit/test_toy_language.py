"""A second language needs only tables, a lexicon and a model.

The toy language has seven phones and silence. Its model is trained on the six vowels of a
recording, with times from the Mandarin model, and recognizes them.
"""

from collections.abc import Iterator
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from kouxing.services.live_chain import LiveChain
from kouxing.services.recognizer.acoustic.acoustic_model import (
    NUM_POSITIONS,
    AcousticModel,
    Topology,
)
from kouxing.services.recognizer.acoustic.gmm import GaussianMixtures, GmmModel
from kouxing.services.recognizer.acoustic.load import load_model
from kouxing.services.recognizer.acoustic.model_file import read_archive
from kouxing.services.recognizer.alignment import align_text, spoken
from kouxing.services.recognizer.front_end.features import (
    HOP_S,
    NUM_FEATURES,
    LiveMean,
    cepstra,
    with_differences,
)
from kouxing.services.recognizer.front_end.vtln import PitchedLogMel, VocalTractNormalizer
from kouxing.services.recognizer.offline import recognize
from kouxing.services.recognizer.speech_scorer import frame_time_s
from kouxing.services.synthesizer.config import SynthesizerConfig
from kouxing.services.synthesizer.lips.load import load_lip_model
from kouxing.shared.audio_file import read_audio
from kouxing.shared.errors import UserError
from kouxing.shared.phones.events import Phone
from kouxing.shared.phones.inventory import PhoneInventory, load_inventory
from tests.languages import flat_language, install_language
from tests.live_streams import recognize_live
from tests.system import VOWELS_FILE

pytestmark = pytest.mark.unit

STATES = 3  # of each phone
HALF_WIDTH = 2


@pytest.fixture
def toy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[PhoneInventory]:
    """Install the toy language."""
    install_language(tmp_path, "toy", "tests.toy_language")
    monkeypatch.syspath_prepend(str(tmp_path))
    yield load_inventory("toy")
    load_inventory.cache_clear()
    load_lip_model.cache_clear()


@cache
def vowels() -> tuple[NDArray[np.float32], tuple[tuple[str, float, float], ...]]:
    """Return samples at 16 kHz; symbol, onset and end of vowels and pauses, seconds."""
    samples, rate_hz = read_audio(VOWELS_FILE)
    assert rate_hz == 16_000
    aligned = align_text(load_model(), samples, rate_hz, "啊喔鹅衣乌迂")
    labels = (
        (phone.symbol.replace("v", "y"), phone.onset_s, phone.onset_s + phone.duration_s)
        for phone in aligned
    )
    return samples[:, 0], tuple(labels)


def trained(inventory: PhoneInventory) -> GmmModel:
    """Train a model with one Gaussian for each phone of the recording."""
    samples, labels = vowels()
    frames = PitchedLogMel().accept_waveform(samples)
    log_mel = VocalTractNormalizer().warp(frames[:, :-2], frames[:, -2], frames[:, -1])
    static = cepstra(log_mel)
    prior_mean = static.mean(axis=0)
    features = LiveMean(prior_mean).normalize(with_differences(static, HALF_WIDTH))
    means = np.tile(features.mean(axis=0) + 10, (len(inventory), 1))  # far from all sounds
    covars = np.tile(features.var(axis=0), (len(inventory), 1))
    for symbol in {symbol for symbol, _, _ in labels}:
        rows = np.concatenate([features[_frames(span)] for name, *span in labels if name == symbol])
        means[inventory.index[symbol]] = rows.mean(axis=0)
        covars[inventory.index[symbol]] = rows.var(axis=0) + 0.1
    num_states = STATES * len(inventory)
    duration_s = np.full((NUM_POSITIONS, len(inventory)), 0.1, np.float32)
    return GmmModel(
        topology=Topology(
            phone_lm=flat_language(inventory),
            first_state=np.arange(len(inventory) + 1) * STATES,
            log_stay=np.full(num_states, np.log(0.9), np.float32),
            log_leave=np.full(num_states, np.log(0.1), np.float32),
            duration_mean_s=duration_s,
            duration_spread_s=duration_s,
        ),
        mixtures=GaussianMixtures(
            weights=np.ones((num_states, 1), np.float32),
            means=np.repeat(means, STATES, axis=0)[:, None].astype(np.float32),
            covars=np.repeat(covars, STATES, axis=0)[:, None].astype(np.float32),
        ),
        rotation=np.eye(NUM_FEATURES, dtype=np.float32),
        prior_mean=prior_mean,
        half_width=HALF_WIDTH,
        acoustic_scale=0.2,
    )


def _frames(span: list[float]) -> slice:
    start, end = (round((time_s - frame_time_s(0)) / HOP_S) for time_s in span)
    return slice(start, end)


def loaded(toy: PhoneInventory, folder: Path) -> AcousticModel:
    trained(toy).save(folder / "toy.npz")
    return load_model(folder / "toy.npz")


def symbols(phones: list[Phone], toy: PhoneInventory) -> str:
    return " ".join(phone.symbol for phone in spoken(phones, toy))


def test_loads_the_language_of_a_model(toy: PhoneInventory, tmp_path: Path) -> None:
    inventory = loaded(toy, tmp_path).inventory
    assert inventory is toy
    assert inventory.language == "toy"
    assert inventory.phones == ("sil", "m", "a", "o", "e", "i", "u", "y")
    assert inventory.silence == "sil"
    assert inventory.initials == frozenset("m")
    assert inventory.pronounce("Mami o") == [("m", "a"), ("m", "i"), ("o",)]


def test_recognizes_it_live_and_offline(toy: PhoneInventory, tmp_path: Path) -> None:
    model = loaded(toy, tmp_path)
    samples, _ = vowels()
    assert symbols(recognize(model, samples, 16_000), toy) == "a o e i u y"
    events = recognize_live(model, samples)
    final = [event for event in events if isinstance(event, Phone) and event.final]
    assert symbols(final, toy) == "a o e i u y"


def test_aligns_text(toy: PhoneInventory, tmp_path: Path) -> None:
    model = loaded(toy, tmp_path)
    samples, labels = vowels()
    aligned = spoken(align_text(model, samples, 16_000, "aoe iuy"), toy)
    assert symbols(aligned, toy) == "a o e i u y"
    expected_s = [onset_s for symbol, onset_s, _ in labels if symbol != "sil"]
    assert [phone.onset_s for phone in aligned] == pytest.approx(expected_s, abs=0.15)
    with pytest.raises(UserError, match="cannot read 'xyz'"):
        align_text(model, samples, 16_000, "xyz")


def test_opens_the_mouth(toy: PhoneInventory, tmp_path: Path) -> None:
    visemes = "dynamic-visemes"
    chain = LiveChain(
        loaded(toy, tmp_path),
        load_lip_model("toy", visemes),
        synthesizer=SynthesizerConfig(lips=visemes),
    )
    samples, labels = vowels()
    frames = chain.accept_waveform(samples) + chain.input_finished()
    assert {event.symbol for event in chain.events if isinstance(event, Phone)} <= set(toy.phones)
    jaw = [faps[2] for _, faps in frames]  # FAP 3, at 50 Hz
    start_s, end_s = next((start_s, end_s) for symbol, start_s, end_s in labels if symbol == "a")
    assert max(jaw[round(50 * start_s) : round(50 * end_s)]) > 200
    assert not any(jaw[:10])  # before the speech


def test_rejects_a_model_whose_language_is_not_installed(
    toy: PhoneInventory, tmp_path: Path
) -> None:
    path = tmp_path / "toy.npz"
    trained(toy).save(path)
    arrays = read_archive(path).arrays
    np.savez(path, allow_pickle=False, **{**arrays, "language": np.array("klingon")})
    with pytest.raises(UserError, match=r"toy\.npz: language 'klingon' is not .*: mandarin, toy"):
        load_model(path)
