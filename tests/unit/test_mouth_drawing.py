"""``kouxing lips``: the 2-D mouth of a sound."""

import csv
from pathlib import Path
from xml.etree import ElementTree

import av
import numpy as np
import pytest
import soundfile
from typer.testing import CliRunner

from kouxing.services.cli.main import app
from kouxing.services.cli.options import TimingMethod, WidthSource
from kouxing.services.cli.recordings.commands import lips
from kouxing.services.cli.recordings.mouth_drawing import CSV_COLUMNS, NUM_POINTS, draw_mouth
from kouxing.services.driver import picture
from kouxing.services.synthesizer.lips.ferguson.contour import LINES, contour
from kouxing.services.synthesizer.lips.ferguson.drawing import LabeledMouth, draw_strip
from kouxing.shared.errors import UserError
from kouxing.shared.fonts import text_runs
from tests.system import VOWELS_FILE, samples_of_file

SOUND = Path(__file__).parents[2] / "shared" / "demo" / "fast-female.wav"
NUM_FRAMES = 124  # of 4.925 s
TEXT = "四是四，十是十，十四是十四，四十是四十。"


def test_table_holds_the_contour_of_every_frame(tmp_path: Path) -> None:
    output = tmp_path / "mouth.csv"
    draw_mouth(SOUND, TEXT, output, lips=WidthSource.FERGUSON)
    with output.open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert tuple(rows[0]) == CSV_COLUMNS
    assert len(rows) == NUM_FRAMES * len(LINES) * NUM_POINTS
    last = rows[-1]
    assert (last["line"], last["point"], last["phone"]) == ("outer lower", str(NUM_POINTS - 1), "")
    assert {"s", "ii", "sh", "iii"} <= {row["phone"] for row in rows}
    widest = max(rows, key=lambda row: float(row["opening"]))
    first = next(row for row in rows if row["time_s"] == widest["time_s"])
    at = rows.index(first)
    heights = [float(row["y"]) for row in rows[at : at + 4 * NUM_POINTS]]
    expected = contour([float(widest["opening"])], NUM_POINTS)[0, :, :, 1].ravel()
    np.testing.assert_allclose(heights, expected, atol=1e-4)


def test_picture_and_svg_show_every_key_frame(tmp_path: Path) -> None:
    for name in ("mouth.svg", "mouth.png"):
        draw_mouth(SOUND, TEXT, tmp_path / name, lips=WidthSource.FERGUSON)
    root = ElementTree.parse(tmp_path / "mouth.svg").getroot()  # noqa: S314 - our own
    texts = [element.text for element in root if element.tag.endswith("text")]
    assert texts.count("四 sì") == texts.count("十 shí") == 6
    assert texts.count("是 shì") == 4
    assert texts.count("i") == 16
    pixels = picture.decode((tmp_path / "mouth.png").read_bytes(), "mouth.png")
    assert pixels.shape[:2] == (int(root.attrib["height"]), int(root.attrib["width"]))


def test_long_words_stay_in_the_picture_and_apart() -> None:
    words = ["vermittelt fɛʁmɪtəlt", "", "a ə", "Fußgängerübergänge fʊsɡɛŋeʁybɐɡɛŋə"]
    strip = draw_strip([LabeledMouth(0.0, 0.1, "a", word) for word in words], 4, 100.0)
    spans = [
        (label.x if label.anchor == "start" else label.x - 0.5 * width, width)
        for label in strip.labels
        if label.text in words
        for width in [
            sum(font.getlength(text) for text, font in text_runs(label.text, label.size_px))
        ]
    ]
    ends = [left + width for left, width in spans]
    assert all(left >= end for (left, _), end in zip(spans, [0.0, *ends[:-1]], strict=True))
    assert ends[-1] <= strip.width_px


def test_video_has_sound_and_an_image_for_every_frame(tmp_path: Path) -> None:
    vowels = tmp_path / "vowels.wav"
    soundfile.write(vowels, samples_of_file(VOWELS_FILE)[:18_000], 16_000)
    draw_mouth(vowels, "a1 o1 e2", tmp_path / "mouth.mp4")
    with av.open(str(tmp_path / "mouth.mp4")) as container:
        assert container.streams.audio
        images = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    assert len(images) == 29  # of 1.125 s
    gap = [int((image[:, 320].sum(axis=1) < 200).sum()) for image in images]  # dark rows
    assert gap[0] < 10
    assert max(gap) > 20


@pytest.mark.parametrize(("text", "fits"), [(TEXT, True), ("四是四", False), (5 * TEXT, False)])
def test_reports_a_text_that_does_not_fit(tmp_path: Path, text: str, fits: bool) -> None:
    arguments = ["lips", str(SOUND), text, str(tmp_path / "mouth.csv"), "--lips", "ferguson"]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == (0 if fits else 1)
    assert ("the text does not fit the audio" not in result.output) == fits
    assert (tmp_path / "mouth.csv").exists()


@pytest.mark.parametrize(
    ("text", "output", "timing", "message"),
    [
        (TEXT, "mouth.gif", None, "ends in .svg, .png, .mp4, .csv"),
        (None, "mouth.svg", TimingMethod.ALIGN, "--timing needs a text"),
        ("", "mouth.svg", None, "text is empty"),
    ],
)
def test_errors_name_the_mistake(
    tmp_path: Path, text: str | None, output: str, timing: TimingMethod | None, message: str
) -> None:
    with pytest.raises(UserError, match=message):
        draw_mouth(SOUND, text, tmp_path / output, timing=timing)
    assert not list(tmp_path.iterdir())


def test_words_without_quotes_are_rejected(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="in quotes"):
        lips(SOUND, ["si4", "shi4", str(tmp_path / "mouth.svg")])
