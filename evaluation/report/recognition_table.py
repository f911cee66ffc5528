"""The table of phones: errors and delays of the acoustic models."""

from kouxing.evaluation.report.markdown import (
    Results,
    Table,
    format_number,
    format_percent,
    join_values,
)

_SPEECH = {"read": "read", "conversation": "conversation"}
_CLEAN = "clean"
_PAPER_ERRORS = 26.34


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
    for step, speech in _SPEECH.items():
        for model, figures in results.get(step, {}).items():
            rows.append([speech, f"`{model}`", *_cells(figures["speech"][_CLEAN])])
    for model, figures in results.get("disturbed", {}).items():
        for kind, score in figures["speech"].items():
            if kind != _CLEAN and not kind.endswith("/s"):
                rows.append([f"read, {kind}", f"`{model}`", *_cells(score)])
    paper = [
        "read, own corpus",
        "Li et al. 2011, N = 3",
        "",
        f"{_PAPER_ERRORS:.1f} / -",
        "",
        "45",
        "",
    ]
    return columns, [*rows, paper]


def _cells(score: Results) -> list[str]:
    delay = score.get("delay_ms", {})
    errors = {
        hypothesis: join_values(
            format_percent(score[hypothesis][f"{unit}_error_rate"], 1)
            for unit in ("phone", "viseme")
        )
        for hypothesis in ("final", "first")
    }
    return [
        str(score["final"]["phone_errors"]["reference"]),
        *errors.values(),
        join_values(format_number(delay.get(key), 0) for key in ("p50", "p95")),
        join_values(format_percent(rate) for rate in score["final"]["labials"].values()),
    ]
