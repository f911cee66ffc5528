"""A second language needs only tables, a lexicon and a model.

The toy language has seven phones and silence. Its model has the Mandarin model's states of them.
"""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from kouxing.services.recognizer.acoustic.gmm import GaussianMixtures, GmmModel
from kouxing.services.recognizer.acoustic.load import load_model
from kouxing.services.recognizer.offline.alignment import align_text, drop_pauses
from kouxing.services.recognizer.offline.offline_recognition import recognize_recording
from kouxing.shared.audio.audio_file import read_audio
from kouxing.shared.errors import UserError
from kouxing.shared.phones.events import Phone
from kouxing.shared.phones.inventory import PhoneInventory, load_inventory
from kouxing.training.model_files import save_gmm
from tests.languages import flat_language, installed_language
from tests.live_streams import recognize_live
from tests.system import VOWELS_FILE

SAMPLES = read_audio(VOWELS_FILE)[0][:, 0]


@pytest.fixture(scope="module")
def toy(tmp_path_factory: pytest.TempPathFactory) -> Iterator[PhoneInventory]:
    """Install the toy language."""
    folder = tmp_path_factory.mktemp("toy")
    with installed_language(folder, "toy", "tests.toy_language"):
        yield load_inventory("toy")
    load_inventory.cache_clear()


@pytest.fixture(scope="module")
def path(toy: PhoneInventory, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the file of a model of the toy language."""
    mandarin = load_model("gmm")
    assert isinstance(mandarin, GmmModel)
    hmms = mandarin.topology
    phones = [mandarin.inventory.index[phone.replace("y", "v")] for phone in toy.phones]
    spans = [np.arange(hmms.first_state[phone], hmms.first_state[phone + 1]) for phone in phones]
    states = np.concatenate(spans)
    model = replace(
        mandarin,
        topology=replace(
            hmms,
            phone_lm=flat_language(toy),
            first_state=np.cumsum([0, *map(len, spans)]),
            log_stay=hmms.log_stay[states],
            log_leave=hmms.log_leave[states],
            duration_mean_s=hmms.duration_mean_s[:, phones],
            duration_spread_s=hmms.duration_spread_s[:, phones],
        ),
        mixtures=GaussianMixtures(
            weights=mandarin.mixtures.weights[states],
            means=mandarin.mixtures.means[states],
            covars=mandarin.mixtures.covars[states],
        ),
    )
    path = tmp_path_factory.mktemp("model") / "toy.npz"
    save_gmm(path, model)
    return path


def symbols(phones: list[Phone], toy: PhoneInventory) -> str:
    return " ".join(phone.symbol for phone in drop_pauses(phones, toy))


def test_the_language_is_recognized_live_and_offline(toy: PhoneInventory, path: Path) -> None:
    model = load_model(path)
    assert model.inventory is toy
    assert toy.phones == ("sil", "m", "a", "o", "e", "i", "u", "y")
    heard = symbols(recognize_recording(model, SAMPLES), toy)
    assert set(heard.split()) == {"a", "o", "i", "u"}  # e and ü of this voice sound like i
    events = recognize_live(model, SAMPLES)
    final = [event for event in events if isinstance(event, Phone) and event.final]
    assert symbols(final, toy) == heard


def test_a_text_of_the_language_is_aligned(toy: PhoneInventory, path: Path) -> None:
    aligned = drop_pauses(align_text(load_model(path), SAMPLES, "aoe iuy"), toy)
    assert symbols(aligned, toy) == "a o e i u y"
    expected = drop_pauses(align_text(load_model(), SAMPLES, "啊喔鹅衣乌迂"), load_inventory())
    onsets_s = [phone.onset_s for phone in expected]
    assert [phone.onset_s for phone in aligned] == pytest.approx(onsets_s, abs=0.15)
    with pytest.raises(UserError, match="cannot read 'xyz'"):
        align_text(load_model(path), SAMPLES, "xyz")
