"""Compares lip sync in headless Chromium: ``kouxing-lips`` and three packages of npm.

No head is drawn. The microphone plays a recording in a loop. The processor time covers the page's
process: page, worker and audio thread. It is also measured without lip sync, with the same audio
context, microphone and animation frames. All packages have their default settings.

With clips, one page plays each held-out clip to all packages at the same time, and samples their
faces. The lag of a package is the one with the highest correlation of the opening. Correlation and
closures are computed for a face whose sound is delayed by this lag.

Weights of visemes become an opening by kouxing's visemes. wLipSync needs a profile, made from the
samples, or from clips for training.
"""

import gzip
import subprocess
import tempfile
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from rich.progress import track

from kouxing.corpora.lip_clips import LipClip
from kouxing.evaluation.lips.agreement import Agreement, agreement_of
from kouxing.evaluation.lips.live_faces import FRAME_RATE_HZ
from kouxing.evaluation.lips.mouths import Mouth, clip_mouth, predicted_mouth
from kouxing.evaluation.lips.references import read_parts
from kouxing.evaluation.percentiles import percentiles
from kouxing.evaluation.rivals.tables import find_node
from kouxing.evaluation.source_tree import ROOT
from kouxing.evaluation.system.chromium import Chromium, serve_folder, write_wav
from kouxing.services.cli.web_model import web_model
from kouxing.shared.arrays import Doubles, Floats
from kouxing.shared.audio.audio_file import read_audio
from kouxing.shared.clock import MEDIA_RATE_HZ
from kouxing.shared.errors import UserError
from kouxing.shared.face.faps import NUM_FAPS

OURS = "kouxing-lips"
_NONE = "none"  # a page without lip sync
_OURS_FOLDER = ROOT / "clients" / OURS
_PAGE = ROOT / "evaluation" / "system" / "lips_page.html"
MEASURE_S = 20.0
_SIZE_PX = (400, 300)
_CODE = ("index.js", "worker.js", "worklet.js", "frame-track.js", "engine")
_NUM_PROFILE_CLIPS = 60
_LIMIT_S = 60.0
_LOWER_LIP = 4  # FAP 5
_PACKAGES = "packages"
_HEAD_AUDIO = f"{_PACKAGES}/@met4citizen/headaudio/dist"
_DOWNLOADS = {  # patterns of files
    OURS: ("*.js", "engine/*.js", "models/[!b]*"),  # without the optional block network
    "HeadAudio": (f"{_HEAD_AUDIO}/*",),
    "wLipSync": (f"{_PACKAGES}/wlipsync/dist/wlipsync-single.js", "wlipsync-profile.json"),
    "wawa-lipsync": (f"{_PACKAGES}/wawa-lipsync/dist/wawa-lipsync.es.js",),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class LipsPage:
    """Figures of a package for lip sync in the browser."""

    name: str
    download_bytes: int  # code and models, compressed by gzip
    loaded_ms: float  # from a local server
    first_movement_ms: float  # from loading to the first motion of the mouth; the microphone speaks
    delay_ms: dict[str, float] | None  # from the sound to its weights: p50, p95; only kouxing-lips
    processor_share: float  # fraction of one core, including the page itself
    page_share: float  # fraction of one core that the page needs without lip sync
    num_clips: int = 0
    lag_ms: float | None = None  # lag of the opening behind the real lips, with the page's delay
    opening_correlation: float | None = None
    closure_f1: float | None = None


@dataclass(frozen=True, slots=True)
class _Site:
    """A web site with the page and all packages."""

    folder: Path
    origin: str
    voice: Path  # recording that the microphone plays

    @contextmanager
    def open_page(self, names: Sequence[str]) -> Iterator[Chromium]:
        """Open the page with some packages, and start them."""
        with tempfile.TemporaryDirectory(dir=self.folder, ignore_cleanup_errors=True) as profile:
            browser = Chromium(Path(profile), _SIZE_PX, self.voice)
            try:
                query = "&".join(f"name={name}" for name in names)
                browser.command("Page.navigate", url=f"{self.origin}/?{query}")
                browser.wait_for("window.isReady")
                browser.click("start")
                browser.wait_for("window.loadedMs")
                yield browser
            finally:
                browser.close()


def measure(audio: Path, clips: Path | None = None) -> list[LipsPage]:
    """Measure kouxing-lips, then other packages if ``npm ci`` has installed them.

    Raises ``UserError`` if Chromium or Node is not installed.
    """
    has_rivals = (_OURS_FOLDER / "node_modules" / "wlipsync").is_dir()
    if clips and not has_rivals:
        raise UserError("the packages to compare are missing; run npm ci in clients/kouxing-lips")
    names, profile = [OURS], None
    held_out, training = read_parts(clips) if clips else ([], [])
    if has_rivals:
        names = [*_DOWNLOADS]
        profile = _wlipsync_profile(_recordings(training) if clips else _demo_samples())
    try:
        with _serve_site(audio, profile) as site:
            with site.open_page([_NONE]) as browser:
                page_share = _processor_share(browser)
            pages = [
                _measure_page(site, name, page_share)
                for name in track(names, description="packages", transient=True)
            ]
            return _with_accuracy(pages, site, held_out) if held_out else pages
    except TimeoutError as error:
        raise UserError(f"the page did not respond in time: {error}") from None


@contextmanager
def _serve_site(audio: Path, profile: bytes | None) -> Iterator[_Site]:
    """Serve the page with all packages, and the profile of wLipSync, from a temporary folder."""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as name:
        folder = Path(name)
        for file in _CODE:
            if not (_OURS_FOLDER / file).exists():
                raise UserError("this command needs the source tree; run it there")
            (folder / file).symlink_to(_OURS_FOLDER / file)
        (folder / _PACKAGES).symlink_to(_OURS_FOLDER / "node_modules")
        (folder / "rivals.js").symlink_to(_OURS_FOLDER / "demo" / "rivals.js")
        (folder / "visemes.tsv").symlink_to(ROOT / "shared/face/high_level.tsv")
        (folder / "index.html").symlink_to(_PAGE)
        (folder / "models").mkdir()
        for file, content in web_model().items():
            (folder / "models" / file).write_bytes(content)
        if profile is not None:
            (folder / "wlipsync-profile.json").write_bytes(profile)
        write_wav(folder / "voice.wav", *read_audio(audio))
        with serve_folder(folder) as origin:
            yield _Site(folder, origin, folder / "voice.wav")


def _recordings(clips: Sequence[LipClip]) -> list[Floats]:
    return [clip.samples for clip in clips[:: -(-len(clips) // _NUM_PROFILE_CLIPS)]]


def _demo_samples() -> list[Floats]:
    files = sorted((ROOT / "shared/demo").glob("*.wav"))
    return [read_audio(file)[0].reshape(-1) for file in files]


def _wlipsync_profile(recordings: Iterable[Floats]) -> bytes:
    """Return a profile for wLipSync from recordings, samples at 16 kHz."""
    with tempfile.TemporaryDirectory() as name:
        for number, samples in enumerate(recordings):
            samples.astype("<f4").tofile(Path(name) / f"{number}.f32")
        script = _OURS_FOLDER / "demo" / "wlipsync-profile.mjs"
        done = subprocess.run(  # noqa: S603
            [find_node(), script, name], capture_output=True, check=False
        )
    if done.returncode:
        raise UserError(f"no profile for wLipSync: {done.stderr.decode(errors='replace')[-300:]}")
    return done.stdout


def _processor_share(browser: Chromium) -> float:
    """Measure the processor time of the page, as a fraction of one core."""
    start_s, start_cpu_s = time.monotonic(), browser.cpu_s("renderer")
    time.sleep(MEASURE_S)
    return (browser.cpu_s("renderer") - start_cpu_s) / (time.monotonic() - start_s)


def _measure_page(site: _Site, name: str, page_share: float) -> LipsPage:
    with site.open_page([name]) as browser:
        browser.wait_for("window.movedMs")
        browser.evaluate("window.delays.length = 0")
        processor_share = _processor_share(browser)
        delays_ms = 1e3 * np.array(browser.evaluate("window.delays"))
        files = {path for pattern in _DOWNLOADS[name] for path in site.folder.glob(pattern)}
        return LipsPage(
            name=name,
            download_bytes=sum(len(gzip.compress(path.read_bytes())) for path in files),
            loaded_ms=browser.evaluate("window.loadedMs"),
            first_movement_ms=browser.evaluate("window.movedMs"),
            delay_ms=percentiles(delays_ms) if name == OURS else None,
            processor_share=processor_share,
            page_share=page_share,
        )


def _with_accuracy(
    pages: Sequence[LipsPage], site: _Site, clips: Sequence[LipClip]
) -> list[LipsPage]:
    """Add the figures of the clips."""
    played_clips = []
    with site.open_page([page.name for page in pages]) as browser:
        browser.wait_for("window.play !== undefined")
        for number, clip in enumerate(track(clips, description="clips", transient=True)):
            write_wav(site.folder / f"{number}.wav", clip.samples[:, np.newaxis], MEDIA_RATE_HZ)
            browser.evaluate(f"window.rows = null; window.play('{number}.wav'); 1")
            browser.wait_for("window.rows !== null", 60.0 * clip.minutes + _LIMIT_S)
            rows = np.array(browser.evaluate("window.rows"))
            played_clips.append((rows, clip_mouth(clip)))
    return [_add_accuracy(page, column, played_clips) for column, page in enumerate(pages, 1)]


def _add_accuracy(
    page: LipsPage, column: int, played_clips: Sequence[tuple[Doubles, Mouth]]
) -> LipsPage:
    """Add the agreement with real mouths. A take has rows of a time and openings."""

    def agreement(lag_s: float) -> Agreement:
        return agreement_of(
            [(_shown_mouth(rows, column, lag_s), real) for rows, real in played_clips]
        )

    lag_ms = agreement(0.0).lag_ms
    in_sync = agreement((lag_ms or 0.0) / 1e3)
    return replace(
        page,
        num_clips=len(played_clips),
        lag_ms=lag_ms,
        opening_correlation=in_sync.correlation["opening"],
        closure_f1=in_sync.closure_f1,
    )


def _shown_mouth(rows: Doubles, column: int, lag_s: float) -> Mouth:
    """Return a column of openings as a mouth, earlier by a lag."""
    time_s = np.arange(int(rows[-1, 0] * FRAME_RATE_HZ)) / FRAME_RATE_HZ
    faps = np.zeros((len(time_s), NUM_FAPS))
    faps[:, _LOWER_LIP] = -np.interp(time_s + lag_s, rows[:, 0], rows[:, column])
    return predicted_mouth(faps)
