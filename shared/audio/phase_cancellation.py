"""Mixes any number of audio channels to one or two, without losing a voice."""

import numpy as np

from kouxing.shared.arrays import Doubles, Floats

Samples = Floats  # (n, channels), in [-1, 1]

_LOST_FRACTION = 0.01  # of the loudest channel's energy; a mix with less has lost the channel
_LOST_FRACTION_OF_AVERAGE = 0.1  # the average of nine channels has 1/81 of one voice
_SILENT_POWER = 1e-6  # -60 dBFS; a channel below it is silent


class PhaseCancellationGuard:
    """Replaces the mix with the loudest channel while this channel is too weak in the mix.

    A channel is too weak if a microphone cable inverts one of two channels, if the mix of a film
    omits it, or if only one of nine channels contains a voice. Other mixes are returned unchanged.
    ``name`` is the name of the audio in the warning that is added to ``warnings``.
    """

    def __init__(self, name: str, num_channels: int, warnings: list[str]) -> None:
        self._name = name
        self._num_channels = num_channels
        self._warnings = warnings
        self._energy: Doubles = np.zeros(1)  # energy of every channel so far
        self._mixed_energy = 0.0
        self._has_warned = False

    def mix(self, channels: Samples, mixed: Samples) -> Samples:
        """Return ``mixed`` or the loudest of ``channels``, with ``num_channels`` columns."""
        lost_fraction = _LOST_FRACTION
        if mixed.shape[1] != self._num_channels:  # not mixed yet, or the format changed
            lost_fraction = _LOST_FRACTION_OF_AVERAGE
            mixed = mixed.mean(axis=1, keepdims=True).repeat(self._num_channels, axis=1)
        if channels.shape[1] == 1 or len(channels) == 0:
            return mixed
        energy = np.square(channels, dtype=np.float64).sum(axis=0)
        mixed_energy = float(np.square(mixed.mean(axis=1), dtype=np.float64).sum())
        if len(energy) != len(self._energy):
            self._energy, self._mixed_energy = np.zeros(len(energy)), 0.0
        self._energy += energy
        self._mixed_energy += mixed_energy
        loudest = int(energy.argmax())
        is_lost = (
            energy[loudest] > _SILENT_POWER * len(channels)
            and mixed_energy < lost_fraction * energy[loudest]
            and self._mixed_energy < lost_fraction * self._energy.max()
        )
        if not is_lost:
            return mixed
        if not self._has_warned:
            self._has_warned = True
            self._warnings.append(
                f"{self._name}: mixing the channels would cancel one of them;"
                f" only channel {loudest + 1} is used"
            )
        return channels[:, [loudest] * self._num_channels]
