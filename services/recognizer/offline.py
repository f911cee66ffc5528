"""Offline decoding: a whole recording with the full traceback, nothing provisional.

Source: Li et al. 2011, sections 1 and 2.2, without the output rule.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from kouxing.services.recognizer.acoustic.acoustic_model import AcousticModel
from kouxing.services.recognizer.search.decoder import Decoder
from kouxing.services.recognizer.speech_scores import (
    ScoreEvent,
    SpeechEnd,
    SpeechStart,
    frame_time_s,
    score_recording,
)
from kouxing.shared.phones.events import LipFrame, Phone


def recognize(
    model: AcousticModel, samples: NDArray[np.float32], sample_rate_hz: int
) -> list[Phone]:
    """Recognise a whole recording.

    Parameters
    ----------
    model
        The acoustic model.
    samples
        Shape (n,) or (n, channels), in [-1, 1].
    sample_rate_hz
        Their rate.

    Returns
    -------
    list of Phone
        Phones of all stretches of speech with their onsets and durations, silence included.
    """
    return decode_offline(model, score_recording(model, samples, sample_rate_hz))


def decode_offline(model: AcousticModel, events: Iterable[ScoreEvent]) -> list[Phone]:
    """Like :func:`recognize`, from all scores of a recording."""
    symbols = model.inventory.phones
    decoder = Decoder(model.topology)
    phones: list[Phone] = []
    offset = 0
    confidence: list[float] = []
    for event in events:
        if isinstance(event, SpeechStart):
            offset = event.frame
            decoder.reset()
            confidence = []
        elif isinstance(event, SpeechEnd):
            for segment in decoder.finish():
                onset_s = frame_time_s(offset + segment.start)
                phones.append(
                    Phone(
                        index=len(phones),
                        symbol=symbols[segment.phone],
                        onset_s=onset_s,
                        duration_s=frame_time_s(offset + segment.end) - onset_s,
                        confidence=float(np.mean(confidence[segment.start : segment.end])),
                        final=True,
                    )
                )
        elif not isinstance(event, LipFrame):
            confidence += [decoder.accept(row)[2] for row in event.settled]
    return phones
