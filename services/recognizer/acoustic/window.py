"""Window model: Whisper's encoder as it is, anew on the last seconds of speech, run by onnxruntime.

Sources: Radford et al. 2023, "Robust speech recognition via large-scale weak supervision" (the
encoder and its weights, unchanged but for 8-bit products); Bourlard and Morgan 1994, "Connectionist
speech recognition" (scores are posteriors divided by priors). HMMs, search and output rule are
those of Li et al. 2011. A readout with a small recurrent layer gives the states' posteriors
(:mod:`training.window.readout`). In each window every position attends to every other, as Whisper
was trained, so what it knows of rooms, microphones and ways of speaking stays.

============== ===================================================== ==========================
symbol         meaning                                               unit, shape
============== ===================================================== ==========================
x              log-mel bands of a window's frames                    (frames, 80)
y              log posteriors of the states                          (frames, states)
W              longest window                                        frames
H              hop: there is a window at every H frames of a segment frames
L              look-ahead that was asked for, 0 or more              frames
R              right context of settled scores, 15 or L if more      frames
prior          prior of the states, to a power below one             (states,)
acoustic_scale weight of the log scores, chosen on development data  1
============== ===================================================== ==========================

    log b(x) = acoustic_scale * (y - log prior)

A segment's n-th window ends after its frame ``n H`` and begins ``W`` frames before, or with the
segment. Its scores of the frames that end ``R`` frames or more before it ends are settled, if no
window before has settled them: so a frame's score is settled ``R`` to ``R + H - 1`` frames after
it. Those of the frames after them, up to ``L`` frames before the window's end, are provisional. At
the end of a segment, a last window settles the frames that are left.

Products are of 8-bit integers; a product's inputs are rounded with one scale for the window. So
every window is computed alone, and a session's scores are the same to the last bit in any company
and any chunking. A session keeps the bands of its last window, 80 KB at most.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import cast

import numpy as np
from numpy.typing import NDArray

from services.recognizer.acoustic.acoustic_model import Topology, Work, no_scores
from services.recognizer.acoustic.model_file import (
    Archive,
    topology_arrays,
    topology_from,
    write_archive,
)
from services.recognizer.acoustic.network import Floats, open_session
from services.recognizer.front_end.features import HOP_S
from services.recognizer.front_end.whisper_mel import NUM_MELS, WhisperMel
from shared.errors import UserError
from shared.phones.inventory import PhoneInventory

FORMAT = "window 1"
FLOOR_BANDS = 2.0  # the lowest band lies at most so far below the window's highest: eight decades
MAX_WINDOW_FRAMES = 250

_INPUT, _OUTPUT = "frames", "log_posteriors"
_MAX_LOOK_AHEAD = 30  # frames
_RIGHT_CONTEXT = 15  # frames; a score changes little with more


@dataclass(frozen=True, kw_only=True)
class WindowModel:
    """A network with its front end; implements ``AcousticModel``."""

    topology: Topology
    network: NDArray[np.uint8]  # an ONNX file, see training.window.export
    log_prior: Floats  # (states,)
    acoustic_scale: float
    window_frames: int  # W
    hop_frames: int  # H
    look_ahead_frames: int = 0  # L

    @property
    def inventory(self) -> PhoneInventory:
        """The language's phones."""
        return self.topology.inventory

    @cached_property
    def session(self) -> WindowSession:
        """The network, ready to run."""
        return WindowSession(self.network)

    def front_end(self) -> WhisperMel:
        """Start a front end for one session."""
        return WhisperMel()

    def stream(self) -> WindowStream:
        """Start a stream of scores for one speaker."""
        return WindowStream(self)

    def score(self, work: Sequence[Work]) -> list[Floats]:
        """Score frames of several streams, one after the other; None ends a stream's segment."""
        return [cast(WindowStream, stream).score(frames) for stream, frames in work]

    def score_window(self, frames: Floats) -> Floats:
        """Score a window's frames, (n, 80) to (n, states)."""
        return np.float32(self.acoustic_scale) * (self.session.run(frames) - self.log_prior)

    def with_look_ahead(self, look_ahead_ms: float) -> WindowModel:
        """Return the model with another look-ahead.

        Raises
        ------
        UserError
            If it is no whole number of frames, or more than 300 ms.
        """
        num_frames = look_ahead_ms / (1000 * HOP_S)
        if num_frames not in range(_MAX_LOOK_AHEAD + 1):
            raise UserError(
                f"recognizer.look_ahead_ms is {look_ahead_ms:g}; give 0, 10, 20... up to "
                f"{1000 * HOP_S * _MAX_LOOK_AHEAD:g}"
            )
        model = replace(self, look_ahead_frames=int(num_frames))
        vars(model)["session"] = self.session  # opened once for all look-aheads
        return model

    def save(self, path: Path) -> None:
        """Write the model as an npz file (arrays only, no pickle)."""
        arrays = {
            "format": np.array(FORMAT),
            **topology_arrays(self.topology),
            "network": self.network,
            "log_prior": self.log_prior,
            "acoustic_scale": np.array(self.acoustic_scale, np.float32),
            "window_frames": np.array(self.window_frames),
            "hop_frames": np.array(self.hop_frames),
        }
        write_archive(path, arrays)


class WindowSession:
    """A network that is ready to run on windows, on one thread.

    Parameters
    ----------
    file
        An ONNX file's bytes.

    Raises
    ------
    ValueError
        If it is no network of this kind.
    """

    def __init__(self, file: NDArray[np.uint8]) -> None:
        self._session = open_session(file)
        inputs = [(node.name, node.shape[1:]) for node in self._session.get_inputs()]
        if inputs != [(_INPUT, [NUM_MELS])]:
            raise ValueError(f"its network has the inputs {inputs}")

    def run(self, frames: Floats) -> Floats:
        """Return the log posteriors of a window's frames, (n, 80) to (n, states).

        Raises
        ------
        ValueError
            If the network does not run.
        """
        try:
            rows: Floats = self._session.run([_OUTPUT], {_INPUT: frames})[0]
        except Exception as error:  # onnxruntime's errors have no base of their own
            raise ValueError(f"its network does not run ({error})") from error
        return rows[: len(frames)]  # a position has two frames


class WindowStream:
    """Scores of one speaker's speech, segment by segment."""

    def __init__(self, model: WindowModel) -> None:
        self._model = model
        self._right_context = max(_RIGHT_CONTEXT, model.look_ahead_frames)
        self.look_ahead_frames = self._right_context + model.hop_frames - 1
        self.reset()

    def accept(self, frames: Floats) -> Floats:
        """Take frames, shape (n, 80); return the scores settled, (m, states)."""
        return self._model.score([(self, frames)])[0]

    def finish(self) -> Floats:
        """End the segment; return its remaining scores."""
        return self._model.score([(self, None)])[0]

    def reset(self) -> None:
        """Forget the segment. Nothing is known of the speaker."""
        self.provisional = no_scores(self._model.topology.num_states)
        self._window = np.empty((0, NUM_MELS), np.float32)  # the last frames of the segment
        self._num_frames = 0  # of the segment
        self._num_settled = 0

    def score(self, frames: Floats | None) -> Floats:
        """Take frames, (n, 80), or the segment's end; return the scores settled, (m, states)."""
        settled = [no_scores(self._model.topology.num_states)]
        if frames is None:
            if self._num_settled < self._num_frames:
                settled.append(self._settle(self._num_frames))
            self.reset()
            return np.concatenate(settled)
        hop = self._model.hop_frames
        while len(frames):
            piece = frames[: hop - self._num_frames % hop]
            frames = frames[len(piece) :]
            self._window = np.concatenate([self._window, piece])[-self._model.window_frames :]
            self._num_frames += len(piece)
            if self._num_frames % hop == 0:
                settled.append(self._settle(self._num_frames - self._right_context))
        return np.concatenate(settled)

    def _settle(self, end: int) -> Floats:
        """Score the window that ends now; settle the frames before ``end``, in the segment."""
        scores = self._model.score_window(self._window)
        start = self._num_frames - len(self._window)
        first, self._num_settled = self._num_settled, max(end, 0)
        newest = self._num_frames - self._model.look_ahead_frames
        self.provisional = scores[self._num_settled - start : max(newest - start, 0)]
        return scores[first - start : self._num_settled - start]


def window_from(archive: Archive) -> WindowModel:
    """Build the model after checking every size; ValueError says what does not fit."""
    topology = topology_from(archive)
    window_frames, hop_frames = (
        int(archive.array(name, ())) for name in ("window_frames", "hop_frames")
    )
    if not (hop_frames >= 1 and hop_frames + _MAX_LOOK_AHEAD <= window_frames <= MAX_WINDOW_FRAMES):
        raise ValueError(f"its windows have {window_frames} frames, every {hop_frames}")
    model = WindowModel(
        topology=topology,
        network=archive.array("network", None).astype(np.uint8),
        log_prior=archive.floats("log_prior", topology.num_states),
        acoustic_scale=float(archive.floats("acoustic_scale")),
        window_frames=window_frames,
        hop_frames=hop_frames,
    )
    scores = model.session.run(np.zeros((window_frames, NUM_MELS), np.float32))
    if scores.shape != (window_frames, topology.num_states):
        raise ValueError(f"its network scores {scores.shape}")
    if not np.isfinite(scores).all():
        raise ValueError("its network scores with values that are not finite")
    return model
