"""Measures how far the page's sound is from its picture.

A click is detected where the sound leaves the page, after its last audio node. It is heard when the
browser says that the sound card plays that sample. A picture is seen at the display's first refresh
after it was drawn. Neither relies on the delay that the page itself assumes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kouxing.evaluation.system.chromium import Chromium

AROUND_MS = (500.0, 250.0)  # a click counts if pictures were drawn this long before and after it
MAX_GAP_MS = 70.0  # between two pictures; a page that the processor draws has one every 50 ms
# Runs before the page's own scripts, and also watches every node connected to the loudspeaker.
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
      const known = [...window.probe.clicks.keys()].find((at) => Math.abs(at - frame) < 1600);
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

    mean_ms: float
    p5_ms: float
    p95_ms: float


def install(browser: Chromium) -> None:
    """Watch the page that is opened next."""
    browser.command("Page.enable")
    browser.command("Page.addScriptToEvaluateOnNewDocument", source=_PROBE)


def begin(browser: Chromium) -> None:
    """Start to record clicks and pictures."""
    browser.evaluate(
        "window.probe.clicks.clear(); window.probe.pictures = [];"
        "window.kouxing.onPicture = ({ seenMs, mediaTime, faps }) =>"
        " void window.probe.pictures.push([seenMs, mediaTime ?? 0, faps[2]])"
    )


def read(browser: Chromium) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return when clicks were heard, ms, and the pictures, shape (n, 3).

    A picture's row holds when it was first seen, ms, its media time, and its open_jaw.
    """
    result = browser.evaluate(_READ)
    clicks_ms = np.sort([np.median(readings) for readings in result["clicks"]])
    return clicks_ms, np.array(result["pictures"]).reshape(-1, 3)


def with_pictures(
    clicks_ms: NDArray[np.float64], seen_ms: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the clicks around which no picture was late."""
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
    """Return the mean and percentiles of at least one offset, ms."""
    p5, p95 = np.percentile(offsets, [5, 95])
    return Offsets(float(np.mean(offsets)), float(p5), float(p95))
