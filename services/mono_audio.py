"""Reads audio files as 16 kHz mono, the format of the recognizer."""

import math
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from rich.progress import Progress

from kouxing.services.recognizer.front_end.resample import Resampler
from kouxing.shared.arrays import Floats
from kouxing.shared.audio.audio_file import limited_blocks, open_audio
from kouxing.shared.audio.level_check import LevelCheck
from kouxing.shared.audio.phase_cancellation import Samples
from kouxing.shared.command.terminal import print_message


def read_mono_16k(path: Path, track: int | None = None, progress: Progress | None = None) -> Floats:
    """Return a file's samples, 16 kHz mono, shape ``(n,)``.

    Prints a message if the file is truncated, has a wrong level, or has other tracks. Raises
    ``UserError`` as ``kouxing.shared.audio.audio_file.read_audio``.
    """
    source = open_audio(path, block_s=1.0, track=track)
    for notice in source.notices:
        print_message(notice)
    resampler = Resampler(source.sample_rate_hz)
    content = bytearray()  # grows in place, because joining pieces would need twice the memory
    level = LevelCheck()
    blocks: Iterable[Samples] = limited_blocks(source)
    if progress is not None:
        num_blocks = None if source.duration_s is None else math.ceil(source.duration_s)
        blocks = progress.track(blocks, total=num_blocks, description="reading")
    for block in blocks:
        content += resampler.accept_waveform(block).data
        level.add(block)
    content += resampler.finish().data
    for warning in (*source.warnings, *level.warnings(str(path))):
        print_message(warning)
    return np.frombuffer(content, np.float32)
