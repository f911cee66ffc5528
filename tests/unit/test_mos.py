"""Listening tests: orders, what a study is, answers on disk, and what scores say."""

from __future__ import annotations

import io
import itertools
import json
import wave
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console
from scipy import stats
from typer.testing import CliRunner

from evaluation.mos.beeps import make_beeps
from evaluation.mos.commands import app
from evaluation.mos.order import order_of_judge, williams_design
from evaluation.mos.report import draw_boxes, make_report, print_report, to_csv
from evaluation.mos.statistics import compare_all, holm, is_within_fences, opinion_of
from evaluation.mos.store import Answer, Store
from evaluation.mos.study import FILE_NAME, load_study, new_study
from shared.errors import UserError

pytestmark = pytest.mark.unit

CONDITIONS = ("real", "live", "late", "still")
SENTENCES = tuple("abcdefgh")


def make_videos(folder: Path) -> Path:
    for sentence, condition in itertools.product(SENTENCES, CONDITIONS):
        path = folder / condition / f"{sentence}.mp4"
        path.parent.mkdir(exist_ok=True)
        path.touch()
    return folder


@pytest.mark.parametrize("n", range(2, 9))
def test_every_condition_follows_every_other_equally_often(n: int) -> None:
    design = williams_design(n)
    assert len(design) == (n if n % 2 == 0 else 2 * n)
    for place in design.T:
        assert set(Counter(place.tolist()).values()) == {len(design) // n}
    followed = Counter(pair for row in design.tolist() for pair in itertools.pairwise(row))
    assert set(followed) == set(itertools.permutations(range(n), 2))
    assert set(followed.values()) == {len(design) // n}


def test_one_condition_needs_no_design() -> None:
    assert williams_design(1).tolist() == [[0]]


@pytest.mark.parametrize("num_conditions", [1, 2, 3, 4])
@pytest.mark.parametrize("num_sentences", [1, 3, 8])
def test_a_judge_sees_every_video_once(num_conditions: int, num_sentences: int) -> None:
    sentences, conditions = SENTENCES[:num_sentences], CONDITIONS[:num_conditions]
    everything = sorted(itertools.product(sentences, conditions))
    for judge in range(9):
        order = order_of_judge(judge, sentences, conditions)
        assert sorted(order) == everything
        assert order == order_of_judge(judge, sentences, conditions)


def test_judges_in_a_row_see_every_condition_equally_often_at_every_place() -> None:
    orders = [order_of_judge(judge, SENTENCES, CONDITIONS) for judge in range(4, 8)]
    for cells in zip(*orders, strict=True):
        assert {condition for _, condition in cells} == set(CONDITIONS)
    assert len({tuple(order) for order in orders}) == 4


def test_conditions_follow_each_other_nearly_equally_often_across_blocks() -> None:
    sentences = tuple(map(str, range(20)))
    followed = Counter(
        (before, after)
        for judge in range(4)
        for (_, before), (_, after) in itertools.pairwise(
            order_of_judge(judge, sentences, CONDITIONS)
        )
        if before != after
    )
    assert len(followed) == 12
    assert max(followed.values()) < 1.5 * min(followed.values())


def test_a_sentence_returns_late() -> None:
    for judge in range(8):
        sentences = [sentence for sentence, _ in order_of_judge(judge, SENTENCES, CONDITIONS)]
        for block in range(0, len(sentences) - 4, 4):
            assert len(set(sentences[block : block + 8])) == 8


def test_a_study_is_found_by_folders_and_by_names(tmp_path: Path) -> None:
    folder = make_videos(tmp_path)
    made = new_study(folder, title="头", reference="real", anchor="still", languages=("zh",))
    assert made == load_study(folder)
    assert (made.sentences, set(made.conditions)) == (SENTENCES, set(CONDITIONS))
    flat = tmp_path / "flat"
    flat.mkdir()
    for name in ("my_hello_live.mp4", "my_hello_late.webm", "notes_live.txt"):
        (flat / name).touch()
    study = new_study(flat, title="", reference="", anchor="", languages=("zh", "en"))
    assert list(study.files) == [("my_hello", "late"), ("my_hello", "live")]
    assert study.title == "flat"


def test_a_study_is_not_made_twice_nor_of_holes(tmp_path: Path) -> None:
    folder = make_videos(tmp_path)
    with pytest.raises(UserError, match="no condition 'ideal'"):
        new_study(folder, title="", reference="ideal", anchor="", languages=("zh",))
    (folder / "late" / "c.mp4").unlink()
    with pytest.raises(UserError, match="no video of sentence 'c' in condition 'late'"):
        new_study(folder, title="", reference="", anchor="", languages=("zh",))
    (folder / "late" / "c.mp4").touch()
    new_study(folder, title="", reference="", anchor="", languages=("zh",))
    with pytest.raises(UserError, match="is there already"):
        new_study(folder, title="", reference="", anchor="", languages=("zh",))


@pytest.mark.parametrize("file", ["../secret.mp4", "/etc/hostname", "live/link.mp4", FILE_NAME])
def test_nothing_outside_the_study_is_a_video(tmp_path: Path, file: str) -> None:
    (tmp_path / "secret.mp4").touch()
    folder = tmp_path / "study"
    (folder / "live").mkdir(parents=True)
    (folder / "live" / "a.mp4").touch()
    (folder / "live" / "link.mp4").symlink_to(tmp_path / "secret.mp4")
    content = {"title": "", "languages": ["en"], "reference": "", "anchor": ""}
    stimuli = [{"sentence": "a", "condition": "live", "file": file}]
    (folder / FILE_NAME).write_text(json.dumps({**content, "stimuli": stimuli}))
    with pytest.raises(UserError, match="no video below"):
        load_study(folder)


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"stimuli": 3}', '{"stimuli": [{}]}'])
def test_what_is_no_study_is_a_clear_error(tmp_path: Path, text: str) -> None:
    (tmp_path / FILE_NAME).write_text(text)
    with pytest.raises(UserError, match="this is no study"):
        load_study(tmp_path)


def test_the_first_answer_counts_and_stays(tmp_path: Path) -> None:
    store = Store(tmp_path)
    judge = store.find_judge(store.add_judge() or "")
    assert judge is not None
    store.add(judge, "a", "live", {"sync": 4, "realism": 2})
    store.add(judge, "a", "live", {"sync": 1, "realism": 1})
    store.close()
    again = Store(tmp_path)
    scores = [(each.scale, each.score) for each in again.answers()]
    assert scores == [("realism", 2), ("sync", 4)]
    assert again.answered(judge) == {("a", "live")}
    assert again.find_judge("") is None
    again.close()


def test_answers_are_their_owners_alone(tmp_path: Path) -> None:
    (tmp_path / "answers.sqlite").touch(mode=0o644)
    for folder in (tmp_path, tmp_path / "new"):
        folder.mkdir(exist_ok=True)
        store = Store(folder)
        store.add_judge()
        rights = {path.name: path.stat().st_mode & 0o777 for path in folder.glob("answers.*")}
        store.close()
        assert rights == {f"answers.sqlite{end}": 0o600 for end in ("", "-wal", "-shm")}


def test_only_who_counts_the_beeps_hears(tmp_path: Path) -> None:
    store = Store(tmp_path)
    token = store.add_judge() or ""
    deaf = store.find_judge(token)
    assert deaf is not None
    store.check_sound(deaf, deaf.beeps + 1)
    still = store.find_judge(token)
    assert still is not None
    assert not still.hears
    store.check_sound(still, still.beeps)
    hearing = store.find_judge(token)
    assert hearing is not None
    assert hearing.hears
    store.close()


def test_as_many_beeps_as_told() -> None:
    with wave.open(io.BytesIO(make_beeps(3))) as file:
        samples = np.frombuffer(file.readframes(file.getnframes()), "<i2")
        loud = np.abs(samples.reshape(-1, file.getframerate() // 10)).max(axis=1) > 1000
    assert np.count_nonzero(np.diff(loud.astype(int)) == 1) == 3


def test_outliers_are_beyond_the_fences_of_the_quartiles() -> None:
    # Quartiles 3 and 4, so the fences are 1.5 and 5.5: by hand.
    scores = [1, 2, 3, 3, 3, 3, 4, 4, 4, 4, 4, 5]
    assert is_within_fences(scores).tolist() == [False] + [True] * 11


def test_fences_between_scores() -> None:
    # Quartiles 2 and 4.25 by linear interpolation, fences -1.375 and 7.625.
    assert is_within_fences([1, 2, 2, 4, 5, 9]).tolist() == [True] * 5 + [False]


def scores_of(*by_judge: list[int]) -> dict[tuple[int, str], int]:
    return {
        (judge, SENTENCES[number]): score
        for judge, scores in enumerate(by_judge)
        for number, score in enumerate(scores)
    }


def test_mean_and_confidence_over_judges() -> None:
    # The judges' means are 3, 4 and 5: deviation 1, t(0.975, 2) = 4.3027.
    opinion = opinion_of("sync", "live", scores_of([3, 3], [4, 4], [5, 5]))
    assert opinion.mos == pytest.approx(4.0)
    assert opinion.half_width == pytest.approx(4.3027 / np.sqrt(3), abs=1e-4)
    assert (opinion.num_judges, opinion.num_scores, opinion.num_outliers) == (3, 6, 0)
    assert opinion_of("sync", "live", scores_of([3, 4])).half_width is None


def test_a_judge_who_left_early_counts_little() -> None:
    # Mean 3.8; the sums exceed 2, 2 and 1 times that by -1.6, 0.4 and 1.2: squares 4.16 in all.
    opinion = opinion_of("sync", "live", scores_of([3, 3], [4, 4], [5]))
    assert opinion.mos == pytest.approx(3.8)
    assert opinion.half_width == pytest.approx(4.3027 * np.sqrt(1.5 * 4.16) / 5, abs=1e-4)
    alone = opinion_of("sync", "live", scores_of([3, 4], [4, 3]))
    assert alone.half_width == 0.0


def test_an_outlier_does_not_count() -> None:
    opinion = opinion_of("sync", "live", scores_of([4, 4, 4, 5], [4, 5, 5, 1]))
    assert opinion.num_outliers == 1
    assert opinion.mos == pytest.approx(31 / 7)


def test_holms_correction() -> None:
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm([0.6, 0.9]) == [1.0, 1.0]
    assert holm([]) == []


def test_conditions_are_compared_in_pairs() -> None:
    better = [[5, 4], [5, 5], [4, 4], [5, 4], [5, 5], [4, 3], [5, 4], [4, 5]]
    worse = [[3, 3], [2, 3], [3, 2], [2, 2], [1, 2], [3, 3], [3, 2], [2, 3]]
    groups = {
        "real": scores_of(*better),
        "live": scores_of(*worse),
        "late": scores_of(*worse),
    }
    first, second, third = compare_all("sync", groups)
    assert first.conditions == ("real", "live")
    assert first.num_judges == 8, "each counts once, however many sentences were judged"
    assert first.difference == pytest.approx(np.mean(better) - np.mean(worse))
    alone = stats.wilcoxon(np.mean(np.subtract(better, worse), axis=1)).pvalue
    assert first.p == second.p == pytest.approx(3 * alone)
    assert third.p == 1.0


def test_a_report_of_scripted_scores(tmp_path: Path) -> None:
    folder = make_videos(tmp_path)
    study = new_study(folder, title="", reference="real", anchor="still", languages=("en",))
    with pytest.raises(UserError, match="nobody has judged"):
        make_report(study, [])
    given = {"real": 5, "live": 4, "late": 3, "still": 1}
    answers = [
        Answer(judge, sentence, condition, scale, 6 - score if judge == 2 else score, 0.0)
        for judge in range(3)
        for sentence, (condition, score) in itertools.product(SENTENCES, given.items())
        for scale in ("sync", "realism")
    ][:-1]
    report = make_report(study, answers)
    assert [each.condition for each in report.opinions[:4]] == [*study.conditions]
    assert (report.num_judges, report.num_finished, report.unsure) == (3, 2, [2])
    text = io.StringIO()
    print_report(study, report, Console(file=text, width=100))
    assert "real (hidden reference)" in text.getvalue()
    narrow = io.StringIO()
    print_report(study, report, Console(file=narrow, width=60))
    assert "…" not in narrow.getvalue(), "no name is cut"
    assert "still (anchor)" in text.getvalue()
    assert to_csv(answers[:1]) == (
        "judge,sentence,condition,scale,score,unix_s\n0,a,real,sync,5,0.000\n"
    )
    figure = draw_boxes(study, answers)
    assert [axes.get_title() for axes in figure.axes] == ["sync", "realism"]


def test_commands_work_together(tmp_path: Path) -> None:
    folder = make_videos(tmp_path)
    made = CliRunner().invoke(app, ["new", str(folder), "--reference", "real", "--language", "zh"])
    assert made.exit_code == 0
    assert load_study(folder).languages == ("zh",)
    store = Store(folder)
    judge = store.find_judge(store.add_judge() or "")
    assert judge is not None
    store.add(judge, "a", "live", {"sync": 4, "realism": 2})
    store.close()
    exported = CliRunner().invoke(app, ["export", str(folder)])
    assert exported.output.splitlines()[1].startswith("0,a,live,realism,2,")
    files = [tmp_path / "boxes.png", tmp_path / "figures.json"]
    shown = CliRunner().invoke(
        app, ["report", str(folder), "--picture", str(files[0]), "--json", str(files[1])]
    )
    assert shown.exit_code == 0, shown.output
    assert files[0].stat().st_size > 1000
    assert json.loads(files[1].read_text())["opinions"][0]["mos"] == 4.0
