"""Listening tests: orders, studies, answers on disk, and statistics."""

import itertools
import json
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from kouxing.evaluation.head_videos import join_recordings
from kouxing.evaluation.mos.commands import app
from kouxing.evaluation.mos.report import mean_of, opinion_of
from kouxing.evaluation.mos.store import FILE_NAME as ANSWERS
from kouxing.evaluation.mos.store import Answer, AnswerStore, read_answers
from kouxing.evaluation.mos.study import FILE_NAME, load_study, new_study, williams_design
from kouxing.shared.clock import MEDIA_RATE_HZ
from kouxing.shared.errors import UserError

CONDITIONS = ("reference", "live", "late", "anchor")
SENTENCES = tuple("abcdefgh")


@pytest.fixture
def folder(tmp_path: Path, video: Path) -> Path:
    """Return a folder with a video of every sentence in every condition."""
    for sentence, condition in itertools.product(SENTENCES, CONDITIONS):
        path = tmp_path / condition / f"{sentence}.mp4"
        path.parent.mkdir(exist_ok=True)
        path.hardlink_to(video)
    return tmp_path


@pytest.mark.parametrize("n", range(1, 9))
def test_every_condition_follows_every_other_equally_often(n: int) -> None:
    design = williams_design(n)
    assert len(design) == (n if n % 2 == 0 or n == 1 else 2 * n)
    for place in design.T:
        assert set(Counter(place.tolist()).values()) == {len(design) // n}
    pairs = Counter(pair for row in design.tolist() for pair in itertools.pairwise(row))
    assert set(pairs) == set(itertools.permutations(range(n), 2))
    assert len(set(pairs.values())) <= 1


def test_recordings_fill_a_minute_with_equal_pauses() -> None:
    second = np.ones(MEDIA_RATE_HZ, np.float32)
    joined = join_recordings([np.tile(second, 20), np.tile(second, 10)])
    starts = np.flatnonzero(np.diff(joined) > 0) + 1
    ends = np.flatnonzero(np.diff(joined) < 0) + 1
    assert len(joined) == 60 * MEDIA_RATE_HZ
    assert (starts / MEDIA_RATE_HZ).tolist() == [10.0, 40.0]
    assert (ends / MEDIA_RATE_HZ).tolist() == [30.0, 50.0]
    with pytest.raises(UserError, match=r"the recordings last 59.0 s; use at most 58.8 s"):
        join_recordings([np.tile(second, 59)])


def test_videos_of_heads_do_not_replace_a_study(folder: Path) -> None:
    new_study(folder)
    result = CliRunner().invoke(app, ["heads", str(folder), "speech.wav"])
    assert isinstance(result.exception, UserError)
    assert "answers may refer to it; use another folder" in str(result.exception)


def test_rejects_a_study_with_gaps(folder: Path) -> None:
    (folder / "late" / "c.mp4").unlink()
    with pytest.raises(UserError, match="sentence 'c' has no video in condition 'late'"):
        new_study(folder)


@pytest.mark.parametrize("file", ["../secret.mp4", "/etc/hostname", "live/link.mp4", FILE_NAME])
def test_rejects_videos_outside_the_study(tmp_path: Path, file: str) -> None:
    (tmp_path / "secret.mp4").touch()
    folder = tmp_path / "study"
    (folder / "live").mkdir(parents=True)
    (folder / "live" / "link.mp4").symlink_to(tmp_path / "secret.mp4")
    content = {"videos": [file]}
    (folder / FILE_NAME).write_text(json.dumps(content))
    with pytest.raises(UserError, match="not a video inside"):
        load_study(folder)


def answers_of(judge: int, place: int, condition: str, score: int, sentence: str) -> list[Answer]:
    return [
        Answer(judge, place, sentence, condition, scale, score, "zh", 0.0)
        for scale in ("realism", "sync")
    ]


def test_the_file_is_private_and_has_one_writer(tmp_path: Path) -> None:
    assert read_answers(tmp_path) == []
    (tmp_path / ANSWERS).touch(mode=0o644)
    store = AnswerStore(tmp_path)
    assert (tmp_path / ANSWERS).stat().st_mode & 0o777 == 0o600
    with pytest.raises(UserError, match="another process"):
        AnswerStore(tmp_path)
    store.close()
    AnswerStore(tmp_path).close()


@pytest.mark.parametrize("line", ['{"token": "a"}', '{"judge": 0}', "[]", "5"])
def test_an_edited_answer_is_an_error_in_the_file(tmp_path: Path, line: str) -> None:
    (tmp_path / ANSWERS).write_text(f"{line}\n")
    with pytest.raises(UserError, match=f"{ANSWERS}: the file is damaged"):
        AnswerStore(tmp_path)


def scores_of(*by_judge: list[int]) -> dict[tuple[int, str], int]:
    return {
        (judge, SENTENCES[number]): score
        for judge, scores in enumerate(by_judge)
        for number, score in enumerate(scores)
    }


def test_intervals_are_over_judges() -> None:
    # The judges' means are 3, 4 and 5: deviation 1, t(0.975, 2) = 4.3027.
    opinion = opinion_of("sync", "live", scores_of([3, 3], [4, 4], [5, 5]))
    assert opinion.of_all.value == pytest.approx(4.0)
    assert opinion.of_all.half_width == pytest.approx(4.3027 / np.sqrt(3), abs=1e-4)
    assert (opinion.num_judges, opinion.num_scores, opinion.num_outliers) == (3, 6, 0)
    # Mean 3.8; the sums exceed 2, 2 and 1 times that by -1.6, 0.4 and 1.2: squares 4.16 in all.
    mean = mean_of(scores_of([3, 3], [4, 4], [5]))
    assert mean.value == pytest.approx(3.8)
    assert mean.half_width == pytest.approx(4.3027 * np.sqrt(1.5 * 4.16) / 5, abs=1e-4)
    assert mean_of(scores_of([3, 4])).half_width is None


def test_the_commands_report_what_judges_scored(folder: Path) -> None:
    run = CliRunner().invoke
    assert run(app, ["new", str(folder)]).exit_code == 0
    assert "exists, and answers" in str(run(app, ["new", str(folder)]).exception)
    report = ["report", str(folder)]
    assert f"kouxing mos serve {folder}" in str(run(app, report).exception)
    study, given = load_study(folder), {"reference": 5, "live": 4, "late": 3, "anchor": 1}
    cells = [(judge, cell) for judge in range(2) for cell in sorted(study.files)]
    store = AnswerStore(folder)
    for place, (judge, (sentence, condition)) in enumerate(cells[:-1]):
        store.add(answers_of(judge, place, condition, given[condition], sentence))
    store.add(answers_of(1, -1, "reference", 1, "a"))
    store.close()
    result = run(app, [*report, "--json", str(folder / "figures.json")])
    assert result.exit_code == 0, result.output
    assert "5.00" in result.output
    figures = json.loads((folder / "figures.json").read_text())
    means = {item["condition"]: item["of_all"]["value"] for item in figures["opinions"]}
    assert means == pytest.approx(given)
    exported = run(app, ["export", str(folder), "-o", str(folder / "scores.csv")])
    assert exported.stderr == f"wrote {folder / 'scores.csv'}\n"
    head, first, *_, last = (folder / "scores.csv").read_text().splitlines()
    assert head == "judge,place,sentence,condition,scale,score,language,unix_s,practice"
    assert first == "0,0,a,anchor,realism,1,zh,0.0,False"
    assert last == "1,-1,a,reference,sync,1,zh,0.0,True"
