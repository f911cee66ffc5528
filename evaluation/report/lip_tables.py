"""The tables of lips: agreement with tracked lips, closures, look-ahead, motion, and the papers."""

from collections.abc import Iterator, Sequence
from typing import Any

from kouxing.evaluation.lips.lip_scores import ALL, REAL
from kouxing.evaluation.lips.mouths import CURVES
from kouxing.evaluation.lips.scheme_report import PAPER
from kouxing.evaluation.recognizer.disturbances import BABBLE, CLEAN, MUSIC
from kouxing.evaluation.report.markdown import Results, Table, display_floor_ms, join_values
from kouxing.evaluation.tables import format_number, percent

_GROUPS = {"zh": "Mandarin", "zh new": "Mandarin, new", "en": "English", "en new": "English, new"}
_COMPARED_GROUPS = {"zh": "Mandarin", "en": "English", ALL: "all clips"}
_OUR_LIP_MODEL = "learned"
_COMPARED = {  # compared measures, and whether higher is better
    "r_opening": ("correlation of the opening", True),
    "r_width": ("correlation of the width", True),
    "r_jaw": ("correlation of the jaw", True),
    "closure_f1": ("F1 of closures", True),
    "closure_precision": ("precision of closures", True),
    "closure_recall": ("recall of closures", True),
    "precision_bpm": ("precision of closures at b p m", True),
    "precision_aei": ("precision of closures at a e i", True),
    "precision_uo": ("precision of closures at u o", True),
    "precision_pause": ("precision of closures in pauses", True),
    "mtm_ms": ("MTM", False),
}
_REALISM_MEASURES = {  # measures that are best when they equal the value of real lips
    "slcc": "SLCC",
    "effort_correlation": "effort",
    "rest_opening": "opening at rest",
    "closing_time_ms": "time until the lips are closed",
    "phone_spread": "spread",
    "turns_per_s": "number of turns per second",
}
_CLOSURE_COLUMNS = {  # measures by title
    "F1": "closure_f1",
    "recall": "closure_recall",
    "precision": "closure_precision",
    "b p m": "precision_bpm",
    "a e i": "precision_aei",
    "u o": "precision_uo",
    "pauses": "precision_pause",
    "closed at b p m": "labials_shut",
    "closed in speech": "share_shut",
}
_MOTION_COLUMNS = {  # measures and formats by title
    "lag, ms": ("lag_ms", ".0f"),
    "MTM, ms": ("mtm_ms", ".0f"),
    "SLCC": ("slcc", ".2f"),
    "effort": ("effort_correlation", ".2f"),
    "opening at rest": ("rest_opening", ".0f"),
    "closed after, ms": ("closing_time_ms", ".0f"),
    "spread": ("phone_spread", ".0f"),
    "turns per s": ("turns_per_s", ".1f"),
}
_MEASURE_NAMES = {name: title for name, (title, _) in _COMPARED.items()} | _REALISM_MEASURES
_PROGRAM_TITLES = {
    "headaudio": "HeadAudio 0.1.0",
    "wlipsync": "wLipSync 1.3.1",
    "wawa": "wawa-lipsync 0.0.2",
    "live2d": "live2d-motionsync 0.0.4",
    "pylipsync": "pylipsync 0.2.1 (uLipSync)",
    "openfacefx": "OpenFaceFX 0.24.0, energy, offline",
    "rhubarb": "Rhubarb Lip Sync, offline",
    "loudness": "loudness",
}


def title_of(face: str) -> str:
    """Return the title of a face such as ``wawa, fitted, 100 ms``."""
    program, _, rest = face.partition(", ")
    name = _PROGRAM_TITLES.get(program, f"**{program}**")
    return f"{name}, {rest}"


def agreement_table(results: Results) -> Table:
    """Return the correlations with tracked lips in speech, best opening first."""
    faces = _clean_scores(results.get("rivals", {}))
    columns = ("face, delay", *(f"{name}: opening / width / jaw" for name in _GROUPS.values()))
    order = sorted(faces, key=lambda face: -(faces[face][ALL]["r_opening"] or 0.0))
    return columns, [
        [
            title_of(face),
            *(
                join_values(
                    format_number(faces[face].get(group, {}).get(f"r_{name}")) for name in CURVES
                )
                for group in _GROUPS
            ),
        ]
        for face in order
    ]


def better_programs(results: Results) -> list[list[str]]:
    """Return a row for each measure in which another program is better than ``_OUR_LIP_MODEL``."""
    faces = results.get("rivals", {})
    scores = _clean_scores(faces)
    own = next((face for face in scores if face.startswith(f"{_OUR_LIP_MODEL}, ")), None)
    if own is None:
        return []
    others = [face for face in scores if face.partition(", ")[0] in _PROGRAM_TITLES]
    rows = []
    for group, group_title in _COMPARED_GROUPS.items():
        real = faces[REAL][CLEAN].get(group, {})
        for measure, name in _MEASURE_NAMES.items():
            if measure in _REALISM_MEASURES and group != ALL:
                continue
            values = {face: scores[face].get(group, {}).get(measure) for face in (own, *others)}
            losses = {
                face: _loss(measure, value, real.get(measure))
                for face, value in values.items()
                if value is not None and (measure in _COMPARED or real.get(measure) is not None)
            }
            best = min(losses, key=lambda face: losses[face], default=own)
            if own in losses and losses[best] < losses[own]:
                figures = [_format_measure(measure, values[face]) for face in (best, own)]
                if "precision" in measure:
                    recalls = (scores[face][group].get("closure_recall") for face in (best, own))
                    figures = [
                        f"{figure}, recall {format_number(recall)}"
                        for figure, recall in zip(figures, recalls, strict=True)
                    ]
                if measure in _REALISM_MEASURES:
                    figures.append(f"real lips {_format_measure(measure, real[measure])}")
                program, ours = title_of(best), ", ".join(figures[1:])
                rows.append([f"{group_title}, {name}", program, figures[0], ours])
    return rows


def _loss(measure: str, value: float, real: float | None) -> float:
    """Return a figure's loss; lower is better."""
    if measure in _REALISM_MEASURES:
        return abs(value - (real or 0.0))
    return -value if _COMPARED[measure][1] else value


def _format_measure(measure: str, value: float | None) -> str:
    if measure.endswith("_ms"):
        return f"{format_number(value, '.0f')} ms"
    return format_number(value, ".0f" if measure in ("rest_opening", "phone_spread") else ".2f")


def closures_table(results: Results) -> Table:
    """Return recall and precision of closures in percent, also by class of phones."""
    return ("face, delay", *_CLOSURE_COLUMNS), [
        [title, *(percent(scores.get(name), ".0f") for name in _CLOSURE_COLUMNS.values())]
        for title, scores in _all_faces(results)
    ]


def motion_table(results: Results) -> Table:
    """Return timing, effort and rest of the faces, and of real lips."""
    return ("face, delay", *_MOTION_COLUMNS), [
        [
            title,
            *(
                format_number(scores.get(name), format_spec)
                for name, format_spec in _MOTION_COLUMNS.values()
            ),
        ]
        for title, scores in _all_faces(results)
    ]


def disturbed_lips(results: Results) -> list[str]:
    """Return a sentence for each lip model: its scores in clean audio, babble and music."""
    sentences = []
    for face, scores in results.get("lips", {}).items():
        conditions = [name for name in (CLEAN, BABBLE, MUSIC) if name in scores]
        measures = ("r_opening", "closure_f1")
        figures = (
            f"{name} {join_values(format_number(scores[name][ALL][m]) for m in measures)}"
            for name in conditions
        )
        if face != REAL and len(conditions) > 1:
            sentences.append(f"{face}, correlation of the opening / F1: {', '.join(figures)}")
    return sentences


def lookahead_table(results: Results) -> Table:
    """Return the correlation of the opening and the F1 of closures by look-ahead."""
    curves = lookahead_curves(results)
    delays = sorted({delay for points in curves.values() for delay in points})
    rows = []
    for lips, points in curves.items():
        for measure, name in (("r_opening", "r"), ("closure_f1", "F1")):
            values = (format_number(points.get(delay, {}).get(measure)) for delay in delays)
            rows.append([f"{lips}, {name}", *values])
    rows.append(["floor of the latency, ms", *(str(display_floor_ms(delay)) for delay in delays)])
    return ("lip model", *(f"{delay} ms" for delay in delays)), rows


def lookahead_curves(results: Results) -> dict[str, dict[int, dict[str, Any]]]:
    """Return the scores of all clips by lip model and delay, ms."""
    curves: dict[str, dict[int, dict[str, Any]]] = {}
    for face, groups in _clean_scores(results.get("lookahead", {})).items():
        lips, _, delay = face.partition(", ")
        curves.setdefault(lips, {})[int(float(delay.removesuffix(" ms")))] = groups[ALL]
    return curves


def schemes_table(results: Results) -> Table:
    """Return the four schemes of Li et al. 2011 with the paper's scores."""
    columns = (
        "lips",
        "scheme",
        "recognizer",
        "r with scheme 1: opening / width / jaw",
        "lag, ms",
        "F1 of closures",
        "phone delay p50 / p95, ms",
        "paper: sync / realism",
    )
    return columns, [
        [
            score["lips"],
            str(score["scheme"]),
            score["recognizer"] or "(text)",
            join_values(format_number(value) for value in like["correlation"].values()),
            format_number(like["lag_ms"], ".0f"),
            format_number(like["closure_f1"]),
            join_values(format_number(score[f"phone_delay_{p}_ms"], ".0f") for p in ("p50", "p95")),
            join_values(format_number(opinion) for opinion in PAPER[score["scheme"]][:2]),
        ]
        for step in ("schemes", "schemes-paper-rule")
        for score in results.get(step, {}).get("scores", [])
        if (like := score["like_scheme_1"])
        and (step == "schemes" or score["recognizer"].endswith("-paper"))
    ]


def viseme_fit_table(results: Results) -> Table:
    """Return the errors of the visemes of Wang & Cai 2003 by viseme and measure."""
    errors = results.get("visemes", {}).get("errors", [])
    measures = list(dict.fromkeys(error["measure"] for error in errors))
    rows = []
    for viseme in dict.fromkeys(error["viseme"] for error in errors):
        of_viseme = {error["measure"]: error for error in errors if error["viseme"] == viseme}
        frames = max(error["num_frames"] for error in of_viseme.values())
        cells = (
            join_values(
                format_number(of_viseme[measure][key], ".0f")
                for key in ("learned", "guessed", "extent")
            )
            if measure in of_viseme
            else "-"
            for measure in measures
        )
        rows.append([viseme, str(frames), *cells])
    return ("viseme", "frames", *measures), rows


def ferguson_table(results: Results) -> Table:
    """Return the accuracies of Zhang et al. 2021 by method and speaking rate."""
    scores: Sequence[Any] = results.get("ferguson", [])
    columns = ("method", *(f"{s['rate']:g} ({s['syllables_per_s']:.1f} per s)" for s in scores))
    methods = scores[0]["of_frames"] if scores else ()
    return columns, [
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


def _clean_scores(faces: Results) -> dict[str, dict[str, Any]]:
    return {face: scores[CLEAN] for face, scores in faces.items() if face != REAL}


def _all_faces(results: Results) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield title and scores of all clips: real lips, own lip models, then other programs."""
    faces = results.get("rivals", {})
    if REAL in faces:
        yield "real lips", faces[REAL][CLEAN][ALL]
    for face, groups in _clean_scores(faces).items():
        yield title_of(face), groups[ALL]
