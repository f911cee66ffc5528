"""Audio to phones, live and offline."""

import numpy as np
import pytest

from kouxing.services.recognizer.acoustic.load import load_model
from kouxing.services.recognizer.offline import recognize
from kouxing.services.recognizer.recognizer import Recognizer
from kouxing.services.recognizer.search import decoder, path_records
from kouxing.shared.audio_file import read_audio
from kouxing.shared.phones.events import Phone, SpeechChange
from tests.live_streams import recognize_live
from tests.system import DEMO

pytestmark = pytest.mark.slow

HELLO = read_audio(DEMO / "hello-female.wav")[0][:, 0]


def hello_phones() -> list[Phone]:
    outputs = recognize_live(load_model(), HELLO, 320)
    return [output for output in outputs if isinstance(output, Phone)]


def test_silence_and_noise_have_no_phones() -> None:
    noise = np.random.default_rng(0).normal(0, 0.01, 32_000).astype(np.float32)
    outputs = recognize_live(load_model(), noise, 320)
    assert not any(isinstance(output, Phone | SpeechChange) for output in outputs)
    assert recognize(load_model(), noise, 16_000) == []


def test_warm_up_compiles_everything_and_changes_no_result() -> None:
    expected = hello_phones()
    Recognizer(load_model()).warm_up()
    assert decoder._steps.signatures
    assert path_records.count_paths.signatures
    assert path_records.compact.signatures
    assert hello_phones() == expected
