"""Measures how far the page's sound is from its picture, in media time.

A click is detected where the sound leaves the page, after its last audio node. It is heard when the
browser says that the sound card plays that sample. A picture is seen at the display's first refresh
after it was drawn. Neither relies on the delay that the page itself assumes. On a busy machine,
single pictures are late, so the median of those near a click counts.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kouxing.evaluation.system.chromium import Chromium

NEAR_MS = 500.0  # pictures this long before and after a click count
MIN_PICTURES = 4
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


def install(browser: Chromium) -> None:
    """Watch the page that is opened next."""
    browser.command("Page.enable")
    browser.command("Page.addScriptToEvaluateOnNewDocument", source=_PROBE)


def begin(browser: Chromium) -> None:
    """Start to record clicks and pictures."""
    browser.evaluate(
        "window.probe.clicks.clear(); window.probe.pictures = [];"
        "window.kouxing.onPicture = ({ seenMs, mediaTime }) => { if (mediaTime)"
        " window.probe.pictures.push([seenMs, mediaTime / 16]) }"
    )


def offsets_ms(browser: Chromium, period_ms: float, phase_ms: float) -> NDArray[np.float64]:
    """Return how long after its picture each click is heard; negative: before it.

    Clicks have the media times ``phase_ms``, ``phase_ms + period_ms``, ….
    """
    result = browser.evaluate(_READ)
    seen_ms, media_ms = np.array(result["pictures"]).reshape(-1, 2).T
    offsets = []
    for readings in result["clicks"]:
        heard_ms = np.median(readings)
        is_near = np.abs(seen_ms - heard_ms) < NEAR_MS
        if is_near.sum() >= MIN_PICTURES and seen_ms[-1] > heard_ms + NEAR_MS:
            shown_ms = np.median((media_ms - seen_ms)[is_near]) + heard_ms  # at the click
            offsets.append((shown_ms - phase_ms + period_ms / 2) % period_ms - period_ms / 2)
    return np.array(offsets)
