"""The table of phones: errors and delays of the acoustic models."""

from kouxing.evaluation.recognizer.disturbances import CLEAN
from kouxing.evaluation.report.markdown import Results, Table, join_values
from kouxing.evaluation.tables import format_number, percent

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


def recognition(results: Results) -> Table:
    """Return the errors by kind of speech and model, one decimal."""
    columns = (
        "speech",
        "model",
        "phones",
        "errors of the final hypothesis, phones / visemes (/ features), %",
        "of the first hypothesis",
        "delay p50 / p95, ms",
        "p b m f: recall / precision, %",
    )
    rows = []
    for speech in ("read", "conversation"):
        for model, figures in results.get(speech, {}).items():
            rows.append([speech, f"`{model}`", *_score_cells(figures["speech"][CLEAN])])
    for model, figures in results.get("disturbed", {}).items():
        for kind, score in figures["speech"].items():
            if kind != CLEAN and not kind.endswith("/s"):
                rows.append([f"read, {kind}", f"`{model}`", *_score_cells(score)])
    for group, scores in _by_language(results).items():
        for recognizer, score in scores.items():
            rows.append(
                [
                    _SPEECH_TITLES.get(group, group),
                    _RECOGNIZER_TITLES[recognizer],
                    *_score_cells(score),
                ]
            )
    paper = ["read, own corpus", "Li et al. 2011, N = 3", "", "26.3 / -", "", "45", ""]
    return columns, [*rows, paper]


def better_recognizers(results: Results) -> list[list[str]]:
    """Return a row for each error rate of a language in which hama is better."""
    rows = []
    for group, scores in _by_language(results).items():
        for unit, name in _ERROR_TITLES.items() if "hama" in scores else ():
            hama, own = (scores[key]["final"][f"{unit}_error_rate"] for key in ("hama", "own"))
            if hama < own:
                measure, figures = f"{_SPEECH_TITLES.get(group, group)}, {name}", (hama, own)
                rows.append([measure, "hama 1.7.0, offline", *(f"{percent(f)} %" for f in figures)])
    return rows


def _by_language(results: Results) -> dict[str, dict[str, Results]]:
    """Return the scores of each kind of speech by recognizer."""
    scores: dict[str, dict[str, Results]] = {}
    for recognizer, figures in results.get("languages", {}).items():
        for group, score in figures["speech"].items():
            scores.setdefault(group.removeprefix("language "), {})[recognizer] = score
    return scores


def _score_cells(score: Results) -> list[str]:
    delay = score.get("delay_ms", {})
    errors = (
        join_values(
            percent(score[hypothesis][key])
            for unit in _ERROR_TITLES
            if (key := f"{unit}_error_rate") in score[hypothesis]
        )
        if hypothesis in score
        else "-"
        for hypothesis in ("final", "first")
    )
    return [
        str(score["final"]["phone_errors"]["reference"]),
        *errors,
        join_values(format_number(delay.get(key), ".0f") for key in ("p50", "p95")),
        join_values(percent(rate, ".0f") for rate in score["final"]["labials"].values()),
    ]
