"""Offline decoding: the phones of a whole recording by full traceback, without corrections.

Source: Li et al. 2011, sections 1 and 2.2, without the output rule.
"""

from collections.abc import Iterable

import numpy as np

from kouxing.services.recognizer.acoustic.acoustic_model import AcousticModel, Floats
from kouxing.services.recognizer.front_end.features import frame_time_s
from kouxing.services.recognizer.search.decoder import Decoder
from kouxing.services.recognizer.speech_scorer import (
    FrameScores,
    ScoreEvent,
    WithProgress,
    score_recording,
)
from kouxing.services.recognizer.speech_segmenter import SpeechEnd, SpeechStart
from kouxing.shared.phones.events import Phone


def recognize(
    model: AcousticModel, samples: Floats, sample_rate_hz: int, with_progress: WithProgress = iter
) -> list[Phone]:
    """Recognize the phones of a recording, (n,) or (n, channels), and silence within speech.

    ``with_progress`` shows the progress.
    """
    return decode_offline(
        model, score_recording(model, samples, sample_rate_hz, with_progress=with_progress)
    )


def decode_offline(model: AcousticModel, events: Iterable[ScoreEvent]) -> list[Phone]:
    """Like :func:`recognize`, from the scores of a recording."""
    decoder = Decoder(model.topology)
    phones: list[Phone] = []
    offset = 0
    confidence: list[float] = []
    for event in events:
        if isinstance(event, SpeechStart):
            offset = event.frame
            decoder.reset()
            confidence = []
        elif isinstance(event, FrameScores):
            for row in event.settled:
                decoder.advance(row[None])
                confidence.append(decoder.last_phone.confidence)
        elif isinstance(event, SpeechEnd):
            for segment in decoder.final_path():
                onset_s = frame_time_s(offset + segment.start)
                phones.append(
                    Phone(
                        index=len(phones),
                        symbol=model.inventory.phones[segment.phone],
                        onset_s=onset_s,
                        duration_s=frame_time_s(offset + segment.end) - onset_s,
                        confidence=float(np.mean(confidence[segment.start : segment.end])),
                        final=True,
                    )
                )
    return phones
