"""Reads the sound files of commands."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from kouxing.services.recognizer.front_end.resample import Resampler
from kouxing.shared.audio_file import clipping_remarks, limited_blocks, num_clipped, open_audio
from kouxing.shared.terminal import print_message


def read_mono_16k(path: Path, track: int | None = None) -> NDArray[np.float32]:
    """Return a file's samples as the recognizer uses them: 16 kHz mono, shape ``(n,)``.

    Prints a message if the file is truncated or clipped, or has other tracks. Raises ``UserError``
    as ``kouxing.shared.audio_file.read_audio``.
    """
    source = open_audio(path, block_s=1.0, track=track)
    for notice in source.notices:
        print_message(notice)
    resampler = Resampler(source.sample_rate_hz, source.num_channels)
    parts = []
    num_samples = clipped = 0
    for block in limited_blocks(source):
        parts.append(resampler.accept_waveform(block))
        num_samples += block.size
        clipped += num_clipped(block)
    for remark in (*source.remarks, *clipping_remarks(str(path), clipped / max(1, num_samples))):
        print_message(remark)
    return np.concatenate([*parts, resampler.finish()])
