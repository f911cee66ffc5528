"""Disturbances of speech on its way to a microphone.

All random numbers have fixed seeds, so that figures can be reproduced.

====================  ==========================================================================
noise 10 dB           pink noise, 10 dB below the speech level
music 10 dB           held-out music of a folder of sounds, or synthesized music, at this level
babble 10 dB          six parts of the recordings at once, at this level
room                  echoes that fall by 60 dB in 0.5 s (noise with an exponential envelope, Polack
                      1988), together as loud as the direct sound
telephone             300 to 3400 Hz, Butterworth of order 8
speed                 overlap-add of the most similar 20 ms segments at constant pitch (WSOLA,
                      Verhelst and Roelands 1993)
====================  ==========================================================================
"""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.signal import butter, fftconvolve, sosfilt

from kouxing.corpora.sounds import Sound, held_out
from kouxing.evaluation.recognizer import synthetic_sounds
from kouxing.evaluation.recognizer.aligned_corpus import AlignedRecording
from kouxing.evaluation.recognizer.synthetic_sounds import Samples, as_samples, pink_noise
from kouxing.services.recognizer.front_end.features import SAMPLE_RATE_HZ
from kouxing.shared.audio.pcm import as_floats
from kouxing.shared.errors import UserError

Disturb = Callable[[Samples], Samples]
CONDITIONS = ("clean", "noise 10 dB", "music 10 dB", "babble 10 dB", "room", "telephone")
CLEAN, NOISE, MUSIC, BABBLE, ROOM, TELEPHONE = CONDITIONS
_REVERBERATION_S = 0.5  # time in which echoes fall by 60 dB
_NUM_VOICES, _MAX_BABBLE_RECORDINGS = 6, 60
_SNR_DB = 10.0
_MUSIC_S = 60.0
_EPSILON = 1e-9


def disturbances_for(
    references: Sequence[AlignedRecording], music: Samples, names: Sequence[str]
) -> dict[str, Disturb]:
    """Return clean speech and the disturbances with the given names; if there are no names, all.

    The babble is mixed from ``references``.
    """
    step = len(references) // _MAX_BABBLE_RECORDINGS + 1
    crowd_babble = babble([reference.read_audio() for reference in references[::step]])
    known: dict[str, Disturb] = {
        CLEAN: lambda samples: samples,
        NOISE: lambda samples: add_noise(samples, _SNR_DB),
        MUSIC: lambda samples: add_sound(samples, music, _SNR_DB),
        BABBLE: lambda samples: add_sound(samples, crowd_babble, _SNR_DB),
        ROOM: add_echoes,
        TELEPHONE: limit_to_telephone_band,
    }
    return {name: known[name] for name in CONDITIONS if name in (CLEAN, *(names or CONDITIONS))}


def check_conditions(names: Sequence[str], known: Sequence[str] = CONDITIONS) -> None:
    """Raise UserError if a name is not one of ``known``."""
    if unknown := [name for name in names if name not in known]:
        raise UserError(f"unknown condition {unknown[0]!r}; choose from: {', '.join(known)}")


def held_out_music(sounds: Sequence[Sound]) -> Samples:
    """Return the held-out music, or synthesized music if ``sounds`` is empty.

    Raises ``UserError`` if the sounds contain no held-out music.
    """
    if not sounds:
        return synthetic_sounds.music(_MUSIC_S)
    pieces = [as_floats(sound.samples) for sound in held_out(sounds, "music")]
    if not pieces:
        raise UserError("the sounds contain no held-out music; add more music to --sounds")
    return np.concatenate([_to_equal_level(piece) for piece in pieces])


def add_noise(samples: Samples, snr_db: float) -> Samples:
    """Add pink noise at a signal-to-noise ratio of ``snr_db``."""
    noise = pink_noise(len(samples), np.random.default_rng(len(samples)))
    return _mix(samples, noise, snr_db)


def babble(voices: Sequence[Samples]) -> Samples:
    """Mix six parts of the recordings. Each recording has the same level."""
    speech = np.concatenate([_to_equal_level(voice) for voice in voices])
    starts = np.arange(_NUM_VOICES) * len(speech) // _NUM_VOICES
    together: Samples = np.sum([np.roll(speech, start) for start in starts], axis=0)
    return together


def add_sound(samples: Samples, sound: Samples, snr_db: float) -> Samples:
    """Add a part of a sound, repeated if necessary, at a signal-to-noise ratio of ``snr_db``."""
    start = np.random.default_rng(len(samples)).integers(len(sound))
    return _mix(samples, np.resize(np.roll(sound, -start), len(samples)), snr_db)


def add_echoes(samples: Samples) -> Samples:
    """Add echoes that are together as loud as the direct sound."""
    num_samples = round(_REVERBERATION_S * SAMPLE_RATE_HZ)
    decay = 10 ** (-3 * np.arange(num_samples) / num_samples)  # by 60 dB
    echoes = np.random.default_rng(5).normal(size=num_samples) * decay
    reverberated = fftconvolve(samples, echoes / np.sqrt(np.sum(echoes**2)))[: len(samples)]
    return as_samples((samples + reverberated) / np.sqrt(2))


def limit_to_telephone_band(samples: Samples) -> Samples:
    """Keep only 300 to 3400 Hz."""
    band = butter(8, [300, 3400], "bandpass", fs=SAMPLE_RATE_HZ, output="sos")
    return as_samples(sosfilt(band, samples))


def change_speed(samples: Samples, factor: float) -> Samples:
    """Change the speed of speech at constant pitch.

    FFmpeg's filter atempo is not used: it is 20 ms early, and returns nothing for short recordings.
    """
    hop, search = 160, 120  # 10 and 7.5 ms; segments are two hops long
    window = np.hanning(2 * hop + 1)[: 2 * hop]
    # the middle of segment n is at n hops in the result, and near n hops * factor in the samples
    padded = np.pad(samples.astype(np.float64), (hop + search, 3 * hop + 2 * search))
    num_segments = int(len(samples) / (hop * factor))
    out = np.zeros((num_segments + 1) * hop)
    source = 0  # start of the last segment
    for number in range(num_segments):
        position = round(number * hop * factor)
        if number == 0:
            position = search
        else:
            continuation = padded[source + hop : source + 3 * hop]  # the natural continuation
            near = padded[position : position + 2 * search + 2 * hop]
            energy = np.convolve(near**2, np.ones(2 * hop), "valid")
            similarity = np.correlate(near, continuation, "valid") / np.sqrt(energy + 1e-9)
            position += int(similarity.argmax())
        source = position
        out[number * hop : (number + 2) * hop] += window * padded[position : position + 2 * hop]
    return as_samples(out[hop:])


def _mix(samples: Samples, sound: NDArray[np.floating], snr_db: float) -> Samples:
    energy = float(np.sum(samples.astype(np.float64) ** 2))
    power = energy / max(1, int(np.count_nonzero(samples)))  # padding does not count
    gain = np.sqrt(power / max(_EPSILON, float(np.mean(sound**2))))
    return as_samples(samples + gain * 10 ** (-snr_db / 20) * sound)


def _to_equal_level(samples: Samples) -> Samples:
    return samples / max(_EPSILON, float(np.sqrt(np.mean(samples**2))))
