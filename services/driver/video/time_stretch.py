"""Slows audio down without changing its pitch, with FFmpeg's filter atempo."""

from fractions import Fraction

import av
import numpy as np

from kouxing.shared.arrays import Floats
from kouxing.shared.clock import MEDIA_RATE_HZ

_MIN_TEMPO = 0.5  # minimum tempo of one filter
_EARLY_S = 0.02  # atempo's output is this much earlier than its input
_MIN_SAMPLES = 4096  # atempo returns nothing for fewer samples


def stretch_time(samples: Floats, speed: float) -> Floats:
    """Return audio (n,), 16 kHz, at a speed of 0.25 to 1: (round(n / speed),)."""
    if speed == 1.0:
        return samples
    num_samples = round(len(samples) / speed)
    tempos = [speed] if speed >= _MIN_TEMPO else [_MIN_TEMPO, speed / _MIN_TEMPO]
    graph = av.filter.Graph()
    source = graph.add_abuffer(
        format="flt", sample_rate=MEDIA_RATE_HZ, layout="mono", time_base=Fraction(1, MEDIA_RATE_HZ)
    )
    filters = [graph.add("atempo", f"{tempo:g}") for tempo in tempos]
    graph.link_nodes(source, *filters, graph.add("abuffersink")).configure()
    padded = np.pad(samples, (round(_EARLY_S * MEDIA_RATE_HZ), _MIN_SAMPLES))
    frame = av.AudioFrame.from_ndarray(padded[None, :], format="flt", layout="mono")
    frame.sample_rate, frame.pts = MEDIA_RATE_HZ, 0
    graph.push(frame)
    graph.push(None)
    blocks = []
    while True:
        try:
            blocks.append(graph.pull().to_ndarray()[0])
        except (av.EOFError, av.BlockingIOError):
            break
    stretched = np.concatenate(blocks)[:num_samples]
    return np.pad(stretched, (0, num_samples - len(stretched)))
