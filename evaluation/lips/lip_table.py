"""Print the scores of lips in one table that fits a screen."""

from collections.abc import Iterator, Mapping

from rich.console import Console

from kouxing.evaluation.lips.lip_measures import MEASURES
from kouxing.evaluation.lips.lip_scores import ALL, MOCAP, REAL, Results, Scores
from kouxing.evaluation.recognizer.disturbances import BABBLE, CLEAN, MUSIC
from kouxing.evaluation.tables import format_number, letters_of, percent
from kouxing.shared.terminal import print_table

# A column's title and how its measures are joined. Cells wrap at spaces.
COLUMNS = {
    "r": "{r_opening:%}/{r_width:%}/{r_jaw:%}",
    "F1 P/R": "{closure_f1:%} {closure_precision:%}/{closure_recall:%}",
    "P by class": "{precision_bpm:%}/{precision_aei:%} {precision_uo:%}/{precision_pause:%}",
    "shut": "{labials_shut:%}/{share_shut:%}",
    "rest": "{rest_opening:.0f}/{closing_time_ms:.0f}",
    "effort": "{effort_correlation:%}/{slcc:%}",
    "spread": "{phone_spread:.0f}/{turns_per_s:.1f}/{mtm_ms:.0f}",
}
LEGEND = """\
First row of a group: real lips. new: speakers not in training. +b, +m: babble,
music. In %: r of opening/width/jaw in speech; closures, F1 precision/recall;
their precision at b p m/a e i u o/pauses; lips shut at b p m/in speech; effort:
r of range and level/SLCC, over clips. rest: opening, FAP units/ms to close in
pauses. spread: within phone classes, FAP units/turns per s/MTM, ms."""
_MARKS = {CLEAN: "", BABBLE: "+b", MUSIC: "+m"}


def print_scores(results: Results, console: Console) -> None:
    """Print one table: the real lips and each face, by group of clips."""
    faces = [title for title in results if title != REAL]
    letters, legend = letters_of(faces)
    real = results[REAL][CLEAN]
    counts = ", ".join(f"{group} {real[group]['clips']:.0f}" for group in _main_groups(real))
    title = f"{legend}\nclips: {counts}\n{LEGEND}"
    print_table(console, title, ("clips", *COLUMNS), _table_rows(results, letters))


def _table_rows(results: Results, letters: Mapping[str, str]) -> Iterator[list[str]]:
    real = results[REAL][CLEAN]
    for group in _main_groups(real):
        yield [group, *_score_cells(real[group])]
        for face, letter in letters.items():
            for condition, scores in results[face].items():
                if condition == CLEAN or group == ALL:
                    yield [f"  {letter}{_MARKS[condition]}", *_score_cells(scores[group])]


def _main_groups(real: Mapping[str, Scores]) -> list[str]:
    """Return each language unless all its speakers are new, its new speakers, mocap and all."""
    groups = []
    for language in sorted(group for group in real if " " not in group):
        if language not in (ALL, MOCAP):
            has_known = f"{language} known" in real
            groups += [language, f"{language} new"] if has_known else [f"{language} new"]
    return [group for group in (*groups, MOCAP, ALL) if group in real]


class _Figure:
    """A figure in a format string. The format "%" is a percentage without its sign."""

    def __init__(self, value: float | None) -> None:
        self._value = value

    def __format__(self, format_spec: str) -> str:
        return (
            percent(self._value, ".0f")
            if format_spec == "%"
            else format_number(self._value, format_spec)
        )


def _score_cells(scores: Scores) -> list[str]:
    figures = {name: _Figure(scores.get(name)) for name in MEASURES}
    return [column.format_map(figures) for column in COLUMNS.values()]
