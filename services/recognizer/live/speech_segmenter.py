"""Finds the speech in one session's audio, and predicts the lips during speech.

    samples -> front ends -> audio encoder -> [speech only] feature frames, lip positions

Time is media time, counted from the first sample. Feature frame ``t`` covers the 10 ms around the
middle of its window. Any chunking of the same audio gives the same result, because every step
processes whole encoder frames, in order.
"""

from collections import deque
from collections.abc import Iterator, Sequence
from typing import TypeAlias

import numpy as np

from kouxing.services.recognizer.acoustic.acoustic_model import FrontEnd
from kouxing.services.recognizer.acoustic.encoder import EncoderOutput, EncoderStream, load_encoder
from kouxing.services.recognizer.acoustic.network import FRAMES_PER_ENCODER_FRAME
from kouxing.services.recognizer.front_end.features import HOP_S, WINDOW_S
from kouxing.services.recognizer.front_end.vad import VoiceActivityDetector
from kouxing.services.recognizer.front_end.whisper_mel import NUM_MELS, WhisperMel
from kouxing.services.recognizer.lips.lip_prediction import LipPredictorStream
from kouxing.services.recognizer.live.voice_traits import (
    VoiceTraits,
    VoiceTraitsStream,
    load_voice_readout,
)
from kouxing.shared.arrays import Floats
from kouxing.shared.fast_record import Record
from kouxing.shared.phones.events import LipPositions

PRE_ROLL_S = 0.20  # audio before the detection that counts as speech: weak consonants
_DETECTION_S = 0.06  # the encoder's look-ahead, and an encoder frame
# Encoder frames end at odd feature frames, ``ENCODER_FRAME_LAG_S`` before a multiple of 20 ms.
# Therefore speech starts at an odd frame.
_FIRST_FRAME_PARITY = 1
_RIGHT_CONTEXT_FRAMES = 2  # frames after speech starts that its first lip positions need
_BLOCK_FRAMES = 4  # frames in a block of the network; blocks start with the speech
_PRE_ROLL_FRAMES = round((PRE_ROLL_S + _DETECTION_S) / HOP_S)
_MAX_RECENT = (_PRE_ROLL_FRAMES + _BLOCK_FRAMES) // FRAMES_PER_ENCODER_FRAME


class SpeechStart(Record, frozen=True):
    """Start of speech; its first frame is ``frame``."""

    frame: int


class SpeechEnd(Record, frozen=True):
    """End of speech, before ``frame``."""

    frame: int


class SpeechFrames(Record, frozen=True):
    """The next feature frames of speech; they end with an encoder frame."""

    features: Floats  # (n, k), of the front end
    phones: Floats  # (n, phones), the encoder's log posteriors after each frame


class EncoderInput(Record, frozen=True):
    """The input of the audio encoder for an encoder frame, and the front end's features."""

    features: Floats  # (2, k)
    mels: Floats  # (2, 80)


SpeechItem: TypeAlias = SpeechStart | SpeechEnd | SpeechFrames | LipPositions


class SpeechSegmenter:
    """Divides the audio of one session into speech and pauses.

    ``front_end`` computes the feature frames. Without ``lip_stream``, there are no lip positions.
    ``start_frame`` is the frame at which speech started at another recognizer, negative before the
    audio. The first speech then starts where the network's blocks align with the other
    recognizer's.
    """

    def __init__(
        self,
        front_end: FrontEnd,
        lip_stream: LipPredictorStream | None,
        start_frame: int | None = None,
    ) -> None:
        self._front_end = front_end
        self._mel = None if isinstance(front_end, WhisperMel) else WhisperMel()
        self._lip_stream = lip_stream
        self._start_frame = start_frame
        self.encoder = EncoderStream(load_encoder())
        self._detector = VoiceActivityDetector()
        self._traits = VoiceTraitsStream(load_voice_readout())
        self._mels = np.empty((0, NUM_MELS), np.float32)  # log-mel frames of the next encoder frame
        self._features: Floats | None = None  # feature frames of the next encoder frame
        # Features and encoder frames before speech
        self._recent: deque[tuple[Floats, EncoderOutput]] = deque(maxlen=_MAX_RECENT)
        self._num_frames = 0
        self._is_speaking = False

    @property
    def traits(self) -> VoiceTraits:
        """Traits of the voice at the end of the audio."""
        return self._traits.newest

    def accept_waveform(self, samples: Floats) -> Iterator[SpeechItem]:
        """Accept samples, 16 kHz mono, shape (n,); yield the resulting items."""
        for encoder_input in self.encoder_inputs(samples):
            yield from self.process(
                encoder_input, self.encoder.process_encoder_frame(encoder_input.mels)
            )

    def encoder_inputs(self, samples: Floats) -> Iterator[EncoderInput]:
        """Accept samples, 16 kHz mono, shape (n,); yield the new encoder frames to process."""
        features = self._front_end.accept_waveform(samples)
        mels = features if self._mel is None else self._mel.accept_waveform(samples)
        self._mels = np.concatenate([self._mels, mels])
        if self._features is not None:
            features = np.concatenate([self._features, features])
        while len(self._mels) >= FRAMES_PER_ENCODER_FRAME:
            yield EncoderInput(
                features[:FRAMES_PER_ENCODER_FRAME], self._mels[:FRAMES_PER_ENCODER_FRAME]
            )
            self._mels = self._mels[FRAMES_PER_ENCODER_FRAME:]
            features = features[FRAMES_PER_ENCODER_FRAME:]
        self._features = features

    def input_finished(self) -> Iterator[SpeechItem]:
        """End the audio."""
        if self._is_speaking:
            yield self._end_speech()

    def process(self, encoder_input: EncoderInput, output: EncoderOutput) -> Iterator[SpeechItem]:
        """Start or end speech and predict lips after an encoder frame, given its output."""
        features = encoder_input.features
        self._num_frames += len(features)
        if self._is_speaking:
            yield _frames_of([(features, output)])
        else:
            self._recent.append((features, output))
        self._detector.update(output.voice)
        self._traits.process_encoder_frame(output)
        if self._is_speaking and not self._detector.is_speech:
            yield self._end_speech()
        elif self._is_speaking:
            yield from self._predict_lips(output, self._num_frames - 1)
        elif self._detector.is_speech:
            yield from self._start_speech()

    def _start_speech(self) -> Iterator[SpeechItem]:
        first = self._first_frame()
        if self._num_frames - first < FRAMES_PER_ENCODER_FRAME:
            return
        self._is_speaking = True
        self._start_frame = None
        yield SpeechStart(first)
        num_frames = self._num_frames - first
        frames = _frames_of(self._recent)
        yield SpeechFrames(frames.features[-num_frames:], frames.phones[-num_frames:])
        if self._lip_stream is not None:
            self._lip_stream.reset()
        newest = self._num_frames - 1 - FRAMES_PER_ENCODER_FRAME * (len(self._recent) - 1)
        for _, output in self._recent:
            if newest >= first + _RIGHT_CONTEXT_FRAMES:
                yield from self._predict_lips(output, newest)
            newest += FRAMES_PER_ENCODER_FRAME
        self._recent.clear()

    def _first_frame(self) -> int:
        """Return the frame at which speech starts if it is detected now."""
        oldest = self._num_frames - FRAMES_PER_ENCODER_FRAME * len(self._recent)
        first = max(oldest, self._num_frames - _PRE_ROLL_FRAMES)
        first += (_FIRST_FRAME_PARITY - first) % FRAMES_PER_ENCODER_FRAME
        if self._start_frame is not None:
            first -= (first - self._start_frame) % _BLOCK_FRAMES
            first += _BLOCK_FRAMES * (first < oldest)
        return first

    def _end_speech(self) -> SpeechEnd:
        self._is_speaking = False
        return SpeechEnd(self._num_frames)

    def _predict_lips(self, output: EncoderOutput, newest_frame: int) -> list[LipPositions]:
        """Predict from an encoder frame, whose last feature frame is ``newest_frame``."""
        if self._lip_stream is None:
            return []
        known_s = newest_frame * HOP_S + WINDOW_S
        return self._lip_stream.process_encoder_frame(known_s, output.frames, output.features)


def _frames_of(recent: Sequence[tuple[Floats, EncoderOutput]]) -> SpeechFrames:
    """Return the feature frames of some encoder frames."""
    phones = np.array([output.phones for _, output in recent])
    features = np.concatenate([features for features, _ in recent])
    return SpeechFrames(features, phones.repeat(FRAMES_PER_ENCODER_FRAME, axis=0))
