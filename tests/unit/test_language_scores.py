"""Errors by language: the recognizers, and the phones of hama."""

import json
from pathlib import Path

import pytest
import soundfile

from kouxing.corpora.speech_corpus import LANGUAGES, RowErrors, read_corpus
from kouxing.corpora.tables import read_rows
from kouxing.evaluation.recognizer import languages
from kouxing.evaluation.recognizer.aligned_corpus import align_corpus
from kouxing.evaluation.recognizer.languages import evaluate_languages
from kouxing.evaluation.report.recognition_table import speech_table
from kouxing.evaluation.rivals import tables
from kouxing.services.recognizer.acoustic.languages import load_model_for_language
from kouxing.services.recognizer.search.output_rule import OutputRuleConfig
from kouxing.shared.errors import UserError
from kouxing.shared.phones.inventory import find_language, load_inventory
from kouxing.shared.phones.universal.segments import read_ipa
from tests.corpora import write_manifest
from tests.system import HELLO

RULE = OutputRuleConfig(2, 0.95)


def write_recordings(folder: Path) -> Path:
    """Write three recordings of the same short sound."""
    soundfile.write(folder / "a.wav", HELLO, 16_000)
    rows = [("a", "en-native", "nixaʊ"), ("b", "zh", "ni xaʊ"), ("c", "en-native", "nixaʊ")]
    cells = [f"{name}\ta.wav\t{language}\t{name}\ttest\t-\t{ipa}" for name, language, ipa in rows]
    return write_manifest(folder, "utt_id path language speaker split text ipa", cells)


def test_listed_recordings_have_phones_and_a_language() -> None:
    universal = load_inventory("universal")
    rows = list(read_rows(LANGUAGES, ("utt_id", "path", "language", "ipa")))
    assert {row["language"] for row in rows} >= {"de", "en-learner", "en-GRID", "it", "ko", "zh"}
    for row in rows:
        find_language(row["language"].partition("-")[0])
        phones, unknown = read_ipa(row["ipa"])
        assert phones
        assert not unknown
        assert {*phones} <= {*universal.phones}
    errors = RowErrors()
    assert read_corpus(LANGUAGES, errors, universal) == []
    assert all("no audio file" in message for message in errors.messages)


@pytest.mark.slow
def test_measures_each_recognizer_by_language(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    manifest = write_recordings(tmp_path)
    references = align_corpus(load_model_for_language("universal"), manifest, "test")
    monkeypatch.setattr(
        languages, "_run_hama", lambda english: iter([("n", "i", "h", "a", "uh"), ()])
    )
    results = evaluate_languages(references, RULE, with_hama=True)
    json.dumps(results)
    assert {name: figures["recordings"] for name, figures in results.items()} == {
        "auto": 3,
        "own": 3,
        "hama": 2,
    }
    hama = results["hama"]["speech"]
    assert [*hama] == ["language en-native"]
    assert hama["language en-native"]["final"]["phone_error_rate"] == pytest.approx(6 / 10)
    assert results["own"]["speech"]["language zh"]["final"]["feature_error_rate"] > 0
    rows = {(kind, name): cells for kind, name, *cells in speech_table(results).rows}
    assert rows["language en-native", "hama"][2] == "-", "hama has no first hypothesis"


def test_hama_must_be_installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tables, "FOLDER", tmp_path)
    with pytest.raises(UserError, match="not installed; run 'make report'"):
        list(languages._run_hama([]))
