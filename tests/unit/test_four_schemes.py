"""The four schemes of Li et al. 2011: sentences, measures and one small run."""

import json
from pathlib import Path
from unittest.mock import Mock

import pytest
import soundfile
from typer.testing import CliRunner

from kouxing.evaluation.commands import app
from kouxing.evaluation.lips.four_schemes import LIVE as LIVE_SCHEME
from kouxing.evaluation.lips.four_schemes import (
    RECOGNIZED,
    Condition,
    RecognizedSentence,
    RecognizerOutput,
    delay_by_one_phone,
    make_frames,
    without_corrections,
)
from kouxing.services.lip_models import lip_model_info
from kouxing.services.recording_pipeline import AnalyzedRecording
from kouxing.services.synthesizer.config import SynthesizerConfig
from kouxing.shared.audio.audio_file import check_video
from kouxing.shared.face.faps import FAP_NUMBER
from kouxing.shared.phones.events import Phone, Progress, SoundEvent, SpeechChange
from tests.corpora import write_manifest
from tests.lips import phone
from tests.system import DEMO

# The rule emits b, then a, then t instead of a, then i; the search makes d of t, and puts an h
# between. At the end of speech i is withdrawn.
LIVE: list[SoundEvent] = [
    phone(0, "b", 0.0, 0.1, final=False),
    Progress(time_s=0.04, level_db=-20.0),
    phone(0, "b", 0.0, 0.06, final=False),
    phone(1, "a", 0.06, 0.13, final=False),
    Progress(time_s=0.1, level_db=-20.0),
    phone(0, "p", 0.0, 0.08, final=True),
    phone(1, "t", 0.08, 0.1, final=False),
    Progress(time_s=0.12, level_db=-20.0),
    phone(1, "h", 0.08, 0.05, final=False),
    phone(2, "d", 0.13, 0.07, final=False),
    phone(3, "i", 0.2, 0.11, final=False),
    Progress(time_s=0.24, level_db=-20.0),
    phone(1, "sil", 0.08, 0.0, final=True),
    phone(2, "h", 0.08, 0.05, final=True),
    phone(3, "d", 0.13, 0.12, final=True),
    SpeechChange(active=False, time_s=0.25),
]


def phones_of(events: list[SoundEvent]) -> list[tuple[str, float, float]]:
    phones = [event for event in events if isinstance(event, Phone)]
    indices = [event.index for event in phones]
    assert indices == sorted(set(indices)), "no phone is corrected"
    assert [event for event in events if not isinstance(event, Phone)] == [
        event for event in LIVE if not isinstance(event, Phone)
    ]
    return [(event.symbol, event.onset_s, event.duration_s) for event in phones]


def test_the_papers_rule_corrects_nothing() -> None:
    changed = without_corrections(LIVE)
    assert phones_of(changed) == [
        ("b", 0.0, 0.1),
        ("a", 0.06, 0.13),
        ("t", 0.08, 0.1),
        ("i", 0.2, 0.11),
    ]
    assert changed.index(Progress(time_s=0.12, level_db=-20.0)) == 5, "i comes after it"


def test_scheme_4_delays_each_phone_by_one() -> None:
    changed = delay_by_one_phone(LIVE)
    assert phones_of(changed) == [("b", 0.0, 0.06), ("d", 0.13, 0.07)]
    assert changed[1:3] == [
        phone(0, "b", 0.0, 0.06, final=False),
        Progress(time_s=0.1, level_db=-20.0),
    ]
    assert isinstance(changed[-1], SpeechChange)


@pytest.mark.parametrize("scheme", [RECOGNIZED, LIVE_SCHEME])
def test_every_scheme_shows_the_feeling_of_the_voice(scheme: int) -> None:
    events: list[SoundEvent] = [SpeechChange(active=True, time_s=0.0)]
    events += [Progress(time_s=0.02 * k, level_db=-20.0, arousal=1.0) for k in range(1, 50)]
    delay_s = lip_model_info("learned").delay_ms / 1e3
    offline = AnalyzedRecording(duration_s=1.0, events=events, is_text_known=False)
    output = RecognizerOutput(offline, {delay_s: events}, uses_paper_rule=False)
    sentence = RecognizedSentence(Mock(), None, {"blocks": output})

    def brow(feeling: float) -> float:
        config = SynthesizerConfig(idle_motion=False, feeling=feeling)
        frames = make_frames(Condition(scheme, "learned", "blocks"), sentence, config)
        assert frames is not None
        return max(float(faps[FAP_NUMBER["raise_l_m_eyebrow"] - 1]) for _, faps in frames)

    assert brow(0.0) == 0.0
    assert brow(1.0) > 20.0


def test_the_command_scores_and_films_a_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("kouxing.evaluation.lips.scheme_videos.VIDEO_PX", (64, 64))
    samples, rate_hz = soundfile.read(DEMO / "hello-female.wav", frames=11_200)
    soundfile.write(tmp_path / "hello.wav", samples, rate_hz)
    row = "hello\thello.wav\tA\ttest\t你好"
    write_manifest(tmp_path, "utt_id path speaker split text", [row])
    videos = tmp_path / "videos"
    conditions = ["scheme1-learned", *(f"scheme{number}-learned-blocks" for number in (2, 3, 4))]
    for name in conditions[1:]:
        (videos / name).mkdir(parents=True)
        (videos / name / "hello.mp4").write_bytes(b"made before")
    arguments = ["schemes", "--manifest", str(tmp_path)]
    arguments += ["--acoustic", "blocks", "--lips", "learned"]
    outputs = ["--videos", str(videos), "--json", str(tmp_path / "figures.json")]
    result = CliRunner().invoke(app, [*arguments, *outputs], catch_exceptions=False)
    assert result.exit_code == 0, result.output

    assert sorted(path.parent.name for path in videos.glob("*/hello.mp4")) == conditions
    check_video(videos / conditions[0] / "hello.mp4")
    for name in conditions[1:]:
        assert (videos / name / "hello.mp4").read_bytes() == b"made before", "it is kept"
    figures = json.loads((tmp_path / "figures.json").read_text(encoding="utf-8"))
    bound, from_phones, live, next_phone = figures["scores"]
    assert bound["like_scheme_1"]["correlation"]["opening"] == pytest.approx(1.0)
    assert bound["like_scheme_1"]["lag_ms"] == 0
    assert bound["face_delay_ms"] is bound["phone_delay_p50_ms"] is None
    assert from_phones["phone_delay_p50_ms"] is None
    assert 0.0 < live["phone_delay_p50_ms"] < next_phone["phone_delay_p50_ms"]
    assert live["face_delay_ms"] == 60.0
    assert 0.5 < live["like_scheme_1"]["correlation"]["opening"] < 1.0
    assert all(
        score["jerk"] > 0.0 and score["like_real_lips"] is None for score in figures["scores"]
    )
    assert "r with scheme 1" in " ".join(result.output.split())
