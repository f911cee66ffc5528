"""From clips of tracked lips to the lip model.

    clips -> [audio encoder] -> principal components -> recurrent network with each speaker's units
                         -> features             -> linear regressions
                         -> the encoder's own lips   -> weighted mean of the three

The recipe trains on every clip that is not held out and whose license allows it. These clips do not
determine any setting. Each clip is used twice, unchanged and augmented. Clips of small sources
are repeated.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from kouxing.corpora.lip_clips import (
    LipClip,
    label_clips,
    no_clip_error,
    read_clips,
    training_clips,
)
from kouxing.services.recognizer.acoustic.acoustic_model import AcousticModel
from kouxing.services.recognizer.acoustic.encoder import LIP_DELAYS_S
from kouxing.services.recognizer.acoustic.load import load_model
from kouxing.services.recognizer.lips.lip_predictor import (
    CLOSURE,
    LIP_FAPS,
    NUM_LIP_FAPS,
    NUM_OUTPUTS,
    GruLipPredictor,
)
from kouxing.shared.arrays import Doubles, Floats
from kouxing.shared.errors import UserError
from kouxing.training.lips.linear import fit_linear
from kouxing.training.lips.positions import SpeechStretch, components_of, features_of, speech_of
from kouxing.training.lips.recurrent import LipNetwork, SpeechExample, train_network
from kouxing.training.lips.targets import closed_below, targets_at
from kouxing.training.model_card import write_card
from kouxing.training.model_files import save_lip_predictor
from kouxing.training.seed import SEED

# For faces with delays of 0, 20, 50, 60, 100 or 160 ms: the audio of a position ends 5 ms before
# a frame of the face is due.
DELAYS_S = (-0.005, 0.015, 0.045, 0.055, 0.095, 0.155)
NUM_EPOCHS = 12
# Number of log-mel values, and of each kind of the encoder's features (early and late components of
# Whisper's encoder, lips); number of their components; extent of the first component and the last
# one. Late components mostly describe the speaker, so they get less weight.
COMPONENTS = ((160, 32, 0.5, 0.5), (128, 96, 1.0, 0.2), (128, 96, 1.0, 0.2), (51, 51, 2.0, 0.5))
# Weights of the FAPs of the audio encoder, linear regression and recurrent network. Chosen on four
# speakers without clips in training.
_ENCODER_WEIGHT, _LINEAR_WEIGHT, _NETWORK_WEIGHT = 0.5, 0.3, 0.2
_LINEAR_CLOSURE = 0.85  # fraction of a closure's log odds; the rest is the network's
_MAX_REPEATS = 6  # limit for the clips of a small source
_MIN_VARIANCE = 1e-8
_CLOSURE_BIAS = (0.055, 0.155), (0.1, 0.7)  # by delay, added to the log odds of a closure
# Predictions vary less than real lips, most of all in width. These factors correct about half of
# that, at no cost in correlation.
_EXTENT_FACTOR, _WIDTH_FACTOR = 1.2, 1.5
_WIDTH_FAPS = (6, 53)


@dataclass(frozen=True, slots=True)
class FapScale:
    """Mean and extent of each FAP over all training speech, FAP units."""

    mean: Floats  # (15,)
    extent: Floats  # (15,)


@dataclass(frozen=True, slots=True)
class Basis:
    """Principal components of the inputs, and units of the outputs."""

    mean: Floats  # (features,)
    projection: Floats  # (features, components)
    units: FapScale


def train_lips(folder: Path, output: Path, *, any_license: bool) -> None:
    """Train the lip model, and write it with its card.

    The arguments are the options of ``kouxing train lips``. Raises ``UserError`` if no clip may be
    used, or a file cannot be read.
    """
    clips = read_clips(folder, any_license=any_license, language=None)
    used = training_clips(clips, any_license=any_license)
    if not used:
        raise no_clip_error(folder)
    unchanged = list(speech_of(used))
    if not unchanged:
        raise UserError(f"the clips in {folder} contain no speech")
    filmed = [*unchanged, *speech_of(used, copy=1)]
    targets = _targets(load_model(), filmed, closed_below(clips))
    basis = Basis(*principal_components(features_of(unchanged)), measure_scale(targets))
    repeats = repeats_by_source(used)
    counts = [repeats[stretch.clip.source] for stretch in filmed]
    examples = [
        example
        for count, example in zip(counts, examples_of(filmed, targets, basis), strict=True)
        for _ in range(count)
    ]
    network, losses = train_network(examples, num_epochs=NUM_EPOCHS, seed=SEED)
    lips = combine_parts(basis, network, *fit_linear(filmed, targets, counts))
    save_lip_predictor(output, lips)
    write_card(
        output,
        title="Lip model",
        details=f"seed {SEED}; mean training loss of each epoch: "
        + ", ".join(f"{loss:.3f}" for loss in losses),
        recordings=used,
        notes=Path(__file__).with_name("about.md").read_text(encoding="utf-8").rstrip(),
    )


def _targets(
    model: AcousticModel, speech: Sequence[SpeechStretch], closed_at: dict[str, float]
) -> list[Floats]:
    """Compute the targets of every stretch, FAP units, (positions, delays, 17)."""
    phones = label_clips(model, {stretch.clip.name: stretch.clip for stretch in speech}.values())
    return [
        targets_at(
            stretch.clip,
            phones.get(stretch.clip.name),
            closed_at[stretch.clip.speaker],
            stretch.known_s * stretch.speed,
            [delay_s * stretch.speed for delay_s in DELAYS_S],
        )
        for stretch in speech
    ]


def examples_of(
    speech: Sequence[SpeechStretch], targets: Sequence[Floats], basis: Basis
) -> list[SpeechExample]:
    """Make examples from stretches and their targets in FAP units, (positions, delays, 17)."""
    speakers = sorted({stretch.clip.speaker for stretch in speech})
    return [
        SpeechExample(
            components_of(stretch, basis.mean, basis.projection),
            standardize(target, basis.units),
            speakers.index(stretch.clip.speaker),
        )
        for stretch, target in zip(speech, targets, strict=True)
    ]


def repeats_by_source(clips: Sequence[LipClip]) -> dict[str, int]:
    """Return how often to use the clips of each source, so that none outweighs the others."""
    num_clips = Counter(clip.source for clip in clips)
    max_clips = max(num_clips.values())
    return {source: min(_MAX_REPEATS, max_clips // number) for source, number in num_clips.items()}


def principal_components(features: Floats) -> tuple[Floats, Floats]:
    """Return the mean of features, (n, features), and the projection to their components.

    The log-mel frames and each kind of the encoder's features have separate components.
    """
    mean = features.mean(axis=0)
    ends = np.cumsum([num_features for num_features, *_ in COMPONENTS])
    parts = np.split(np.arange(len(mean)), ends[:-1])
    projection = np.zeros((len(mean), sum(number for _, number, *_ in COMPONENTS)), np.float32)
    first = 0
    for part, (_, number, first_extent, last_extent) in zip(parts, COMPONENTS, strict=True):
        centered = features[:, part] - mean[part]
        covariance = (centered.T @ centered).astype(np.float64) / len(centered)
        variances, directions = np.linalg.eigh(covariance)
        num_kept = min(number, len(part))
        extents = np.linspace(first_extent, last_extent, num_kept)
        scale = extents / np.sqrt(np.maximum(variances[::-1][:num_kept], _MIN_VARIANCE))
        projection[part, first : first + num_kept] = directions[:, ::-1][:, :num_kept] * scale
        first += number
    return mean, projection


def measure_scale(targets: Sequence[Floats]) -> FapScale:
    """Measure the FAPs; one that no clip tracks gets the extent 0, so it stays at 0."""
    faps = np.concatenate(
        [target[..., :NUM_LIP_FAPS].reshape(-1, NUM_LIP_FAPS) for target in targets]
    )
    known = ~np.isnan(faps)
    count = np.maximum(known.sum(axis=0), 1)
    mean = np.where(known, faps, 0).sum(axis=0) / count
    extent = np.sqrt((np.where(known, faps - mean, 0) ** 2).sum(axis=0) / count)
    return FapScale(mean.astype(np.float32), extent.astype(np.float32))


def standardize(target: Floats, units: FapScale) -> Floats:
    """Express the FAPs of targets in units of their extent."""
    scale = np.where(units.extent > 0, units.extent, 1)
    faps = (target[..., :NUM_LIP_FAPS] - units.mean) / scale
    return np.concatenate([faps, target[..., NUM_LIP_FAPS:]], axis=-1).astype(np.float32)


def combine_parts(
    basis: Basis, network: LipNetwork, linear_weights: Doubles, linear_bias: Doubles
) -> GruLipPredictor:
    """Combine the network with the linear part (see ``fit_linear``) and the encoder's lips.

    Lip-to-teeth contact comes from the network. The FAPs are scaled around their means.
    """
    weights = {name: value.numpy() for name, value in network.state_dict().items()}
    units, shape = basis.units, (len(DELAYS_S), NUM_OUTPUTS)
    scale = np.ones(NUM_OUTPUTS)
    scale[:NUM_LIP_FAPS] = units.extent * _EXTENT_FACTOR
    width = [LIP_FAPS.index(fap) for fap in _WIDTH_FAPS]
    scale[width] = units.extent[width] * _WIDTH_FACTOR
    network_scale, linear_scale = scale.copy(), scale.copy()
    network_scale[:NUM_LIP_FAPS] *= _NETWORK_WEIGHT
    network_scale[CLOSURE] = 1 - _LINEAR_CLOSURE
    linear_scale[:NUM_LIP_FAPS] *= _LINEAR_WEIGHT
    linear_scale[CLOSURE] = _LINEAR_CLOSURE
    encoder_weights = np.zeros((len(LIP_DELAYS_S), NUM_OUTPUTS, *shape))
    for fap in range(NUM_LIP_FAPS):
        for number, delay_weights in enumerate(np.eye(len(LIP_DELAYS_S))):
            encoder_weights[number, fap, :, fap] = np.interp(DELAYS_S, LIP_DELAYS_S, delay_weights)
    linear = linear_weights * linear_scale
    num_rows = encoder_weights[..., 0, 0].size
    linear[-num_rows:] += _ENCODER_WEIGHT * scale * encoder_weights.reshape(-1, *shape)
    bias = weights["output.bias"].reshape(shape) * network_scale + linear_bias * linear_scale
    bias[:, :NUM_LIP_FAPS] += units.mean
    bias[:, CLOSURE] += np.interp(DELAYS_S, *_CLOSURE_BIAS)
    output = weights["output.weight"].T.reshape(-1, *shape) * network_scale
    return GruLipPredictor(
        delays=np.array(DELAYS_S, np.float32),
        feature_mean=basis.mean,
        projection=basis.projection,
        entry_weights=np.ascontiguousarray(weights["entry.weight"].T),
        entry_bias=weights["entry.bias"],
        input_weights=np.ascontiguousarray(weights["recurrent.weight_ih_l0"].T),
        input_bias=weights["recurrent.bias_ih_l0"],
        state_weights=np.ascontiguousarray(weights["recurrent.weight_hh_l0"].T),
        state_bias=weights["recurrent.bias_hh_l0"],
        lip_weights=linear.astype(np.float32),
        output_weights=output.astype(np.float32),
        output_bias=bias.astype(np.float32),
    )
