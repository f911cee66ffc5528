"""The recognizer: live audio in, phones, lip positions and speech events out.

``create_stream``, ``accept_waveform`` and ``decode_streams`` are named as in sherpa-onnx. There,
``get_result`` returns the whole result; here, ``take_results`` returns each result once.
"""

from collections.abc import Sequence

import numpy as np

from kouxing.services.recognizer.acoustic.acoustic_model import AcousticModel, score_segment
from kouxing.services.recognizer.acoustic.encoder import load_encoder
from kouxing.services.recognizer.acoustic.languages import load_model_for_language
from kouxing.services.recognizer.front_end.features import SAMPLE_RATE_HZ
from kouxing.services.recognizer.lips.lip_prediction import LipPredictor
from kouxing.services.recognizer.live.speech_scorer import detect_speech, score_speech
from kouxing.services.recognizer.live.stream import SpeechStream
from kouxing.services.recognizer.search.decoder import Decoder
from kouxing.services.recognizer.search.output_rule import OutputRuleConfig

_WARM_UP_S = 0.2


class Recognizer:
    """Recognizes phones in any number of live streams. ``rule`` decides when to emit a phone.

    Examples
    --------
    >>> recognizer = Recognizer(load_model())
    >>> stream = recognizer.create_stream(sample_rate_hz=48_000)
    >>> for chunk in microphone:
    ...     stream.accept_waveform(chunk)
    ...     recognizer.decode_streams([stream])
    ...     events = stream.take_results()
    """

    def __init__(self, model: AcousticModel, rule: OutputRuleConfig | None = None) -> None:
        self.model = model
        self._rule = rule or OutputRuleConfig()

    def create_stream(
        self,
        *,
        sample_rate_hz: int = SAMPLE_RATE_HZ,
        lip_predictor: LipPredictor | None = None,
        face_delay_s: float = 0.0,
        speech_time: int = 0,
        language: str | None = None,
    ) -> SpeechStream:
        """Create the stream of one session.

        The rate is 8000 to 48000 Hz. Channels are averaged. Without ``lip_predictor``, there are no
        lip positions. With it, they have the longest available delay that is still in time for a
        face with the delay ``face_delay_s``, seconds. ``speech_time`` is the media time, samples at
        16 kHz, at which the current speech started at another recognizer. The networks' blocks then
        align with the other recognizer's. ``language`` is the language of the phones; None is the
        recognizer's own. Other models are loaded at their first use.

        Raises ``UserError`` if no model has the language.
        """
        is_other = language not in (None, self.model.inventory.language)
        return SpeechStream(
            load_model_for_language(language) if is_other else self.model,
            self._rule,
            sample_rate_hz=sample_rate_hz,
            lip_predictor=lip_predictor,
            face_delay_s=face_delay_s,
            speech_time=speech_time,
        )

    def detect_speech(self, streams: Sequence[SpeechStream]) -> None:
        """Find the speech in the audio that the streams have accepted, in batches."""
        detect_speech([scorer for stream in streams for scorer in stream.scorers])

    def decode_streams(self, streams: Sequence[SpeechStream]) -> None:
        """Decode all audio that the streams have accepted; the model scores it in batches."""
        self.detect_speech(streams)
        self.decode_speech(streams)

    def decode_speech(self, streams: Sequence[SpeechStream]) -> None:
        """Decode the speech that ``detect_speech`` has found."""
        score_speech([scorer for stream in streams for scorer in stream.scorers])
        for stream in streams:
            stream.decode()

    def warm_up(self) -> None:
        """Run all compiled functions once, so that no session waits for the compiler."""
        silence = np.zeros(round(_WARM_UP_S * SAMPLE_RATE_HZ), np.float32)
        scores = score_segment(self.model, self.model.create_front_end().accept_waveform(silence))
        decoder = Decoder(self.model.topology)
        decoder.advance(scores)
        decoder.drop_records()
        decoder.final_path()
        load_encoder()
