"""The table of phones: errors and delays of the acoustic models."""

from kouxing.evaluation.recognizer.disturbances import CLEAN
from kouxing.evaluation.report.markdown import Results, Table, join_values
from kouxing.evaluation.tables import format_number, percent


def recognition(results: Results) -> Table:
    """Return the errors by kind of speech and model, one decimal."""
    columns = (
        "speech",
        "model",
        "phones",
        "errors of the final hypothesis, phones / visemes, %",
        "of the first hypothesis",
        "delay p50 / p95, ms",
        "p b m f: recall / precision, %",
    )
    rows = []
    for speech in ("read", "conversation"):
        for model, figures in results.get(speech, {}).items():
            rows.append([speech, f"`{model}`", *_cells(figures["speech"][CLEAN])])
    for model, figures in results.get("disturbed", {}).items():
        for kind, score in figures["speech"].items():
            if kind != CLEAN and not kind.endswith("/s"):
                rows.append([f"read, {kind}", f"`{model}`", *_cells(score)])
    paper = ["read, own corpus", "Li et al. 2011, N = 3", "", "26.3 / -", "", "45", ""]
    return columns, [*rows, paper]


def _cells(score: Results) -> list[str]:
    delay = score.get("delay_ms", {})
    errors = (
        join_values(
            percent(score[hypothesis][f"{unit}_error_rate"]) for unit in ("phone", "viseme")
        )
        for hypothesis in ("final", "first")
    )
    return [
        str(score["final"]["phone_errors"]["reference"]),
        *errors,
        join_values(format_number(delay.get(key), ".0f") for key in ("p50", "p95")),
        join_values(percent(rate, ".0f") for rate in score["final"]["labials"].values()),
    ]
