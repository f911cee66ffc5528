"""The tables of recognition: errors and delays of the acoustic models, and voice activity."""

from collections.abc import Iterator

from kouxing.evaluation.recognizer.disturbances import CLEAN
from kouxing.evaluation.tables import Figures, Table, format_number, join_values, percent
from kouxing.shared.command.terminal import plural

_COLUMNS = (
    "speech",
    "model",
    "phones",
    "errors of the final hypothesis, phones / visemes (/ features), %",
    "of the first hypothesis",
    "delay p50 / p95, ms",
    "p b m f: recall / precision, %",
)
_RECOGNIZER_TITLES = {  # in the rows by language
    "auto": "`universal`, no language chosen",
    "own": "the language's own phones",
    "hama": "hama 1.7.0, offline",
}
_ERROR_TITLES = {
    "phone": "errors of phones",
    "viseme": "errors of visemes",
    "feature": "errors of features",
}
_SPEECH_TITLES = {
    "de": "German, EmoDB",
    "en-GRID": "English, GRID",
    "en-learner": "English, native speakers of Mandarin",
    "en-native": "English, VCTK and LJ Speech",
    "it": "Italian, not in training",
    "ko": "Korean, not in training",
    "zh": "Mandarin, read",
}


def recognition(
    read: Figures, conversation: Figures, disturbed: Figures, languages: Figures
) -> Table:
    """Return the errors by kind of speech and model, with those of the paper."""
    rows = [
        [speech, f"`{model}`", *_score_cells(figures["speech"][CLEAN])]
        for speech, results in (("read", read), ("conversation", conversation))
        for model, figures in results.items()
    ]
    for kind, model, score in _scores(disturbed):
        if kind != CLEAN and not kind.endswith("/s"):
            rows.append([f"read, {kind}", f"`{model}`", *_score_cells(score)])
    for group, name, score in _scores(languages):
        rows.append([_speech_title(group), _RECOGNIZER_TITLES[name], *_score_cells(score)])
    rows.append(["read, own corpus", "Li et al. 2011, N = 3", "", "26.3 / -", "", "45", ""])
    return Table(_COLUMNS, rows)


def speech_table(results: Figures) -> Table:
    """Return the errors of recognizers by kind of speech. ``results`` has their figures by name."""
    first = next(iter(results.values()))
    counts = plural(first["recordings"], "recording"), plural(first["speakers"], "speaker")
    rows = [[kind, name, *_score_cells(score)] for kind, name, score in _scores(results)]
    return Table(_COLUMNS, rows, ", ".join(counts))


def voice_table(results: Figures) -> Table:
    """Return the percentages of the time with voice activity, laughter and breath."""
    columns = ("audio", "s", "voice", "no voice", "laughter", "breath")
    rows = [
        [
            kind,
            f"{sum(shares['seconds'].values()):.0f}",
            *map(percent, shares["on"].values()),
            percent(shares["laughter"]),
            percent(shares["breath"]),
        ]
        for kind, shares in results.items()
    ]
    title = "% of the time: voice activity with and without a voice, laughter, breath"
    return Table(columns, rows, title)


def better_recognizers(languages: Figures) -> list[list[str]]:
    """Return a row for each error rate of a language in which hama is better."""
    rows = []
    scores = {(group, name): score for group, name, score in _scores(languages)}
    for group in dict.fromkeys(group for group, name in scores if name == "hama"):
        hama, own = (scores[group, name]["final"] for name in ("hama", "own"))
        for unit, title in _ERROR_TITLES.items():
            rates = hama[f"{unit}_error_rate"], own[f"{unit}_error_rate"]
            if rates[0] < rates[1]:
                figures = (f"{percent(rate)} %" for rate in rates)
                rows.append(
                    [f"{_speech_title(group)}, {title}", _RECOGNIZER_TITLES["hama"], *figures]
                )
    return rows


def _speech_title(group: str) -> str:
    language = group.removeprefix("language ")
    return _SPEECH_TITLES.get(language, language)


def _scores(results: Figures) -> Iterator[tuple[str, str, Figures]]:
    """Yield kind of speech, recognizer and score, one kind after another."""
    kinds = dict.fromkeys(kind for figures in results.values() for kind in figures["speech"])
    for kind in kinds:
        for name, figures in results.items():
            if kind in figures["speech"]:
                yield kind, name, figures["speech"][kind]


def _score_cells(score: Figures) -> list[str]:
    delay = score.get("delay_ms", {})  # missing if no phone was right
    return [
        str(score["final"]["phone_errors"]["reference"]),
        *(_error_cell(score.get(hypothesis, {})) for hypothesis in ("final", "first")),
        join_values(format_number(delay.get(key), ".0f") for key in ("p50", "p95")),
        join_values(percent(rate, ".0f") for rate in score["final"]["labials"].values()),
    ]


def _error_cell(hypothesis: Figures) -> str:
    rates = [hypothesis.get(f"{unit}_error_rate") for unit in _ERROR_TITLES]
    return join_values(percent(rate) for rate in rates if rate is not None) or "-"
