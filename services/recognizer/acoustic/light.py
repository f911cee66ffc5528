"""Light model: scores phones with the audio encoder, for weak or busy machines.

The encoder processes all audio anyway, so this model costs only the search. HMMs and phone
language model come from the block model.

======== ============================================================== ==================
symbol   meaning                                                        shape
======== ============================================================== ==================
q        log posteriors of the phones, from the encoder                 (frames, phones)
prior    prior of the phones, to a power below one                      (phones,)
======== ============================================================== ==================

    log b(x) = acoustic_scale * (q - log prior), the same for all states of a phone

After frame ``t``, the encoder outputs the posteriors of frame ``t - PHONES_LAG_FRAMES``. At the end
of a segment, the last posteriors are repeated.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np

from kouxing.services.recognizer.acoustic.acoustic_model import (
    AcousticModel,
    AcousticStream,
    ScoreRequest,
    Topology,
)
from kouxing.services.recognizer.acoustic.encoder import (
    PHONES_LAG_FRAMES,
    EncoderStream,
    load_encoder,
)
from kouxing.services.recognizer.acoustic.model_file import Archive, parse_topology
from kouxing.services.recognizer.acoustic.network import FRAMES_PER_ENCODER_FRAME
from kouxing.services.recognizer.front_end.whisper_mel import NUM_MELS, WhisperMel
from kouxing.shared.arrays import Floats
from kouxing.shared.phones.inventory import DEFAULT_LANGUAGE

_ACOUSTIC_SCALE = 1.0


class EncoderPhones:
    """A front end that runs the encoder and returns its log posteriors, (frames, phones)."""

    def __init__(self) -> None:
        self._mel = WhisperMel()
        self._encoder = EncoderStream(load_encoder())
        self._rows = np.empty((0, load_encoder().num_phones), np.float32)
        self._frames = np.empty((0, NUM_MELS), np.float32)

    def accept_waveform(self, samples: Floats) -> Floats:
        """Accept samples, shape (n,), 16 kHz, in [-1, 1]; return the new rows."""
        self._frames = np.concatenate([self._frames, self._mel.accept_waveform(samples)])
        rows = [self._rows[:0]]
        while len(self._frames) >= FRAMES_PER_ENCODER_FRAME:
            output = self._encoder.process_encoder_frame(self._frames[:FRAMES_PER_ENCODER_FRAME])
            rows.append(output.phones[np.newaxis].repeat(FRAMES_PER_ENCODER_FRAME, axis=0))
            self._frames = self._frames[FRAMES_PER_ENCODER_FRAME:]
        return np.concatenate(rows)


@dataclass(frozen=True, kw_only=True)
class LightModel(AcousticModel):
    """Scores from the encoder's phones."""

    log_prior: Floats  # (phones,)

    def create_front_end(self) -> EncoderPhones:
        """Create a front end with its own encoder."""
        return EncoderPhones()

    def create_stream(self) -> LightStream:
        """Create the stream of one speaker."""
        return LightStream(self)

    def score(self, requests: Sequence[ScoreRequest]) -> list[Floats]:
        """Score the encoder's rows of several streams; None ends a stream's segment."""
        return [
            self._compute_scores(cast(LightStream, stream).take(rows)) for stream, rows in requests
        ]

    def _compute_scores(self, rows: Floats) -> Floats:
        num_states = np.diff(self.topology.first_state)
        scores = np.float32(_ACOUSTIC_SCALE) * (rows - self.log_prior)
        return np.repeat(scores, num_states, axis=1)


class LightStream(AcousticStream):
    """Scores of one speaker's speech, segment by segment."""

    uses_encoder_phones = True
    look_ahead_frames = PHONES_LAG_FRAMES

    def __init__(self, model: LightModel) -> None:
        super().__init__(model)
        self._no_rows = np.empty((0, len(model.log_prior)), np.float32)
        self.reset()

    def reset(self) -> None:
        """Reset the state of the segment."""
        self.start(0)

    def start(self, num_missing: int) -> None:
        """Continue another stream, whose last ``num_missing`` frames have no scores yet."""
        self._num_missing = num_missing  # frames that have no scores yet
        self._num_early = PHONES_LAG_FRAMES - num_missing  # rows for frames that have scores
        self._last = self._no_rows

    def take(self, rows: Floats | None) -> Floats:
        """Return the rows of the next frames to score."""
        if rows is None:
            rows = self._last.repeat(self._num_missing, axis=0)
            self.reset()
            return rows
        self._num_missing += len(rows)
        if len(rows):
            self._last = rows[-1:]
        if self._num_early < 0 and len(rows):
            rows = np.concatenate([rows[:1].repeat(-self._num_early, axis=0), rows])
            self._num_early = 0
        num_early = min(len(rows), self._num_early)
        self._num_early -= num_early
        self._num_missing -= len(rows) - num_early
        return rows[num_early:]


def build_light_model(topology: Topology, log_prior: Floats) -> LightModel | None:
    """Build the model for HMMs with a prior of their states, (states,).

    Returns None if the encoder has other phones.
    """
    inventory = topology.inventory
    if (inventory.language, len(inventory)) != (DEFAULT_LANGUAGE, load_encoder().num_phones):
        return None
    priors = np.add.reduceat(np.exp(log_prior), topology.first_state[:-1])
    return LightModel(topology=topology, log_prior=np.log(priors))


def parse_light_model(archive: Archive) -> LightModel:
    """Build the model from a block model's file; raises ``ValueError`` if a size is wrong."""
    topology = parse_topology(archive)
    model = build_light_model(topology, archive.floats("log_prior", topology.num_states))
    if model is None:
        raise ValueError("its phones differ from the audio encoder's phones")
    return model
