"""The tables of the running system: time, load, size and faults, with their physical floors."""

from collections.abc import Iterator

from kouxing.evaluation.report.markdown import Results, Table, display_floor_ms, join_values
from kouxing.evaluation.tables import format_number, percent
from kouxing.services.recognizer.hop_controller import MAX_HOP
from kouxing.shared.face.faps import NUM_FAPS

_LOOK_AHEAD_MS, _FRAME_MS = 60, 20
_FRAME_BYTES, _FRAMES_PER_S = 4 * NUM_FAPS, 50

_PACKAGE_FIGURES = {  # lower is better: name, scale and unit
    "download_bytes": ("download", 1e-6, "MB"),
    "processor_share": ("processor time", 1e2, "% of a core"),
    "loaded_ms": ("loading time", 1e-3, "s"),
    "first_movement_ms": ("time until the first movement", 1e-3, "s"),
}


def system_table(results: Results) -> Table:
    """Return each figure of the running system with its physical floor."""
    return ("figure", "value", "floor", "source of the floor"), [
        row
        for rows in (_chain_rows, _load_rows, _busy_rows, _browser_rows, _package_rows, _size_rows)
        for row in rows(results)
    ]


def _chain_rows(results: Results) -> Iterator[list[str]]:
    chain = results.get("chain")
    if not chain:
        return
    floor_cores = results.get("sizes", {}).get("floor_cores", {}).get("hop 1")
    to_frame, from_sound = chain["chunk_to_frame_ms"], chain["sound_to_frame_ms"]
    yield [
        "end of a chunk to its frame, p50 / p95, ms",
        _format_percentiles(to_frame),
        "0",
        "computation",
    ]
    yield [
        "sound to its frame, p50 / p95, ms",
        _format_percentiles(from_sound),
        str(_LOOK_AHEAD_MS),
        "look-ahead of the lips",
    ]
    yield [
        "processor time of all services, s per s of audio",
        format_number(sum(chain["cpu_s_per_audio_s"].values())),
        format_number(floor_cores),
        "operations of the networks / rate of the matrix product",
    ]
    for name, drawing in chain["page"]["drawings"].items():
        title = f"page in headless Chromium, {name}, pictures per s"
        yield [title, format_number(drawing["pictures_per_s"], ".0f"), "60", "display"]
        if drawing["voice_to_picture_ms"]:
            yield [
                "sound to its image on the page, ms",
                format_number(drawing["voice_to_picture_ms"], ".0f"),
                str(display_floor_ms(_LOOK_AHEAD_MS)),
                "look-ahead + frame + display tick",
            ]


def _load_rows(results: Results) -> Iterator[list[str]]:
    load = results.get("load")
    if not load:
        return
    summary = load["summary"]
    floor_cores = results.get("sizes", {}).get("floor_cores", {}).get(f"hop {MAX_HOP}")
    floor = load["cores"] / floor_cores if floor_cores else None
    yield [
        f"sessions on {load['cores']} cores, all speaking",
        format_number(summary["sessions"], ".0f"),
        format_number(floor, ".0f"),
        "cores / floor of the processor time; under load, the block network runs every 240 ms",
    ]
    if "recognizer_mb_per_session" in summary:
        memory = (summary[f"{name}_mb_per_session"] for name in ("recognizer", "synthesizer"))
        yield [
            "memory of a session, recognizer / synthesizer, MB",
            join_values(format_number(value, ".1f") for value in memory),
            "1.5",
            "keys and values of the block network, 2.5 s",
        ]


def _busy_rows(results: Results) -> Iterator[list[str]]:
    busy = results.get("busy")
    for run, summary in zip(busy["runs"], busy["summary"], strict=True) if busy else ():
        yield [
            f"{run['num_programs']} busy programs: largest lateness, s / frames missing, %",
            join_values([format_number(summary["worst_s"]), percent(summary["missing"], ".0f")]),
            "0",
            "",
        ]


def _browser_rows(results: Results) -> Iterator[list[str]]:
    browser = results.get("browser")
    if not browser:
        return
    yield [
        "lips in the browser: sound to weights, p50 / p95, ms",
        _format_percentiles(browser["delay_ms"]),
        format_number(_LOOK_AHEAD_MS + _FRAME_MS / 2, ".0f"),
        "look-ahead + half a frame",
    ]
    models = results.get("sizes", {}).get("model_bytes", {})
    needed = sum(models.get(name, 0) for name in ("encoder", "lips", "traits", "phone_lm")) / 1e6
    for package in (browser, *browser["others"]):
        is_ours = package is browser
        yield [
            f"{package['name']} in the browser: download, MB / share of a core, %",
            join_values(
                [
                    format_number(package["download_bytes"] / 1e6, ".1f"),
                    percent(package["processor_share"], ".0f"),
                ]
            ),
            f"{format_number(needed, '.1f')} / -" if is_ours and needed else "",
            "weights of its models" if is_ours and needed else "",
        ]
        if package["num_clips"]:
            yield [
                f"{package['name']} in the browser: lag, ms / correlation of the opening"
                " / F1 of closures",
                join_values(
                    [
                        format_number(package["lag_ms"], ".0f"),
                        format_number(package["opening_correlation"], ".2f"),
                        format_number(package["closure_f1"], ".2f"),
                    ]
                ),
                "",
                "",
            ]
    if "page_share" in browser:
        yield [
            "the page itself, included in these shares: share of a core, %",
            percent(browser["page_share"], ".0f"),
            "",
            "",
        ]


def _package_rows(results: Results) -> Iterator[list[str]]:
    package = results.get("package")
    if not package:
        return

    def row(title: str, values: list[str]) -> list[str]:
        return [f"server and kouxing-lips: {title}", join_values(values), "", ""]

    correlation, f1 = package["opening_correlation"], package["closure_f1"]
    yield row("correlation of the opening", [format_number(r, ".3f") for r in correlation.values()])
    yield row("F1 of closures", [format_number(value, ".3f") for value in f1.values()])
    for model, rates in package["phone_error_rate"].items():
        yield row(f"wrong phones ({model}), difference, %", [percent(r) for r in rates.values()])


def better_packages(results: Results) -> list[list[str]]:
    """Return a row for each figure in the browser in which another package is better."""
    browser = results.get("browser")
    if not browser:
        return []
    rows = []
    for key, (name, scale, unit) in _PACKAGE_FIGURES.items():
        best = min((browser, *browser["others"]), key=lambda package: package[key])
        if best is not browser:
            figures = [f"{format_number(p[key] * scale, '.1f')} {unit}" for p in (best, browser)]
            rows.append([f"browser, {name}", best["name"], *figures])
    return rows


def _size_rows(results: Results) -> Iterator[list[str]]:
    sizes = results.get("sizes")
    if not sizes:
        return
    total = sum(sizes["model_bytes"].values()) / 1e6
    yield ["all models of the recognizer, MB", format_number(total, ".1f"), "", ""]
    yield [
        "FAP frames to a subscriber, kB/s",
        format_number(sizes["frame_bytes"] * _FRAMES_PER_S / 1e3, ".1f"),
        format_number(_FRAME_BYTES * _FRAMES_PER_S / 1e3, ".1f"),
        f"{NUM_FAPS} floats, {_FRAMES_PER_S} times a second",
    ]


def _format_percentiles(values: Results) -> str:
    return join_values(format_number(values.get(key), ".1f") for key in ("p50", "p95"))


def faults_table(results: Results) -> Table:
    """Return the effects of each fault on a viewer."""
    columns = (
        "fault",
        "no new frame for, s",
        "late for, s",
        "frames lost",
        "phones lost / doubled / changed",
        "largest step",
        "latency p95, ms",
        "rejected sessions",
    )
    rows = []
    for outcome in results.get("faults", []):
        face = outcome["face"]
        cells = (
            [
                format_number(face["stood_s"]),
                format_number(face["late_s"]),
                str(face["frames_lost"]),
                join_values(str(face[f"phones_{kind}"]) for kind in ("lost", "doubled", "changed")),
                format_number(face["largest_step"], ".1f"),
            ]
            if face
            else [outcome["failure"], "-", "-", "-", "-"]
        )
        late_ms = format_number(outcome["late_p95_ms"], ".0f")
        rows.append([outcome["fault"], *cells, late_ms, str(outcome["num_refused"])])
    return columns, rows
