"""The tables of the papers' experiments: four schemes, visemes, and speaking rates."""

from collections.abc import Iterable, Mapping, Sequence

from kouxing.evaluation.tables import Figures, Table, format_number, join_values, percent

# Li et al. 2011, table 2: mean opinion scores of sync and realism
_OPINIONS = {1: (4.34, 4.01), 2: (3.98, 3.81), 3: (3.42, 3.50), 4: (3.21, 3.16)}


def report_schemes(schemes: Figures, paper_rule: Figures) -> Table:
    """Return the four schemes with the default rule, and the live ones with the paper's rule."""
    live = [s for s in paper_rule.get("scores", []) if s["recognizer"].endswith("-paper")]
    return schemes_table([*schemes.get("scores", []), *live])


def schemes_table(scores: Iterable[Figures], reference: str = "scheme 1") -> Table:
    """Return the agreement of the four schemes with a reference, and the paper's scores.

    The reference is "scheme 1" or "real lips". Scores without this agreement are left out.
    """
    columns = (
        "lips",
        "scheme",
        "recognizer",
        f"r with {reference}: opening / width / jaw",
        "lag, ms",
        "F1 of closures",
        "phone delay p50 / p95, ms",
        "paper: sync / realism",
    )
    rows = [
        [
            score["lips"],
            str(score["scheme"]),
            score["recognizer"] or "(text)",
            join_values(format_number(value) for value in like["correlation"].values()),
            format_number(like["lag_ms"], ".0f"),
            format_number(like["closure_f1"]),
            join_values(format_number(score[f"phone_delay_{p}_ms"], ".0f") for p in ("p50", "p95")),
            join_values(format_number(opinion) for opinion in _OPINIONS[score["scheme"]]),
        ]
        for score in scores
        if (like := score[f"like_{reference.replace(' ', '_')}"])
    ]
    return Table(columns, rows)


def viseme_fit_table(results: Figures) -> Table:
    """Return the errors of the visemes of Wang & Cai 2003 by viseme and measure."""
    errors = {(error["viseme"], error["measure"]): error for error in results.get("errors", [])}
    measures = dict.fromkeys(measure for _, measure in errors)
    rows = []
    for viseme in dict.fromkeys(viseme for viseme, _ in errors):
        viseme_errors = [errors.get((viseme, measure)) for measure in measures]
        num_frames = max(error["num_frames"] for error in viseme_errors if error)
        rows.append([viseme, str(num_frames), *map(_fit_cell, viseme_errors)])
    title = "errors, FAP units: learned / initial parameters / deviation of real lips"
    return Table(("viseme", "frames", *measures), rows, title)


def _fit_cell(error: Figures | None) -> str:
    if error is None:
        return "-"
    return join_values(f"{error[key]:.0f}" for key in ("learned", "guessed", "extent"))


def ferguson_table(scores: Sequence[Mapping[str, Figures]]) -> Table:
    """Return the accuracies of Zhang et al. 2021 by method and speaking rate."""
    columns = ("method", *(f"{s['rate']:g} ({s['syllables_per_s']:.1f} per s)" for s in scores))
    methods = scores[0]["of_frames"] if scores else ()
    rows = [
        [
            method,
            *(
                join_values(
                    percent(score[kind][method], ".0f") for kind in ("of_frames", "of_phones")
                )
                for score in scores
            ),
        ]
        for method in methods
    ]
    return Table(columns, rows, "accuracy by speaking rate, %: all frames / mean mouths of phones")
