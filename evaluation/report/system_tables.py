"""The tables of the running system: time, load, size, faults and attacks, with physical floors."""

from collections.abc import Iterator, Sequence

from kouxing.evaluation.report.lip_tables import display_floor_ms
from kouxing.evaluation.tables import Figures, Table, format_number, join_values, percent
from kouxing.services.recognizer.sessions.hop_controller import MAX_HOP_BLOCKS
from kouxing.shared.face.faps import NUM_FAPS

_DELAY_MS, _FRAME_MS = 60, 20
_FRAME_BYTES, _FRAMES_PER_S = 4 * NUM_FAPS, 50
_WEB_MODELS = ("encoder", "lips", "traits", "phone_lm")  # of kouxing-lips

_PACKAGE_FIGURES = {  # lower is better: name, scale and unit
    "download_bytes": ("download", 1e-6, "MB"),
    "processor_share": ("processor time", 1e2, "% of a core"),
    "loaded_ms": ("loading time", 1e-3, "s"),
    "first_movement_ms": ("time until the first movement", 1e-3, "s"),
}


def system_table(
    latency: Figures | None = None,
    load: Figures | None = None,
    busy: Figures | None = None,
    browser: Figures | None = None,
    package: Figures | None = None,
    sizes: Figures | None = None,
) -> Table:
    """Return each figure of the measured steps with its physical floor."""
    steps = (
        (latency, _latency_rows),
        (load, _load_rows),
        (busy, _busy_rows),
        (browser, _browser_rows),
        (package, _package_rows),
        (sizes, _size_rows),
    )
    rows = [row for figures, make in steps if figures for row in make(figures, sizes or {})]
    return Table(("figure", "value", "floor", "source of the floor"), rows)


def _row(figure: str, value: str, floor: str = "", source: str = "") -> list[str]:
    return [figure, value, floor, source]


def _latency_rows(latency: Figures, sizes: Figures) -> Iterator[list[str]]:
    floor_cores = sizes.get("floor_cores", {}).get("hop 1")
    yield _row(
        "end of a chunk to its frame, p50 / p95, ms",
        _format_percentiles(latency["chunk_to_frame_ms"]),
        "0",
        "computation",
    )
    yield _row(
        "sound to its frame, p50 / p95, ms",
        _format_percentiles(latency["sound_to_frame_ms"]),
        str(_DELAY_MS),
        "delay of the face",
    )
    yield _row(
        "processor time of all services, s per s of audio",
        format_number(sum(latency["cpu_s_per_audio_s"].values())),
        format_number(floor_cores),
        "operations of the networks / rate of the matrix product",
    )
    for name, drawing in latency["page"]["drawings"].items():
        title = f"page in headless Chromium, {name}, images per s"
        yield _row(title, f"{drawing['pictures_per_s']:.0f}", "60", "display")
        if drawing["voice_to_picture_ms"]:
            yield _row(
                "sound to its image on the page, ms",
                f"{drawing['voice_to_picture_ms']:.0f}",
                str(display_floor_ms(_DELAY_MS)),
                "delay + frame + display tick",
            )


def _load_rows(load: Figures, sizes: Figures) -> Iterator[list[str]]:
    summary = load["summary"]
    floor_cores = sizes.get("floor_cores", {}).get(f"hop {MAX_HOP_BLOCKS}")
    yield _row(
        f"sessions on {load['cores']} cores, all speaking",
        f"{summary['sessions']:.0f}",
        format_number(load["cores"] / floor_cores if floor_cores else None, ".0f"),
        "cores / floor of the processor time; under load, the block network runs every 240 ms",
    )
    if "recognizer_mb_per_session" in summary:
        memory = (summary[f"{name}_mb_per_session"] for name in ("recognizer", "synthesizer"))
        yield _row(
            "memory of a session, recognizer / synthesizer, MB",
            join_values(f"{value:.1f}" for value in memory),
            "1.5",
            "keys and values of the block network, 2.5 s",
        )


def _busy_rows(busy: Figures, _: Figures) -> Iterator[list[str]]:
    for run, summary in zip(busy["runs"], busy["summary"], strict=True):
        yield _row(
            f"{run['num_programs']} busy programs: largest lateness, s / frames missing, %",
            join_values([format_number(summary["worst_s"]), percent(summary["missing"], ".0f")]),
            "0",
        )


def _browser_rows(browser: Figures, sizes: Figures) -> Iterator[list[str]]:
    yield _row(
        "lips in the browser: sound to weights, p50 / p95, ms",
        _format_percentiles(browser["delay_ms"]),
        f"{_DELAY_MS + _FRAME_MS / 2:.0f}",
        "delay + half a frame",
    )
    models = sizes.get("model_bytes", {})
    weights_mb = sum(models.get(name, 0) for name in _WEB_MODELS) / 1e6
    our_floor = (f"{weights_mb:.1f} / -", "weights of its models") if weights_mb else ()
    for package in (browser, *browser["others"]):
        download_mb = f"{package['download_bytes'] / 1e6:.1f}"
        yield _row(
            f"{package['name']} in the browser: download, MB / share of a core, %",
            join_values([download_mb, percent(package["processor_share"], ".0f")]),
            *(our_floor if package is browser else ()),
        )
        if package["num_clips"]:
            scores = (package["opening_correlation"], package["closure_f1"])
            yield _row(
                f"{package['name']} in the browser: lag, ms / correlation of the opening"
                " / F1 of closures",
                join_values([format_number(package["lag_ms"], ".0f"), *map(format_number, scores)]),
            )
    if "page_share" in browser:
        yield _row(
            "the page itself, included in these shares: share of a core, %",
            percent(browser["page_share"], ".0f"),
        )


def _package_rows(package: Figures, _: Figures) -> Iterator[list[str]]:
    title = "server and kouxing-lips"
    figures = {
        "correlation of the opening": package["opening_correlation"],
        "F1 of closures": package["closure_f1"],
    }
    for name, values in figures.items():
        yield _row(
            f"{title}: {name}", join_values(format_number(r, ".3f") for r in values.values())
        )
    for model, rates in package["phone_error_rate"].items():
        yield _row(
            f"{title}: wrong phones ({model}), difference, %",
            join_values(map(percent, rates.values())),
        )


def _size_rows(sizes: Figures, _: Figures) -> Iterator[list[str]]:
    total_mb = sum(sizes["model_bytes"].values()) / 1e6
    yield _row("all models of the recognizer, MB", f"{total_mb:.1f}")
    yield _row(
        "FAP frames to a subscriber, kB/s",
        f"{sizes['frame_bytes'] * _FRAMES_PER_S / 1e3:.1f}",
        f"{_FRAME_BYTES * _FRAMES_PER_S / 1e3:.1f}",
        f"{NUM_FAPS} floats, {_FRAMES_PER_S} times a second",
    )


def _format_percentiles(values: Figures) -> str:
    return join_values(format_number(values.get(key), ".1f") for key in ("p50", "p95"))


def better_packages(browser: Figures) -> list[list[str]]:
    """Return a row for each figure in the browser in which another package is better."""
    rows = []
    for key, (name, scale, unit) in _PACKAGE_FIGURES.items() if browser else ():
        best = min((browser, *browser["others"]), key=lambda package: package[key])
        if best is not browser:
            figures = [f"{package[key] * scale:.1f} {unit}" for package in (best, browser)]
            rows.append([f"browser, {name}", best["name"], *figures])
    return rows


def faults_table(outcomes: Sequence[Figures]) -> Table:
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
    for outcome in outcomes:
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
            else ["-"] * 5
        )
        late_ms = format_number(outcome["late_p95_ms"], ".0f")
        notes = [f"not completed: {outcome['failure']}"] if outcome["failure"] else []
        title = "; ".join([outcome["fault"], *notes])
        rows.append([title, *cells, late_ms, str(outcome["num_refused"])])
    return Table(columns, rows)


def attacks_table(results: Sequence[Figures]) -> Table:
    """Return the effects of attacks, with the memory of the service that grew most."""
    phases = "p95 ms before / during / after"
    columns = ("attack", "target", "key", "service", "growth MB", "kept MB", phases)
    rows = []
    for result in results:
        worst = max(result["growth_mb"], key=result["growth_mb"].__getitem__)
        notes = (f"{service} restarted" for service in result["restarted"])
        rows.append(
            [
                "; ".join([result["attack"], *notes]),
                result["target"],
                "yes" if result["has_key"] else "no",
                worst,
                f"{result['growth_mb'][worst]:.1f}",
                f"{result['kept_mb'][worst]:.1f}",
                join_values(format_number(ms, ".0f") for ms in result["p95_ms"].values()),
            ]
        )
    return Table(columns, rows)
