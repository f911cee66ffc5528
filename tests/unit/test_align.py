import csv
import io
import json
from functools import cache
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import typer
from numpy.typing import NDArray

from kouxing.services.cli.recordings.commands import align
from kouxing.services.recognizer.acoustic.load import load_model
from kouxing.services.recognizer.front_end.features import count_frames
from kouxing.services.recognizer.offline import alignment
from kouxing.services.recognizer.offline.alignment import (
    align_syllables,
    align_text,
    drop_pauses,
    find_syllable_times,
)
from kouxing.shared.phones.events import Phone
from kouxing.shared.phones.inventory import load_inventory
from kouxing.shared.phones.phone_files import format_phones
from tests import lips
from tests.system import DEMO, VOWELS_FILE, samples_of_file

AFTER_A_PAUSE = np.append(np.zeros(48_000, np.float32), samples_of_file(DEMO / "hello-female.wav"))


@pytest.fixture(scope="module")
def vowels() -> list[Phone]:
    return align_text(load_model(), samples_of_file(VOWELS_FILE), "啊，喔，鹅，衣，乌，迂。")


def test_all_phones_in_order_without_gaps(vowels: list[Phone]) -> None:
    symbols = [phone.symbol for phone in drop_pauses(vowels, load_inventory())]
    assert symbols == ["a", "o", "e", "i", "u", "v"]
    for vowel, following in pairwise(vowels):
        assert vowel.end_s == pytest.approx(following.onset_s)
    assert vowels[0].onset_s == pytest.approx(0.0075)


PHONES = [
    lips.phone(0, "n", 0.25, 0.1),
    lips.phone(1, "i", 0.35, 0.2),
    lips.phone(2, "sil", 0.8, 0.3),
]


def test_alignments_are_written_as_csv_json_table_and_textgrid() -> None:
    rows = list(csv.DictReader(io.StringIO(format_phones(PHONES, "csv", 1.0))))
    assert [(row["phone"], row["onset_s"]) for row in rows][:2] == [("n", "0.25"), ("i", "0.35")]
    read = json.loads(format_phones(PHONES, "json", 1.0))
    assert read["total_s"] == 1.0
    assert read["phones"][0] == {
        "index": 0, "phone": "n", "onset_s": 0.25, "duration_s": 0.1, "confidence": 1.0,
    }  # fmt: skip
    table = format_phones(PHONES, "table", 1.0).splitlines()
    assert [line.split() for line in table[1:2]] == [["0.250", "0.100", "n", "1.00"]]
    lines = format_phones(PHONES, "textgrid", 1.0).splitlines()
    assert lines[:2] == ['File type = "ooTextFile"', 'Object class = "TextGrid"']
    assert [line.split('"')[1] for line in lines if "text =" in line] == ["", "n", "i", ""]
    starts = [float(line.split("=")[1]) for line in lines if line.startswith("            xmin")]
    ends = [float(line.split("=")[1]) for line in lines if line.startswith("            xmax")]
    assert (starts, ends[-1]) == ([0.0, *ends[:-1]], 1.0)


def test_rejects_a_text_that_does_not_fit(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "wrong.txt").write_text("今天是2024年10月1日，Mike走了", encoding="utf-8")
    output = tmp_path / "said.csv"
    with pytest.raises(typer.Exit) as ended:
        align(VOWELS_FILE, str(tmp_path / "wrong.txt"), output=output)
    assert ended.value.exit_code == 1
    errors = capsys.readouterr().err
    assert "ignored: 'Mike'" in errors
    assert "does not fit" in errors
    assert output.is_file()


@cache
def scores_after_a_pause() -> NDArray[np.float32]:
    """Return the scores of a sentence after 3 s of silence, which several tests align."""
    return alignment._score_recording(
        load_model(), AFTER_A_PAUSE, count_frames(len(AFTER_A_PAUSE)), iter
    )


@pytest.mark.parametrize(
    ("text", "fits"),
    [
        ("你好，欢迎来到口型。你听到的每一个字，都由我的脸实时说出来。", True),
        ("你好，欢迎来到口型。你听到的每一个字，", False),
        ("你好，欢迎来到口型。今天天气不错，我们一起去公园散步吧。", False),
        ("ni3 hao3 huan1 ying2 lai2 dao4 kou3 xing2 nǐ tīng dào de měi yí gè zì dōu yóu wǒ de"
         " liǎn shí shí shuō chū lái", True),
    ],
)  # fmt: skip
def test_the_fit_shows_whether_the_text_was_spoken(
    monkeypatch: pytest.MonkeyPatch, text: str, *, fits: bool
) -> None:
    scores, model = scores_after_a_pause(), load_model()
    monkeypatch.setattr(alignment, "_score_recording", lambda *_: scores)
    syllables = model.inventory.pronounce(text)
    assert align_syllables(model, AFTER_A_PAUSE, syllables).fits is fits, "pauses do not count"


def test_a_known_text_has_tiers_for_characters_syllables_and_phones() -> None:
    transcript = load_inventory().read("你好")
    symbols = ["sil", "n", "i", "sil", "h", "ao"]
    aligned = [lips.phone(i, symbol, 0.1 * i, 0.1) for i, symbol in enumerate(symbols)]
    syllables = find_syllable_times(aligned, transcript, load_inventory())
    lines = format_phones(aligned, "textgrid", 0.7, syllables).splitlines()
    assert "size = 3" in lines
    names = [line.split('"')[1] for line in lines if "name =" in line]
    assert names == ["characters", "syllables", "phones"]
    texts = [line.split('"')[1] for line in lines if "text =" in line]
    assert texts == [
        "", "你", "", "好", "", "", "ni3", "", "hao3", "", "", "n", "i", "", "h", "ao", "",
    ]  # fmt: skip
    table = [
        line.split()[2:] for line in format_phones(aligned, "table", 0.7, syllables).split("\n")
    ]
    assert table[:3] == [
        ["phone", "confidence", "syllable", "text"],
        ["n", "1.00", "ni3", "你"],
        ["i", "1.00"],
    ]
    rows = csv.DictReader(io.StringIO(format_phones(aligned, "csv", 0.7, syllables)))
    assert [row["syllable"] + row["text"] for row in rows] == ["ni3你"] * 2 + ["hao3好"] * 2
    read = json.loads(format_phones(aligned, "json", 0.7, syllables))
    assert read["syllables"][1] == {
        "text": "好", "spelling": "hao3", "onset_s": 0.4, "duration_s": 0.2,
    }  # fmt: skip
