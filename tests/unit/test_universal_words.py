"""Universal phones of a manifest's rows, and the feature errors between them."""

from pathlib import Path

import pytest
import soundfile

from kouxing.corpora.scoring import feature_errors
from kouxing.corpora.speech_corpus import RowErrors, read_corpus
from kouxing.corpora.universal_phones import labeled_phones, universal_words
from kouxing.shared.errors import UserError
from kouxing.shared.phones.inventory import load_inventory
from kouxing.shared.phones.universal.segments import features
from tests.unit.test_block_model import HELLO


def words_of(**row: str) -> list[str]:
    return [" ".join(word) for word in universal_words({"utt_id": "a", "text": "", **row})]


def test_reads_phones_from_ipa_arpabet_and_pinyin_columns() -> None:
    assert words_of(ipa="t͡ʃaɪ niː", language="xx") == ["ch a ih", "n i"]
    assert words_of(arpabet="S T AY T AH N") == ["s", "t", "a", "ih", "tasp", "ax", "n"]
    assert words_of(pinyin="zhong1 guo2") == ["tr uh ng", "k w o"]


@pytest.mark.parametrize(
    ("syllable", "phones"),
    [
        ("gwong1", "k w ao ng"),
        ("jyu4", "j y"),
        ("seoi2", "s oc y"),
        ("ng5", "ng"),
        ("sik6", "s ih k"),
    ],
)
def test_cantonese_syllables(syllable: str, phones: str) -> None:
    assert words_of(text=syllable, language="yue") == [phones]


def test_labels_of_a_stop_are_one_phone(tmp_path: Path) -> None:
    table = tmp_path / "labels.tsv"
    labels = ["<p:>", "_t", "!t", "tasp", "aI", "k", "!k", "k", "."]
    table.write_text("start_s\tend_s\tsymbol\n" + "".join(f"0\t1\t{one}\n" for one in labels))
    row = {"utt_id": "emodb_1", "text": "", "phones_path": str(table)}
    assert universal_words(row) == [("t", "a", "ih", "k", "k")]
    ends = [end for end, _ in labeled_phones(table)]
    assert ends == [1.0, 1.0, 0.5, 1.0, 1.0, 1.0, 1.0]
    table.write_text("start_s\tend_s\n0\t1\n")
    with pytest.raises(UserError, match="lacks the columns symbol"):
        universal_words(row)


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ({"ipa": "a!"}, "unknown symbol '!'"),
        ({"arpabet": "QQ"}, "unknown symbol 'QQ'"),
        ({"text": "x", "language": "tlh"}, "language 'tlh' has no tables"),
        ({"text": "xyz", "language": "yue"}, "'xyz' is not jyutping"),
    ],
)
def test_rejects_what_it_cannot_read(row: dict[str, str], message: str) -> None:
    with pytest.raises(UserError, match=message):
        words_of(**row)


def test_each_row_of_a_corpus_has_its_language(tmp_path: Path) -> None:
    soundfile.write(tmp_path / "a.wav", HELLO, 16_000)
    lines = ["utt_id\tpath\tlanguage\ttext\tipa", "a\ta.wav\tde\t-\tja", "b\ta.wav\txx\tja\t"]
    (tmp_path / "manifest.tsv").write_text("\n".join(lines) + "\n")
    errors, inventory = RowErrors(), load_inventory("universal")
    (row,) = read_corpus(tmp_path, errors, inventory)
    assert row.language == "de"
    assert [inventory.phones[phone] for phone in row.phones] == ["j", "a"]
    assert "language 'xx' has no tables" in errors.messages[0]


def test_feature_errors_are_the_share_of_wrong_features() -> None:
    known = features()
    voicing = sum(a != b for a, b in zip(known["p"], known["b"], strict=True)) / 24
    assert feature_errors("p a".split(), "b a".split()) == voicing == 1 / 24
    assert feature_errors("p a t".split(), "b a".split()) == pytest.approx(1 + voicing)
    assert feature_errors([], ["a"]) == 1.0
    assert feature_errors(["a", "s"], []) == 2.0
