"""Audio file to phones and FAP frames in one process, without running services.

The same recognizer and synthesizer as live, fed in the same 20 ms steps: the frames are those that
the services would send.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from services.recognizer.load import load_model
from services.recognizer.pcm import level_db, slices
from services.recognizer.pipeline import Recognizer
from services.recognizer.resample import Resampler
from services.synthesizer.live import REST_S, LiveSynthesizer
from services.synthesizer.parameters import load_parameters
from services.terminal import say
from shared.audio_file import clipping_remarks, num_clipped, open_audio
from shared.config import RecognizerConfig, SynthesizerConfig
from shared.messages import MEDIA_RATE_HZ
from shared.phones import Phone, SpeechChange

ProgressCallback = Callable[[float], None]  # takes the share that is done, 0 to 1
Frame = tuple[float, NDArray[np.float32]]  # media time in seconds, FAPs (68,)


def mono_16k(path: Path) -> NDArray[np.float32]:
    """Return a file's samples as the recognizer hears them: 16 kHz mono, shape ``(n,)``.

    Tells the user if the file is cut off or clipped.

    Raises
    ------
    UserError
        As ``shared.audio_file.open_audio``.
    """
    source = open_audio(path, block_s=1.0)
    resampler = Resampler(source.sample_rate_hz, source.num_channels)
    parts = []
    num_samples = clipped = 0
    for block in source.blocks:
        parts.append(resampler.accept_waveform(block))
        num_samples += block.size
        clipped += num_clipped(block)
    for remark in (*source.remarks, *clipping_remarks(str(path), clipped / max(1, num_samples))):
        say(remark)
    return np.concatenate([*parts, resampler.finish()])


def live_frames(
    samples: NDArray[np.float32],
    *,
    on_progress: ProgressCallback = lambda _share: None,
) -> tuple[list[Phone], list[Frame]]:
    """Return the phones and FAP frames that the live system, by its defaults, makes of a sound.

    Parameters
    ----------
    samples
        16 kHz mono, shape ``(n,)``.
    on_progress
        Told the share that is done.
    """
    rule, timing = RecognizerConfig(), SynthesizerConfig()
    look_ahead_s = timing.look_ahead_ms / 1e3
    recognizer = Recognizer(
        load_model(),
        sample_rate_hz=MEDIA_RATE_HZ,
        agreement=rule.agreement,
        least_confidence=rule.least_confidence,
    )
    synthesizer = LiveSynthesizer(
        load_parameters(),
        frame_rate_hz=timing.frame_rate_hz,
        look_ahead_s=look_ahead_s,
        gesture_seed=timing.gesture_seed,
    )
    phones: list[Phone] = []
    frames: list[Frame] = []

    def take(results: list[Phone | SpeechChange]) -> None:
        for result in results:
            if isinstance(result, Phone):
                phones.append(result)
                synthesizer.accept_phone(result)
            else:
                synthesizer.accept_speech(result)

    num_heard = 0
    for part in slices(samples, 0):
        num_heard += len(part)
        take(recognizer.accept_waveform(part))
        synthesizer.accept_level(num_heard / MEDIA_RATE_HZ, level_db(part))
        frames += synthesizer.advance(num_heard / MEDIA_RATE_HZ)
        on_progress(num_heard / len(samples))
    take(recognizer.input_finished())
    end_s = num_heard / MEDIA_RATE_HZ
    synthesizer.accept_speech(SpeechChange(active=False, time_s=end_s))
    frames += synthesizer.advance(end_s + look_ahead_s + REST_S)
    return phones, frames
