"""The whole pipeline in one process, without sockets: turns audio into FAP frames.

The services run the same two halves, ``SpeechStream`` and ``FaceAnimator``, and exchange messages
between them. Offline rendering and evaluation use this pipeline. Its frames equal those of the
services bit for bit.
"""

from kouxing.services.recognizer.acoustic.acoustic_model import AcousticModel
from kouxing.services.recognizer.config import RecognizerConfig
from kouxing.services.recognizer.lips.lip_prediction import LipPredictor
from kouxing.services.recognizer.lips.lip_predictor import load_lip_predictor
from kouxing.services.recognizer.live.recognizer import Recognizer
from kouxing.services.recognizer.live.stream import SpeechStream
from kouxing.services.recognizer.offline.offline_recognition import WithProgress
from kouxing.services.synthesizer.config import SynthesizerConfig
from kouxing.services.synthesizer.face_animator import Frame, configured_face
from kouxing.services.synthesizer.lips.lip_model import LipModel
from kouxing.shared.arrays import Floats
from kouxing.shared.clock import MEDIA_RATE_HZ
from kouxing.shared.phones.events import SoundEvent, Waveform


def recognize_events(
    model: AcousticModel,
    samples: Floats,
    lip_predictor: LipPredictor | None,
    face_delay_s: float = 0.0,
    config: RecognizerConfig | None = None,
) -> list[SoundEvent]:
    """Return the events of a whole sound, 16 kHz mono, shape (n,).

    With ``lip_predictor``, they include lip positions for a face with the delay ``face_delay_s``.
    Without ``config``, the default settings are used.
    """
    config = config or RecognizerConfig()
    recognizer = Recognizer(model, config.output_rule)
    stream = recognizer.create_stream(lip_predictor=lip_predictor, face_delay_s=face_delay_s)
    stream.accept_waveform(samples)
    stream.input_finished()
    return _decode(recognizer, stream)


class LivePipeline:
    """Computes the FAP frames of one session from its audio, one channel.

    ``lip_model`` is for the acoustic model's language, so ``synthesizer.lips`` is ignored. Without
    ``lip_predictor``, the recognizer uses its default predictor. ``events`` are the events that the
    recognizer has emitted so far.

    Examples
    --------
    >>> pipeline = LivePipeline(load_model(), load_lip_model())
    >>> frames = pipeline.accept_waveform(samples) + pipeline.input_finished()
    """

    def __init__(
        self,
        model: AcousticModel,
        lip_model: LipModel,
        *,
        sample_rate_hz: int = MEDIA_RATE_HZ,
        synthesizer: SynthesizerConfig | None = None,
        lip_predictor: LipPredictor | None = None,
    ) -> None:
        synthesizer = synthesizer or SynthesizerConfig()
        self.events: list[SoundEvent] = []
        self._recognizer = Recognizer(model, RecognizerConfig().output_rule)
        self._stream = self._recognizer.create_stream(
            sample_rate_hz=sample_rate_hz,
            lip_predictor=lip_predictor or load_lip_predictor(),
            face_delay_s=synthesizer.delay_ms / 1e3,
        )
        self._face = configured_face(lip_model, synthesizer)

    def accept_waveform(self, samples: Floats) -> list[Frame]:
        """Process finite samples, shape (n,), and return the frames that are due."""
        self._stream.accept_waveform(samples)
        return self._animate()

    def input_finished(self) -> list[Frame]:
        """End the audio and return the remaining frames, until the face is at rest."""
        self._stream.input_finished()
        return self._animate()

    def animate(self, samples: Floats, with_progress: WithProgress = iter) -> list[Frame]:
        """Process a whole recording, shape (n,), a second at a time; return all frames.

        The sample rate is 16 kHz. ``with_progress`` wraps the loop to show progress.
        """
        frames: list[Frame] = []
        for start in with_progress(range(0, len(samples), MEDIA_RATE_HZ)):
            frames += self.accept_waveform(samples[start : start + MEDIA_RATE_HZ])
        return frames + self.input_finished()

    def _animate(self) -> list[Frame]:
        events = _decode(self._recognizer, self._stream)
        self.events += events
        return [frame for event in events for frame in self._face.process(event)]


def _decode(recognizer: Recognizer, stream: SpeechStream) -> list[SoundEvent]:
    recognizer.decode_streams([stream])
    results = stream.take_results()
    return [result for result in results if not isinstance(result, Waveform)]
