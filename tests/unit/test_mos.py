"""Listening tests: orders, what a study is, answers on disk, and what scores say."""

from __future__ import annotations

import io
import itertools
import json
import time
import wave
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console
from scipy import stats
from typer.testing import CliRunner

from kouxing.evaluation.mos.beeps import make_beeps
from kouxing.evaluation.mos.commands import app
from kouxing.evaluation.mos.order import order_of_judge, places_of_judge, williams_design
from kouxing.evaluation.mos.report import draw_boxes, make_report, print_report, to_csv
from kouxing.evaluation.mos.statistics import (
    compare_all,
    differential_scores,
    holm,
    is_within_fences,
    mean_of,
    opinion_of,
)
from kouxing.evaluation.mos.store import FORGOTTEN_AFTER_S, Answer, Judge, Store, read_answers
from kouxing.evaluation.mos.study import FILE_NAME, Study, load_study, new_study
from kouxing.shared.errors import UserError
from tests.videos import write_video

pytestmark = pytest.mark.unit

CONDITIONS = ("real", "live", "late", "still")
SENTENCES = tuple("abcdefgh")


@pytest.fixture
def folder(tmp_path: Path, video: Path) -> Path:
    """Return a folder of videos of every sentence in every condition."""
    for sentence, condition in itertools.product(SENTENCES, CONDITIONS):
        path = tmp_path / condition / f"{sentence}.mp4"
        path.parent.mkdir(exist_ok=True)
        path.hardlink_to(video)
    return tmp_path


def study_of(folder: Path, reference: str = "", anchor: str = "") -> Study:
    return new_study(folder, title="", reference=reference, anchor=anchor, languages=("zh", "en"))


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


def test_practice_comes_first_and_shows_the_range(folder: Path) -> None:
    study = study_of(folder, reference="real", anchor="still")
    places = places_of_judge(0, study)
    order = order_of_judge(0, SENTENCES, study.conditions)
    assert [*places] == [-2, -1, *range(len(order))]
    assert [places[place] for place in range(len(order))] == order
    assert [places[-2], places[-1]] == [(order[-1][0], "real"), (order[-1][0], "still")]
    (folder / FILE_NAME).unlink()
    places = places_of_judge(0, study_of(folder))
    assert [places[place][1] for place in (-2, -1)] == [*study.conditions[:2]]


def test_a_study_is_found_by_folders_and_by_names(folder: Path, video: Path) -> None:
    made = new_study(folder, title="头", reference="real", anchor="still", languages=("zh",))
    assert made == load_study(folder)
    assert (made.sentences, set(made.conditions)) == (SENTENCES, set(CONDITIONS))
    flat = folder / "flat"
    flat.mkdir()
    for name in ("my_hello_live.mp4", "my_hello_late.webm", "notes_live.txt"):
        (flat / name).hardlink_to(video)
    study = new_study(flat, title="", reference="", anchor="", languages=("zh", "en"))
    assert list(study.files) == [("my_hello", "late"), ("my_hello", "live")]
    assert study.title == "flat"


def test_a_study_is_not_made_twice_nor_of_holes(folder: Path, video: Path) -> None:
    with pytest.raises(UserError, match="no condition 'ideal'"):
        new_study(folder, title="", reference="ideal", anchor="", languages=("zh",))
    (folder / "late" / "c.mp4").unlink()
    with pytest.raises(UserError, match="no video of sentence 'c' in condition 'late'"):
        new_study(folder, title="", reference="", anchor="", languages=("zh",))
    (folder / "late" / "c.mp4").hardlink_to(video)
    new_study(folder, title="", reference="", anchor="", languages=("zh",))
    with pytest.raises(UserError, match="is there already"):
        new_study(folder, title="", reference="", anchor="", languages=("zh",))


def test_a_study_of_some_conditions(folder: Path) -> None:
    (folder / "late" / "c.mp4").unlink()
    chosen = ["new", str(folder), "--condition", "real", "--condition", "live"]
    result = CliRunner().invoke(app, chosen, catch_exceptions=False)
    assert result.exit_code == 0, result.output
    study = load_study(folder)
    assert (set(study.conditions), len(study.files)) == ({"real", "live"}, 16)
    (folder / FILE_NAME).unlink()
    with pytest.raises(UserError, match="no condition 'ideal'; there are late, live, real, still"):
        new_study(
            folder, title="", reference="", anchor="", languages=("zh",), conditions=["ideal"]
        )


def test_what_is_no_video_with_sound_is_named(folder: Path) -> None:
    path = folder / "late" / "c.mp4"
    path.unlink()
    path.write_bytes(b"no video")
    with pytest.raises(UserError, match=r"late/c\.mp4: this is no video"):
        study_of(folder)
    write_video(path, has_sound=False)
    with pytest.raises(UserError, match=r"late/c\.mp4: it needs pictures and sound"):
        study_of(folder)
    assert not (folder / FILE_NAME).exists()


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


def judge_in(store: Store) -> Judge:
    """Return a new judge who has passed the sound check."""
    token = store.add_judge() or ""
    new = store.find_judge(token)
    assert new is not None
    store.check_sound(new, new.beeps)
    judge = store.find_judge(token)
    assert judge is not None
    return judge


def answers_of(judge: Judge, place: int, cell: tuple[str, str], **scores: int) -> list[Answer]:
    assert judge.number is not None
    return [
        Answer(judge.number, place, *cell, scale, score, "en", 0.0)
        for scale, score in scores.items()
    ]


def test_the_first_answer_counts_and_stays(tmp_path: Path) -> None:
    store = Store(tmp_path)
    judge = judge_in(store)
    assert store.last_place(judge) is None
    store.add(answers_of(judge, 0, ("a", "live"), sync=4, realism=2))
    store.add(answers_of(judge, 0, ("a", "live"), sync=1, realism=1))
    store.close()
    again = Store(tmp_path)
    scores = [(each.scale, each.score) for each in read_answers(tmp_path)]
    assert scores == [("realism", 2), ("sync", 4)]
    assert again.last_place(judge) == 0
    assert again.find_judge("") is None
    again.close()


def test_who_does_not_hear_takes_no_row_of_the_design(tmp_path: Path) -> None:
    store = Store(tmp_path)
    for _ in range(3):
        store.add_judge()
    assert [judge_in(store).number for _ in range(3)] == [0, 1, 2]
    store.close()


def test_who_scores_nothing_is_forgotten_and_their_row_is_free(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = Store(tmp_path)
    began, left, scored, practised = (judge_in(store) for _ in range(4))
    store.add(answers_of(practised, -1, ("a", "live"), sync=1, realism=1))
    store.add(answers_of(scored, 0, ("a", "live"), sync=4, realism=2))
    later_s = time.time() + FORGOTTEN_AFTER_S + 60.0
    monkeypatch.setattr("kouxing.evaluation.mos.store.time.time", lambda: later_s)
    assert judge_in(store).number == 0
    assert store.find_judge(scored.token) == scored
    assert [store.find_judge(each.token) for each in (began, left, practised)] == [None] * 3
    assert {each.judge for each in read_answers(tmp_path)} == {scored.number}
    assert [judge_in(store).number for _ in range(3)] == [1, 3, 4]
    store.close()


def test_many_who_only_begin_do_not_shut_the_study(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("kouxing.evaluation.mos.store.MAX_JUDGES", 3)
    store = Store(tmp_path)
    scored, hearing = judge_in(store), judge_in(store)
    store.add(answers_of(scored, 0, ("a", "live"), sync=4, realism=2))
    tokens = [store.add_judge() or "" for _ in range(20)]
    assert [bool(store.find_judge(token)) for token in tokens] == [False] * 19 + [True]
    assert store.find_judge(hearing.token) == hearing, "who began first, but did not hear, goes"
    newest = store.find_judge(tokens[-1])
    assert newest is not None
    store.check_sound(newest, newest.beeps)
    assert store.add_judge(), "one of those who hear and have not scored goes"
    assert store.find_judge(hearing.token) is None
    store.close()


def test_a_study_is_full_of_those_who_scored(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("kouxing.evaluation.mos.store.MAX_JUDGES", 2)
    store = Store(tmp_path)
    for _ in range(2):
        store.add(answers_of(judge_in(store), 0, ("a", "live"), sync=4, realism=2))
    assert store.add_judge() is None
    store.close()


def test_reading_answers_writes_nothing(tmp_path: Path) -> None:
    assert read_answers(tmp_path) == []
    assert list(tmp_path.iterdir()) == []
    store = Store(tmp_path)
    store.add(answers_of(judge_in(store), 0, ("a", "live"), sync=4, realism=2))
    assert len(read_answers(tmp_path)) == 2, "while judges are served, too"
    store.close()
    file = tmp_path / "answers.sqlite"
    before = file.read_bytes()
    assert len(read_answers(tmp_path)) == 2
    assert list(tmp_path.iterdir()) == [file]
    assert file.read_bytes() == before
    file.write_bytes(b"no database")
    with pytest.raises(UserError, match="cannot be read"):
        read_answers(tmp_path)


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
    for add, number in ((1, None), (0, 0)):
        judge = store.find_judge(token)
        assert judge is not None
        store.check_sound(judge, judge.beeps + add)
        after = store.find_judge(token)
        assert after is not None
        assert after.number == number
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
    assert opinion.of_all.value == pytest.approx(4.0)
    assert opinion.of_all.half_width == pytest.approx(4.3027 / np.sqrt(3), abs=1e-4)
    assert opinion.without_outliers == opinion.of_all
    assert (opinion.num_judges, opinion.num_scores, opinion.num_outliers) == (3, 6, 0)
    assert mean_of(scores_of([3, 4])).half_width is None


def test_a_judge_who_left_early_counts_little() -> None:
    # Mean 3.8; the sums exceed 2, 2 and 1 times that by -1.6, 0.4 and 1.2: squares 4.16 in all.
    mean = mean_of(scores_of([3, 3], [4, 4], [5]))
    assert mean.value == pytest.approx(3.8)
    assert mean.half_width == pytest.approx(4.3027 * np.sqrt(1.5 * 4.16) / 5, abs=1e-4)
    assert mean_of(scores_of([3, 4], [4, 3])).half_width == 0.0


def test_an_outlier_counts_beside() -> None:
    opinion = opinion_of("sync", "live", scores_of([4, 4, 4, 5], [4, 5, 5, 1]))
    assert opinion.num_outliers == 1
    # The judges' means are 17/4 and 14/3; sums exceed theirs by -5/7 and 5/7, t(0.975, 1) = 12.706.
    assert opinion.without_outliers.value == pytest.approx(31 / 7)
    assert opinion.without_outliers.half_width == pytest.approx(12.706 * 10 / 7 / 7, abs=1e-3)
    # Both judges gave four: their means are 17/4 and 15/4, half their difference is 1/4.
    assert opinion.of_all.value == pytest.approx(4.0)
    assert opinion.of_all.half_width == pytest.approx(12.706 / 4, abs=1e-3)


def test_differences_to_the_hidden_reference_are_of_one_judge_and_sentence() -> None:
    live = scores_of([3, 2], [4, 4], [5, 5])
    reference = scores_of([5, 4], [4, 5], [4])
    # 3 - 5 + 5, 2 - 4 + 5, 4 - 4 + 5, 4 - 5 + 5, 5 - 4 + 5; the last has no reference.
    differential = differential_scores(live, reference)
    assert [*differential.values()] == [3, 3, 5, 4, 6]
    assert opinion_of("sync", "live", live, reference).differential == mean_of(differential)
    assert mean_of(differential).value == pytest.approx(4.2)
    assert opinion_of("sync", "live", live).differential is None


def test_holms_correction() -> None:
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm([0.6, 0.9]) == [1.0, 1.0]
    assert holm([]) == []


def test_conditions_are_compared_in_pairs() -> None:
    better = [[5, 4], [5, 5], [4, 4], [5, 4], [5, 5], [4, 3], [5, 4], [4, 5]]
    worse = [[3, 3], [2, 3], [3, 2], [2, 2], [1, 2], [3, 3], [3, 2], [2, 3]]
    worse[0][0] = 5  # an outlier counts
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


def scripted(judge: int, place: int, score: int, condition: str, sentence: str) -> list[Answer]:
    return [
        Answer(judge, place, sentence, condition, scale, score, "zh", 0.0)
        for scale in ("realism", "sync")
    ]


def test_a_report_of_scripted_scores(folder: Path) -> None:
    study = study_of(folder, reference="real", anchor="still")
    practice = scripted(3, -2, 1, "real", "a")
    with pytest.raises(UserError, match="nobody has judged"):
        make_report(study, practice)
    given = {"real": 5, "live": 4, "late": 3, "still": 1}
    answers = [
        answer
        for judge in range(3)
        for place, (sentence, (condition, score)) in enumerate(
            itertools.product(SENTENCES, given.items())
        )
        for answer in scripted(
            judge, place, 6 - score if judge == 2 else score, condition, sentence
        )
    ][:-1]
    report = make_report(study, [*answers, *practice])
    assert [each.condition for each in report.opinions[:4]] == [*study.conditions]
    assert (report.num_judges, report.num_finished, report.unsure) == (3, 2, [2])
    for width in (120, 60):
        text = io.StringIO()
        print_report(study, report, Console(file=text, width=width))
        assert "…" not in text.getvalue(), "no name is cut"
        assert "Trust the intervals of all scores" in text.getvalue()
        if width == 120:
            live = next(line for line in text.getvalue().splitlines() if " live " in line)
            # Scores 4, 4, 2 less 5, 5, 1, plus 5: 4, 4, 6.
            assert "3.33 ± 2.87" in live
            assert "4.67 ± 2.87" in live
            assert "real (hidden reference)" in text.getvalue()
            assert "still (anchor)" in text.getvalue()


def test_box_plots_show_all_scores_that_count(folder: Path) -> None:
    study = study_of(folder)
    scores = [1, 2, 3, 3, 3, 3, 4, 4, 4, 4, 4, 5]  # quartiles 3 and 4, fences 1.5 and 5.5
    answers = [
        answer
        for place, score in enumerate(scores)
        for answer in scripted(place, place, score, "live", "a")
    ]
    figure = draw_boxes(study, [*answers, *scripted(0, -1, 1, "still", "b")])
    assert [axes.get_title() for axes in figure.axes] == ["sync", "realism"]
    for axes in figure.axes:
        assert [label.get_text() for label in axes.get_xticklabels()] == ["live"]
        box, low, high, *_, median, outliers = [line.get_ydata() for line in axes.lines]
        assert set(box) == {3.0, 4.0}
        assert (set(low), set(high)) == ({3.0, 2.0}, {4.0, 5.0})
        assert set(median) == {3.5}
        assert list(outliers) == [1.0]


def test_csv_tells_everything_of_a_score(folder: Path) -> None:
    study = study_of(folder, reference="real", anchor="still")
    given = [(-2, "real"), (0, "still"), (1, "real"), (2, "live")]
    answers = [answer for place, name in given for answer in scripted(7, place, 4, name, "a")[:1]]
    assert to_csv(study, answers).splitlines() == [
        "judge,place,sentence,condition,scale,score,language,unix_s,role",
        "7,-2,a,real,realism,4,zh,0.000,practice",
        "7,0,a,still,realism,4,zh,0.000,anchor",
        "7,1,a,real,realism,4,zh,0.000,reference",
        "7,2,a,live,realism,4,zh,0.000,",
    ]


def test_commands_work_together(folder: Path) -> None:
    made = CliRunner().invoke(app, ["new", str(folder), "--reference", "real", "--language", "zh"])
    assert made.exit_code == 0
    assert load_study(folder).languages == ("zh",)
    report = ["report", str(folder)]
    assert "nobody has judged" in str(CliRunner().invoke(app, report).exception)
    assert not (folder / "answers.sqlite").exists()
    store = Store(folder)
    store.add(answers_of(judge_in(store), 0, ("a", "live"), sync=4, realism=2))
    store.close()
    exported = CliRunner().invoke(app, ["export", str(folder)])
    assert exported.output.splitlines()[1].startswith("0,0,a,live,realism,2,en,")
    files = [folder / "boxes.png", folder / "figures.json"]
    shown = CliRunner().invoke(app, [*report, "--picture", str(files[0]), "--json", str(files[1])])
    assert shown.exit_code == 0, shown.output
    assert files[0].stat().st_size > 1000
    opinion = json.loads(files[1].read_text())["opinions"][0]
    assert opinion["of_all"] == opinion["without_outliers"] == {"value": 4.0, "half_width": None}
