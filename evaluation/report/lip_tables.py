"""The tables of lips: agreement with tracked lips, closures, delay and motion."""

from collections.abc import Mapping
from typing import Any

from kouxing.evaluation.lips.lip_scores import ALL, MOCAP, REAL
from kouxing.evaluation.lips.mouths import CURVES
from kouxing.evaluation.recognizer.disturbances import BABBLE, CLEAN, MUSIC
from kouxing.evaluation.tables import Figures, Table, format_number, join_values, percent

_GROUPS = {"zh": "Mandarin", "zh new": "Mandarin, new", "en": "English", "en new": "English, new"}
_COMPARED_GROUPS = {"zh": "Mandarin", "en": "English", ALL: "all clips"}
_OUR_LIP_MODEL = "learned"
_FRAME_MS, _TICK_MS = 20, 17  # frame of the face; tick of a display at 60 Hz
_COMPARED = {  # measures that are best when they are high, except MTM
    "r_opening": "correlation of the opening",
    "r_width": "correlation of the width",
    "r_jaw": "correlation of the jaw",
    "closure_f1": "F1 of closures",
    "closure_precision": "precision of closures",
    "closure_recall": "recall of closures",
    "precision_bpm": "precision of closures at b p m",
    "precision_aei": "precision of closures at a e i",
    "precision_uo": "precision of closures at u o",
    "precision_pause": "precision of closures in pauses",
    "mtm_ms": "MTM",
}
_REALISM_MEASURES = {  # measures that are best when they equal the value of real lips
    "slcc": "SLCC",
    "effort_correlation": "effort",
    "rest_opening": "opening at rest",
    "closing_time_ms": "time until the lips are closed",
    "phone_spread": "spread",
    "turns_per_s": "number of turns per second",
}
CLOSURE_COLUMNS = {  # measures by title
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
MOTION_COLUMNS = {  # measures by title
    "lag, ms": "lag_ms",
    "MTM, ms": "mtm_ms",
    "SLCC": "slcc",
    "effort": "effort_correlation",
    "opening at rest": "rest_opening",
    "closed after, ms": "closing_time_ms",
    "spread": "phone_spread",
    "turns per s": "turns_per_s",
}
_CONSOLE_COLUMNS = {  # measures by title
    "r": ("r_opening", "r_width", "r_jaw"),
    "F1/P/R": ("closure_f1", "closure_precision", "closure_recall"),
    "P by class": ("precision_bpm", "precision_aei", "precision_uo", "precision_pause"),
    "closed": ("labials_shut", "share_shut"),
    "rest": ("rest_opening", "closing_time_ms"),
    "effort": ("effort_correlation", "slcc"),
    "spread": ("phone_spread", "turns_per_s", "mtm_ms"),
}
_LEGEND = """\
First row of a group: real lips. new: speakers not in training. +b, +m: babble,
music. In %: r of opening/width/jaw in speech; F1/precision/recall of closures;
their precision at b p m/a e i/u o/pauses; lips closed at b p m/in speech;
effort: r of range and level/SLCC, over clips. rest: opening, FAP units/ms to
close in pauses. spread: within phone classes, FAP units/turns per s/MTM, ms."""
_MARKS = {CLEAN: "", BABBLE: "+b", MUSIC: "+m"}
_WHOLE_MEASURES = ("lag_ms", "mtm_ms", "rest_opening", "closing_time_ms", "phone_spread")
_FORMATS = {  # of measures; not of correlations
    **dict.fromkeys(CLOSURE_COLUMNS.values(), "%"),
    **dict.fromkeys(_WHOLE_MEASURES, ".0f"),
    "turns_per_s": ".1f",
}
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


def scores_table(faces: Figures) -> Table:
    """Return one table that fits a screen: the real lips and each face, by group of clips."""
    titles = [title for title in faces if title != REAL]  # too long for a column
    real = faces[REAL][CLEAN]
    rows = []
    for group in _main_groups(real):
        rows.append([group, *_console_cells(real[group])])
        for number, title in enumerate(titles, 1):
            for condition, scores in faces[title].items():
                if condition == CLEAN or group == ALL:
                    label = f"  {number}{_MARKS[condition]}"
                    rows.append([label, *_console_cells(scores[group])])
    counts = ", ".join(f"{group} {real[group]['clips']}" for group in _main_groups(real))
    legend = ", ".join(f"{number}: {title}" for number, title in enumerate(titles, 1))
    heading = f"{legend}\nclips: {counts}\n{_LEGEND}"
    return Table(("clips", *_CONSOLE_COLUMNS), rows, heading)


def _main_groups(real: Figures) -> list[str]:
    """Return each language unless all its speakers are new, its new speakers, mocap and all."""
    groups = []
    for language in sorted(group for group in real if " " not in group):
        if language not in (ALL, MOCAP):
            has_known = f"{language} known" in real
            groups += [language, f"{language} new"] if has_known else [f"{language} new"]
    return [group for group in (*groups, MOCAP, ALL) if group in real]


def _console_cells(scores: Figures) -> list[str]:
    """Return short cells: correlations are in percent like closures."""
    return [
        "/".join(_format_measure(name, scores.get(name), default="%") for name in names)
        for names in _CONSOLE_COLUMNS.values()
    ]


def _format_measure(name: str, value: float | None, default: str = ".2f") -> str:
    """Format a measure; "%" is a percentage without its sign."""
    format_spec = _FORMATS.get(name, default)
    if format_spec == "%":
        return percent(value, ".0f")
    return format_number(value, format_spec)


def agreement_table(faces: Figures) -> Table:
    """Return the correlations with tracked lips in speech, best opening first."""
    clean = _clean_scores(faces)
    rows = []
    for face in sorted(clean, key=lambda face: -(clean[face][ALL]["r_opening"] or 0.0)):
        correlations = [
            [clean[face].get(group, {}).get(f"r_{curve}") for curve in CURVES] for group in _GROUPS
        ]
        rows.append([title_of(face), *(join_values(map(format_number, r)) for r in correlations)])
    titles = (f"{name}: opening / width / jaw" for name in _GROUPS.values())
    return Table(("face, delay", *titles), rows)


def measures_table(faces: Figures, measures: Mapping[str, str]) -> Table:
    """Return a table of measures, which are given by title, on all clips.

    The rows are real lips, kouxing's lip models, then other programs.
    """
    scores = {title_of(face): groups[ALL] for face, groups in _clean_scores(faces).items()}
    if REAL in faces:
        scores = {"real lips": faces[REAL][CLEAN][ALL], **scores}
    rows = [
        [title, *(_format_measure(name, face_scores.get(name)) for name in measures.values())]
        for title, face_scores in scores.items()
    ]
    return Table(("face, delay", *measures), rows)


def better_programs(faces: Figures) -> list[list[str]]:
    """Return a row for each measure in which another program is better than ``_OUR_LIP_MODEL``."""
    scores = _clean_scores(faces)
    own = next((face for face in scores if face.startswith(f"{_OUR_LIP_MODEL}, ")), None)
    if own is None:
        return []
    others = [face for face in scores if face.partition(", ")[0] in _PROGRAM_TITLES]
    rows = []
    for group, group_title in _COMPARED_GROUPS.items():
        real = faces[REAL][CLEAN].get(group, {})
        group_scores = {face: scores[face].get(group, {}) for face in (own, *others)}
        for measure, name in (_COMPARED | _REALISM_MEASURES).items():
            is_realism = measure in _REALISM_MEASURES
            if is_realism and (group != ALL or real.get(measure) is None):
                continue
            losses = {
                face: _loss(measure, values[measure], real.get(measure))
                for face, values in group_scores.items()
                if values.get(measure) is not None
            }
            best = min(losses, key=losses.__getitem__, default=own)
            if own in losses and losses[best] < losses[own]:
                theirs, ours = (_describe(measure, group_scores[face]) for face in (best, own))
                if is_realism:
                    ours += f", real lips {_describe(measure, real)}"
                rows.append([f"{group_title}, {name}", title_of(best), theirs, ours])
    return rows


def _loss(measure: str, value: float, real: float | None) -> float:
    """Return a figure's loss; lower is better."""
    if measure in _REALISM_MEASURES:
        return abs(value - (real or 0.0))
    return value if measure == "mtm_ms" else -value


def _describe(measure: str, scores: Figures) -> str:
    """Return a figure with its unit; a precision also with the recall."""
    if measure in _WHOLE_MEASURES:
        return f"{scores[measure]:.0f}" + (" ms" if measure.endswith("_ms") else "")
    recall = f", recall {format_number(scores.get('closure_recall'))}"
    return f"{scores[measure]:.2f}" + (recall if "precision" in measure else "")


def disturbed_lips(faces: Figures) -> list[str]:
    """Return a sentence for each lip model: its scores in clean audio, babble and music."""
    sentences = []
    for face, scores in faces.items():
        conditions = [name for name in (CLEAN, BABBLE, MUSIC) if name in scores]
        measures = ("r_opening", "closure_f1")
        figures = (
            f"{name} {join_values(format_number(scores[name][ALL][m]) for m in measures)}"
            for name in conditions
        )
        if face != REAL and len(conditions) > 1:
            sentences.append(f"{face}, correlation of the opening / F1: {', '.join(figures)}")
    return sentences


def delay_table(faces: Figures) -> Table:
    """Return the correlation of the opening and the F1 of closures by delay."""
    curves = delay_curves(faces)
    delays = sorted({delay for points in curves.values() for delay in points})
    rows = []
    for lips, points in curves.items():
        for measure, name in (("r_opening", "r"), ("closure_f1", "F1")):
            values = (format_number(points.get(delay, {}).get(measure)) for delay in delays)
            rows.append([f"{lips}, {name}", *values])
    rows.append(["floor of the latency, ms", *(str(display_floor_ms(delay)) for delay in delays)])
    return Table(("lip model", *(f"{delay} ms" for delay in delays)), rows)


def display_floor_ms(delay_ms: int) -> int:
    """Return the minimum time from a sound to its image: delay, frame and display tick."""
    return delay_ms + _FRAME_MS + _TICK_MS


def delay_curves(faces: Figures) -> dict[str, dict[int, dict[str, Any]]]:
    """Return the scores of all clips by lip model and delay, ms."""
    curves: dict[str, dict[int, dict[str, Any]]] = {}
    for face, groups in _clean_scores(faces).items():
        lips, _, delay = face.partition(", ")
        curves.setdefault(lips, {})[int(float(delay.removesuffix(" ms")))] = groups[ALL]
    return curves


def _clean_scores(faces: Figures) -> dict[str, dict[str, Any]]:
    return {face: scores[CLEAN] for face, scores in faces.items() if face != REAL}
