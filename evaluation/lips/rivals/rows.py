"""What other lip sync makes of a sound: a row of outputs every 10 ms.

Row k is what a program knows once it has had the sound up to k times 10 ms. HeadAudio and wLipSync
are audio worklets; they run in Node as in a browser's audio thread, at 48 kHz in blocks of 128
samples, with their default settings. (Changing the rate from 16 to 48 kHz looks 0.6 ms ahead, in
their favour; that a browser hands their messages over later is left out, too.) After a clip there
is silence.

wLipSync needs a profile of phonemes, which its users make from their own voice. Here it is made
from the clips that the lips are learnt from: the mean cepstrum, as wLipSync computes it, of each
mouth shape's phones, silence among them. So it knows as many voices as the lips do.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections import defaultdict
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import resample_poly

from kouxing.corpora.lip_clips import SAMPLE_RATE_HZ, LipClip, label_clip
from kouxing.services.recognizer.acoustic.acoustic_model import AcousticModel
from kouxing.shared.errors import UserError, install_command
from kouxing.shared.face.shapes import OCULUS

Array = NDArray[np.float64]
Rows = Callable[[LipClip], Array]

FOLDER = Path(__file__).parent
ROW_S = 0.01
_NODE_RATE_HZ = 48_000
# The order of HeadAudio's outputs, in the names that `kouxing.shared.face.shapes` has for them.
HEAD_AUDIO_VISEMES = "aa E ih oh ou PP SS TH DD FF kk nn RR CH sil".split()
_SILENCE_AFTER_S = 0.5
_NUM_CEPSTRA = 12
_WINDOW = 1024  # samples at 16 kHz
_PROFILE = {
    "targetSampleRate": SAMPLE_RATE_HZ,
    "sampleCount": _WINDOW,
    "melFilterBankChannels": 30,
    "compareMethod": 1,  # Euclidean
    "mfccNum": _NUM_CEPSTRA,
    "mfccDataCount": 1,
    "useStandardization": False,
    "means": [0.0] * _NUM_CEPSTRA,
    "stdDevs": [1.0] * _NUM_CEPSTRA,
}
_LOUDNESS_RANGE_DB = 40.0


def package_rows(package: str, samples: NDArray[np.float32], profile: Any = None) -> Array:
    """Run ``headaudio`` or ``wlipsync`` over a sound.

    Parameters
    ----------
    package
        Name of its file in this folder, without the suffix.
    samples
        16 kHz mono.
    profile
        wLipSync's.

    Returns
    -------
    Array
        Shape (num_rows, num_outputs).

    Raises
    ------
    UserError
        Node or the package is missing, or fails.
    """
    folders = f"{Path(sys.executable).parent}{os.pathsep}{os.environ.get('PATH', '')}"
    node = shutil.which("node", path=folders)
    if node is None:
        raise UserError(f"other lip sync needs Node: {install_command('kouxing[page]')}")
    if not (FOLDER / "node_modules").is_dir():
        raise UserError(f"the packages to compare with are missing; run 'npm ci' in {FOLDER}")
    sound = np.append(samples, np.zeros(round(_SILENCE_AFTER_S * SAMPLE_RATE_HZ)))
    sound = resample_poly(sound, _NODE_RATE_HZ // SAMPLE_RATE_HZ, 1)
    done = subprocess.run(  # noqa: S603
        [node, "outputs.js", package, json.dumps(profile)],
        cwd=FOLDER,
        input=sound.astype("<f4").tobytes(),
        capture_output=True,
        check=False,
    )
    if done.returncode:
        raise UserError(f"{package} failed in Node: {done.stderr.decode(errors='replace')[-500:]}")
    num_rows = len(sound) // round(ROW_S * _NODE_RATE_HZ) + 1
    return np.frombuffer(done.stdout, "<f4").reshape(num_rows, -1).astype(float)


def head_audio_rows(clip: LipClip) -> Array:
    """Weights of ``HEAD_AUDIO_VISEMES``, then which one is found, shape (num_rows, 30)."""
    return package_rows("headaudio", clip.samples)


def oculus_order(weights: Array) -> Array:
    """Bring HeadAudio's weights, (num_rows, 15), into the order of ``OCULUS.names``."""
    return weights[:, [HEAD_AUDIO_VISEMES.index(name) for name in OCULUS.names]]


def wlipsync_rows(profile: dict[str, Any]) -> Rows:
    """Return what wLipSync makes of a clip with a profile.

    Volume, weights and which phoneme is found, the last two also times the volume: its users
    multiply them.
    """
    num_phonemes = len(profile["mfccs"])

    def rows(clip: LipClip) -> Array:
        made = package_rows("wlipsync", clip.samples, profile)[:, : 1 + 2 * num_phonemes]
        return np.hstack([made, made[:, :1] * made[:, 1:]])

    return rows


def wlipsync_profile(model: AcousticModel, clips: Sequence[LipClip]) -> dict[str, Any]:
    """Make a profile with a phoneme for each mouth shape, from the middles of phones."""
    # Any profile will do to measure cepstra; wLipSync computes as many as there are phonemes.
    blank = _profile({str(k): np.zeros(_NUM_CEPSTRA) for k in range(_NUM_CEPSTRA)})
    windows: dict[str, list[Array]] = defaultdict(list)
    visemes = model.inventory.visemes
    for clip in clips:
        cepstra = package_rows("wlipsync", clip.samples, blank)[:, -_NUM_CEPSTRA:]
        time_s = np.arange(len(cepstra)) * ROW_S - _WINDOW / SAMPLE_RATE_HZ / 2.0
        for phone in label_clip(model, clip):
            (viseme, share), *_ = visemes[phone.symbol]
            if share == 1.0:
                middle_s = phone.onset_s + phone.duration_s / 2.0
                is_inside = np.abs(time_s - middle_s) <= phone.duration_s / 4.0
                windows[viseme].append(cepstra[is_inside])
    joined = {name: np.concatenate(each) for name, each in sorted(windows.items())}
    return _profile({name: each.mean(axis=0) for name, each in joined.items() if len(each)})


def _profile(cepstra: dict[str, Array]) -> dict[str, Any]:
    phonemes = [{"name": name, "values": values.tolist()} for name, values in cepstra.items()]
    return {**_PROFILE, "mfccs": phonemes}


def loudness_rows(clip: LipClip) -> Array:
    """Level of the newest 20 ms, 0 to 1 over 40 dB, shape (num_rows, 1).

    How loud the loudest frames of the recording are is known from the start, which flatters it.
    """
    hop = round(ROW_S * SAMPLE_RATE_HZ)
    sound = np.append(clip.samples, np.zeros(round(_SILENCE_AFTER_S * SAMPLE_RATE_HZ)))
    energy = np.append(0.0, np.cumsum(np.square(sound, dtype=float)))
    ends = np.arange(0, len(sound) + 1, hop)
    level_db = 10.0 * np.log10(
        (energy[ends] - energy[np.maximum(ends - 2 * hop, 0)]) / (2 * hop) + 1e-10
    )
    loudest_db = np.percentile(level_db[: len(clip.samples) // hop + 1], 95)
    level: Array = np.clip((level_db - loudest_db) / _LOUDNESS_RANGE_DB + 1.0, 0.0, 1.0)
    return level[:, None]
