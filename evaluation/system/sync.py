"""How far the page's sound is from its picture, of clicks and the pictures that belong to them.

A click is found where the sound leaves the page, behind its last node, and is heard when the
browser says that the sound card plays that sample. A picture is seen at the tick of the display
after it is drawn. Neither asks what the page itself believes of its delay.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from kouxing.evaluation.system.chromium import Chromium

APART_MS = 200.0  # between a click and its picture at most, and between two clicks at least
AROUND_MS = (500.0, 250.0)  # of a click: the time before it and after it for which it counts
MAX_GAP_MS = 70.0  # between two pictures; a page that the processor draws has one each 50 ms
# Before the page's own scripts: what is connected to the loudspeaker is also looked at.
_PROBE = """
window.probe = { clicks: new Map(), pictures: [] };
const connect = AudioNode.prototype.connect;
AudioNode.prototype.connect = function (target, ...ports) {
  if (target instanceof AudioDestinationNode) watch(this);
  return connect.call(this, target, ...ports);
};
function watch(node) {
  const { context } = node;
  const analyser = new AnalyserNode(context, { fftSize: 32768 });
  connect.call(node, analyser);
  const wave = new Float32Array(analyser.fftSize);
  setInterval(() => {
    const end = Math.round(context.currentTime * context.sampleRate);
    analyser.getFloatTimeDomainData(wave);
    const { contextTime, performanceTime } = context.getOutputTimestamp();
    for (let i = 1; i < wave.length - 1; i++) {
      if (wave[i] < 0.2 || wave[i] < wave[i - 1] || wave[i] <= wave[i + 1]) continue;
      const frame = end - wave.length + i;
      const heardMs = performanceTime + 1000 * (frame / context.sampleRate - contextTime);
      const known = [...window.probe.clicks.keys()].find((each) => Math.abs(each - frame) < 1600);
      const readings = window.probe.clicks.get(known) ?? [];
      window.probe.clicks.set(known ?? frame, [...readings, heardMs]);
    }
  }, 100);
}
"""
_READ = """
({
  clicks: [...window.probe.clicks.values()].filter((readings) => readings.length > 2),
  pictures: window.probe.pictures,
})
"""


@dataclass(frozen=True, slots=True)
class Offsets:
    """How long after its picture a sound is heard, ms; negative: before it."""

    num_clicks: int
    mean_ms: float
    p5_ms: float
    p95_ms: float
    worst_ms: float  # the one that is farthest from 0


def install(browser: Chromium) -> None:
    """Have the page that is opened next be watched."""
    browser.command("Page.enable")
    browser.command("Page.addScriptToEvaluateOnNewDocument", source=_PROBE)


def begin(browser: Chromium) -> None:
    """Begin to note clicks and pictures of a page that was loaded."""
    browser.evaluate(
        "window.probe.clicks.clear(); window.probe.pictures = [];"
        "window.kouxing.onPicture = ({ seenMs, mediaTime, faps }) =>"
        " void window.probe.pictures.push([seenMs, mediaTime ?? 0, faps[2]])"
    )


def read(browser: Chromium) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return when clicks were heard, ms, and the pictures, shape (n, 3).

    Each picture's row is when it was seen first, ms, its media time, and open_jaw.
    """
    found = browser.evaluate(_READ)
    clicks_ms = np.sort([np.median(readings) for readings in found["clicks"]])
    return clicks_ms, np.array(found["pictures"]).reshape(-1, 3)


def passages_ms(pictures: NDArray[np.float64], every: int) -> NDArray[np.float64]:
    """Return when media time was first seen to have passed each multiple of ``every`` samples."""
    number = pictures[:, 1] // every
    passages: NDArray[np.float64] = pictures[1:, 0][np.diff(number) == 1]
    return passages


def offsets_ms(clicks_ms: NDArray[np.float64], seen_ms: NDArray[np.float64]) -> list[float]:
    """Return how long after what was seen each click was heard, ms, of those with a picture."""
    nearest = [float(min(click - seen_ms, key=abs)) for click in clicks_ms if len(seen_ms)]
    return [offset for offset in nearest if abs(offset) <= APART_MS]


def with_pictures(
    clicks_ms: NDArray[np.float64], seen_ms: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the clicks around which pictures could be drawn: none waited for long for the next."""
    gaps_ms = np.diff(seen_ms)
    before, after = AROUND_MS
    return np.array(
        [
            click
            for click in clicks_ms
            if seen_ms[0] < click - before
            and seen_ms[-1] > click + after
            and gaps_ms[(seen_ms[1:] > click - before) & (seen_ms[:-1] < click + after)].max()
            < MAX_GAP_MS
        ]
    )


def summary(offsets: Sequence[float]) -> Offsets:
    """Return the figures of offsets, at least one, ms."""
    return Offsets(
        num_clicks=len(offsets),
        mean_ms=float(np.mean(offsets)),
        p5_ms=float(np.percentile(offsets, 5)),
        p95_ms=float(np.percentile(offsets, 95)),
        worst_ms=max(offsets, key=abs),
    )


def show(offsets: Offsets, console: Console) -> None:
    """Print the figures as a table."""
    table = Table("sound after picture", "mean", "p5", "p95", "worst")
    figures = (offsets.mean_ms, offsets.p5_ms, offsets.p95_ms, offsets.worst_ms)
    table.add_row(f"{offsets.num_clicks} clicks", *(f"{figure:+.0f} ms" for figure in figures))
    console.print(table)
