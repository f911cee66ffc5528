"""The acoustic model of a language, and commands in other languages than Mandarin."""

import csv
from pathlib import Path

import pytest

from kouxing.services.cli.options import WidthSource
from kouxing.services.cli.recordings.mouth_drawing import draw_mouth
from kouxing.services.recognizer.acoustic.blocks import BlockModel
from kouxing.services.recognizer.acoustic.languages import load_model_for_language
from kouxing.services.recognizer.offline.offline_recognition import recognize_recording
from kouxing.shared.audio.audio_file import read_audio
from kouxing.shared.errors import UserError
from kouxing.shared.phones.inventory import (
    find_language,
    language_codes,
    language_titles,
    load_inventory,
)
from tests.system import ROOT, VOWELS_FILE

SAMPLES = read_audio(VOWELS_FILE)[0][:, 0]
SOUND = ROOT / "shared" / "demo" / "hello-female.wav"


def test_mandarin_has_its_own_model() -> None:
    models = (
        load_model_for_language(),
        load_model_for_language("mandarin", "gmm"),
        load_model_for_language(None, "gmm"),
    )
    assert [model.inventory.language for model in models] == ["mandarin"] * 3
    assert load_model_for_language() is load_model_for_language("mandarin") is not models[1]


def test_other_languages_use_their_phones_of_the_universal_model() -> None:
    english, universal = load_model_for_language("english"), load_model_for_language("universal")
    assert english.inventory is universal.inventory is load_inventory("universal")
    assert isinstance(english, BlockModel)
    assert isinstance(universal, BlockModel)
    assert english.runner is universal.runner  # in memory once
    symbols = {phone.symbol for phone in recognize_recording(english, SAMPLES)}
    assert symbols & load_inventory("english").vowels
    assert symbols <= {*load_inventory("english").phones}


def test_a_model_of_other_phones_is_an_error() -> None:
    with pytest.raises(UserError, match="the acoustic model gmm has the phones of mandarin"):
        load_model_for_language("english", "gmm")


def test_languages_have_codes_and_titles() -> None:
    assert language_codes()["auto"] == "universal"
    assert [find_language(name) for name in ("zh", "de", "german")] == [
        "mandarin",
        "german",
        "german",
    ]
    assert {*language_titles()} == {*language_codes()}
    assert all({*titles} == {"en", "zh"} for titles in language_titles().values())


def test_draws_the_mouth_of_an_english_text(tmp_path: Path) -> None:
    output = tmp_path / "mouth.csv"
    text = "Six spoons of peas, and 5 men"
    draw_mouth(SOUND, text, output, lips=WidthSource.FERGUSON, language="english")
    with output.open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    closed = {row["phone"] for row in rows if row["opening"] == "0.0000"}
    assert "m" in closed
    assert {"ih", "u", "th", "ae"} & {row["phone"] for row in rows if float(row["opening"]) > 0.5}
