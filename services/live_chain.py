"""The whole chain in one process: sound in, FAP frames out, without sockets.

The services run the same two halves, ``SpeechStream`` and ``Face``, with messages between them.
Offline rendering and evaluation run them here; the frames are the same, bit for bit.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kouxing.services.recognizer.acoustic.acoustic_model import AcousticModel
from kouxing.services.recognizer.config import RecognizerConfig
from kouxing.services.recognizer.lip_source import LipsFromSound
from kouxing.services.recognizer.lips import lips_for
from kouxing.services.recognizer.stream import SpeechStream, StreamOutput, Waveform
from kouxing.services.synthesizer.config import SynthesizerConfig
from kouxing.services.synthesizer.face import Face, Frame
from kouxing.services.synthesizer.lips.lip_model import LipModel
from kouxing.shared.clock import MEDIA_RATE_HZ
from kouxing.shared.phones.events import SoundEvent


def sound_events(
    model: AcousticModel,
    samples: NDArray[np.float32],
    lips_from_sound: LipsFromSound | None = None,
    face_delay_s: float = 0.0,
    config: RecognizerConfig | None = None,
) -> list[SoundEvent]:
    """Return the events of a whole sound, 16 kHz mono, shape (n,); None: by default settings.

    With a model of lips there are lip frames among them, in time for a face of this delay.
    """
    config = config or RecognizerConfig()
    stream = _new_stream(model, config, MEDIA_RATE_HZ, 1, lips_from_sound, face_delay_s)
    return _events_of(stream.accept_waveform(samples) + stream.input_finished())


class LiveChain:
    """One session's sound to FAP frames.

    Parameters
    ----------
    model
        The acoustic model.
    lips
        The lip model, for the acoustic model's language.
    sample_rate_hz, num_channels
        Of the sound.
    recognizer, synthesizer
        The two services' settings; ``lips`` stands for ``synthesizer.lips``.
    lips_from_sound
        The recognizer's model of lips; None: the one that the recognizer itself would load.

    Attributes
    ----------
    events : list of SoundEvent
        What the recognizer has emitted so far.

    Examples
    --------
    >>> chain = LiveChain(load_live_model(), load_lip_model())
    >>> frames = chain.accept_waveform(samples) + chain.input_finished()
    """

    def __init__(
        self,
        model: AcousticModel,
        lips: LipModel,
        *,
        sample_rate_hz: int = MEDIA_RATE_HZ,
        num_channels: int = 1,
        recognizer: RecognizerConfig | None = None,
        synthesizer: SynthesizerConfig | None = None,
        lips_from_sound: LipsFromSound | None = None,
    ) -> None:
        recognizer = recognizer or RecognizerConfig()
        synthesizer = synthesizer or SynthesizerConfig()
        self.events: list[SoundEvent] = []
        self._stream = _new_stream(
            model,
            recognizer,
            sample_rate_hz,
            num_channels,
            lips_from_sound or lips_for(model),
            synthesizer.delay_ms / 1e3,
        )
        self._face = Face(
            lips,
            frame_rate_hz=synthesizer.frame_rate_hz,
            delay_s=synthesizer.delay_ms / 1e3,
            idle_motion_seed=synthesizer.idle_motion_seed,
            expressiveness=synthesizer.expressiveness,
        )

    def accept_waveform(self, samples: NDArray[np.float32]) -> list[Frame]:
        """Take the next samples, shape (n,) or (n, channels); return the frames that are due.

        Raises
        ------
        UserError
            If the samples have another shape or are no numbers.
        """
        return self._animate(self._stream.accept_waveform(samples))

    def input_finished(self) -> list[Frame]:
        """End the sound; return the frames still owed and those that lead to rest."""
        return self._animate(self._stream.input_finished())

    def _animate(self, outputs: list[StreamOutput]) -> list[Frame]:
        events = _events_of(outputs)
        self.events += events
        return [frame for event in events for frame in self._face.accept(event)]


def _new_stream(
    model: AcousticModel,
    config: RecognizerConfig,
    sample_rate_hz: int,
    num_channels: int,
    lips: LipsFromSound | None,
    face_delay_s: float,
) -> SpeechStream:
    return SpeechStream(
        model,
        sample_rate_hz=sample_rate_hz,
        num_channels=num_channels,
        num_stable_frames=config.num_stable_frames,
        min_confidence=config.min_confidence,
        lips=lips,
        face_delay_s=face_delay_s,
    )


def _events_of(outputs: list[StreamOutput]) -> list[SoundEvent]:
    return [output for output in outputs if not isinstance(output, Waveform)]
