"""The whole chain in one process, without sockets: audio in, FAP frames out.

The services run the same two halves, ``SpeechStream`` and ``Face``, and exchange messages between
them. Offline rendering and evaluation use this chain. Its frames are identical, bit for bit.
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
    """Return the events of a whole sound, 16 kHz mono, shape (n,).

    With ``lips_from_sound``, they include lip frames for a face with the delay ``face_delay_s``.
    Without ``config``, the default settings are used.
    """
    config = config or RecognizerConfig()
    stream = _new_stream(model, config, MEDIA_RATE_HZ, 1, lips_from_sound, face_delay_s)
    return _events_of(stream.accept_waveform(samples) + stream.input_finished())


class LiveChain:
    """Computes the FAP frames of one session from its audio.

    Parameters
    ----------
    model
        The acoustic model.
    lips
        The lip model, for the acoustic model's language.
    sample_rate_hz, num_channels
        Format of the audio.
    recognizer, synthesizer
        Settings of the two services. ``synthesizer.lips`` is ignored.
    lips_from_sound
        The network that predicts learnt lips. If None, the recognizer's default.

    Attributes
    ----------
    events : list of SoundEvent
        The events that the recognizer has emitted so far.

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
        """Process samples, shape (n,) or (n, channels), and return the frames that are due.

        Raises
        ------
        UserError
            If the samples have another shape or are not finite.
        """
        return self._animate(self._stream.accept_waveform(samples))

    def input_finished(self) -> list[Frame]:
        """End the audio and return the remaining frames, until the face is at rest."""
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
