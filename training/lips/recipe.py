"""From clips of tracked lips to the lip model.

    clips -> [voice activity detection, acoustic network] -> principal components
          -> recurrent network with each speaker's units
          -> ridge regression in canonical units -> mean of the two

The recipe trains on every clip that is not held out and whose license allows it. These clips do not
determine any setting. Each clip is used once as it is, and once augmented. A teacher may label
further speech without video (:mod:`kouxing.training.lips.teacher`).

Source: Hoerl and Kennard 1970, "Ridge regression: biased estimation for nonorthogonal problems".
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.progress import track

from kouxing.corpora.lip_clips import label_clip, read_clips
from kouxing.corpora.speech_corpus import may_ship
from kouxing.services.mouth_profiles.positions import POSITION_S
from kouxing.services.recognizer.acoustic.load import load_model
from kouxing.services.recognizer.acoustic.network import FRAMES_PER_POSITION
from kouxing.services.recognizer.acoustic.neural import NeuralModel
from kouxing.services.recognizer.front_end.whisper_mel import NUM_MELS
from kouxing.services.recognizer.lip_predictor import (
    CLOSURE,
    LIP_FAPS,
    NUM_LAYERS,
    NUM_OUTPUTS,
    LipPredictor,
)
from kouxing.shared.errors import UserError
from kouxing.training.lips.positions import Speech, components_of, features_of, speech_of
from kouxing.training.lips.recurrent import Example, LipNetwork, train_network
from kouxing.training.lips.targets import closed_below, targets_at
from kouxing.training.lips.teacher import (
    draw_recordings,
    label_recordings,
    load_encoder,
    train_teacher,
)
from kouxing.training.model_card import write_card

Floats = NDArray[np.float32]
Array = NDArray[np.float64]

HISTORY = 8  # positions: 160 ms
RIDGE = 0.5  # weight of zero, fraction of the positions
_TINY = 1e-9


def history_of(components: NDArray[np.floating]) -> Floats:
    """Return the last components of each position, oldest first, and a 1.

    The shape changes from (positions, components) to (positions, HISTORY * components + 1).
    """
    num_positions = len(components)
    padded = np.pad(components.astype(np.float32, copy=False), ((HISTORY - 1, 0), (0, 0)))
    shifted = [padded[delay : delay + num_positions] for delay in range(HISTORY)]
    return np.concatenate([*shifted, np.ones((num_positions, 1), np.float32)], axis=1)


def fit_ridge(histories: Sequence[Floats], targets: Sequence[Floats]) -> Array:
    """Fit targets, (positions, delays, outputs), to histories, (positions, n), of stretches.

    Targets may be NaN. A position counts for an output if its targets are known for all delays.
    Returns the weights, (n, delays, outputs).
    """
    history, target = np.concatenate(list(histories)), np.concatenate(list(targets))
    known = ~np.isnan(target).any(axis=1)  # (positions, outputs)
    weights = np.zeros((history.shape[1], *target.shape[1:]))
    by_rows: dict[bytes, list[int]] = {}  # outputs that are known at the same positions
    for output in range(known.shape[1]):
        by_rows.setdefault(known[:, output].tobytes(), []).append(output)
    for outputs in by_rows.values():
        rows = known[:, outputs[0]]
        if rows.any():
            columns = target[rows][:, :, outputs].reshape(rows.sum(), -1)
            solved = _solve(history[rows], columns)
            weights[:, :, outputs] = solved.reshape(len(weights), -1, len(outputs))
    return weights


def _solve(histories: Floats, targets: Floats) -> Array:
    """Solve one ridge regression; the weight of the constant, the last column, is free."""
    ridge = np.full(histories.shape[1], RIDGE * len(histories))
    ridge[-1] = _TINY
    products = (histories.T @ histories).astype(np.float64)
    with_targets = (histories.T @ targets).astype(np.float64)
    return np.linalg.solve(products + np.diag(ridge), with_targets).astype(np.float64)


# For faces with delays of 0, 20, 50, 60, 100 or 160 ms: the audio of a position ends 5 ms before
# a frame of the face is due.
DELAYS_S = (-0.005, 0.015, 0.045, 0.055, 0.095, 0.155)
NUM_EPOCHS = 12
# Number of components of the log-mel frames and of each layer, and the extent of the first and the
# last one. Late components mostly describe the speaker, so they get less weight.
COMPONENTS = ((32, 0.5, 0.5), *[(96, 1.0, 0.2)] * NUM_LAYERS)
_NUM_MEL_FEATURES = FRAMES_PER_POSITION * NUM_MELS
_NUM_FAPS = len(LIP_FAPS)
_MIN_VARIANCE = 1e-8
_MISSED_CLOSURE = 2.0  # cost of a missed closure, false closures
# On unseen speakers the predicted width has 0.6 of the extent of real lips. This factor corrects
# half of it, and rounds the lips at u and ü, at no cost in the median error.
_WIDTH_FACTOR = 1.3
_WIDTH_FAPS = (6, 53)


@dataclass(frozen=True, slots=True)
class Units:
    """Mean and extent of each FAP over all training speech, FAP units."""

    mean: Floats  # (15,)
    extent: Floats  # (15,)


@dataclass(frozen=True, slots=True)
class Basis:
    """Principal components of the inputs, and units of the outputs."""

    mean: Floats  # (features,)
    projection: Floats  # (features, components)
    units: Units


def train_lips(
    folder: Path,
    output: Path,
    *,
    speech: Sequence[Path] = (),
    whisper: Path | None = None,
    seed: int = 0,
    any_license: bool = False,
) -> None:
    """Train the lip model, and write it with its card.

    The arguments are the options of ``kouxing train lips``. Raises UserError if no clip may be
    used, there is no teacher for ``speech``, the shipped acoustic model is not neural, or a file
    cannot be read.
    """
    if speech and whisper is None:
        raise UserError("speech without video needs a teacher; also give --whisper")
    model = load_model()
    if not isinstance(model, NeuralModel):
        raise UserError("the lip model needs the neural acoustic model; reinstall it")
    clips = read_clips(folder, any_license=any_license, language=None)
    used = [
        clip for clip in clips if clip.part != "held" and (any_license or may_ship(clip.license))
    ]
    if not used:
        raise UserError(
            f"no clip in {folder} may be used; give clips with a free license, or --any-license"
        )
    recordings = draw_recordings(speech, seed)
    plain = track(speech_of(model, used), description="clips", total=len(used))
    trained_on = [stretch for stretches in plain for stretch in stretches]
    if not trained_on:
        raise UserError(f"the clips in {folder} contain no speech; give clips with speech")
    augmented = speech_of(model, used, copy=1)
    copies = [
        stretch
        for stretches in track(augmented, description="augmented copies", total=len(used))
        for stretch in stretches
    ]
    filmed = [*trained_on, *copies]
    targets = _targets(model, filmed, closed_below(clips))
    basis = basis_of(trained_on, targets)
    examples = examples_of(filmed, targets, basis)
    labeled = []
    if whisper and recordings:
        teacher = train_teacher(
            load_encoder(whisper), filmed, examples, DELAYS_S, num_epochs=NUM_EPOCHS, seed=seed
        )
        labeled = label_recordings(
            teacher,
            model,
            recordings,
            lambda stretch: components_of(stretch, basis.mean, basis.projection),
            DELAYS_S,
            speaker=1 + max(example.speaker for example in examples),
        )
    lips, losses = fit(examples, labeled, basis, seed)
    lips.save(output)
    hours = POSITION_S * _num_positions(labeled) / 3600
    write_card(
        output,
        title="Lip model",
        details=f"seed {seed}; the teacher labeled {hours:.1f} hours of speech; mean training loss "
        f"of each epoch: {', '.join(f'{loss:.3f}' for loss in losses)}",
        recordings=used,
        notes=Path(__file__).with_name("about.md").read_text(encoding="utf-8").rstrip(),
    )


def _targets(
    model: NeuralModel, speech: Sequence[Speech], closed_at: dict[str, float]
) -> list[Floats]:
    """Compute the targets of every stretch, FAP units, (positions, delays, 17)."""
    code = model.inventory.code
    clips = {one.clip.name: one.clip for one in speech if one.clip.language == code}
    phones = {
        name: label_clip(model, clip) for name, clip in track(clips.items(), description="phones")
    }
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


def basis_of(unchanged: Sequence[Speech], targets: Sequence[Floats]) -> Basis:
    """Compute the components of speech without augmentation, and the units of targets."""
    return Basis(*principal_components(features_of(unchanged)), units_of(targets))


def examples_of(speech: Sequence[Speech], targets: Sequence[Floats], basis: Basis) -> list[Example]:
    """Make examples from stretches and their targets in FAP units, (positions, delays, 17)."""
    speakers = sorted({stretch.clip.speaker for stretch in speech})
    return [
        Example(
            components_of(stretch, basis.mean, basis.projection),
            standardize(target, basis.units),
            speakers.index(stretch.clip.speaker),
        )
        for stretch, target in zip(speech, targets, strict=True)
    ]


def fit(
    examples: Sequence[Example],
    labeled: Sequence[Example],
    basis: Basis,
    seed: int,
    num_epochs: int = NUM_EPOCHS,
) -> tuple[LipPredictor, list[float]]:
    """Fit a model; return it and the mean loss of each epoch.

    ``labeled`` are stretches that the teacher labeled. The ridge regression uses equal
    numbers of labeled and filmed positions.
    """
    network, losses = train_network(examples, labeled, num_epochs=num_epochs, seed=seed)
    every = max(1, round(_num_positions(labeled) / _num_positions(examples)))
    linear_on = [*examples, *labeled[::every]]
    linear = fit_ridge(
        [history_of(example.components) for example in linear_on],
        [canonical(example, network)[..., :_NUM_FAPS] for example in linear_on],
    )
    return joined(basis.mean, basis.projection, network, linear, basis.units), losses


def _num_positions(examples: Sequence[Example]) -> int:
    return sum(len(example.components) for example in examples)


def principal_components(features: Floats) -> tuple[Floats, Floats]:
    """Return the mean of features, (n, features), and the projection to their components.

    The log-mel frames and each layer have separate components.
    """
    mean = features.mean(axis=0)
    ends = np.linspace(_NUM_MEL_FEATURES, len(mean), NUM_LAYERS + 1).astype(int)
    parts = np.split(np.arange(len(mean)), ends[:-1])
    projection = np.zeros((len(mean), sum(number for number, _, _ in COMPONENTS)), np.float32)
    first = 0
    for part, (number, first_extent, last_extent) in zip(parts, COMPONENTS, strict=True):
        centered = features[:, part] - mean[part]
        covariance = (centered.T @ centered).astype(np.float64) / len(centered)
        variances, directions = np.linalg.eigh(covariance)
        kept = min(number, len(part))
        extents = np.linspace(first_extent, last_extent, kept)
        scale = extents / np.sqrt(np.maximum(variances[::-1][:kept], _MIN_VARIANCE))
        projection[part, first : first + kept] = directions[:, ::-1][:, :kept] * scale
        first += number
    return mean, projection


def units_of(targets: Sequence[Floats]) -> Units:
    """Measure the FAPs; one that no clip tracks gets the extent 0, so it stays at 0."""
    faps = np.concatenate([target[..., :_NUM_FAPS].reshape(-1, _NUM_FAPS) for target in targets])
    known = ~np.isnan(faps)
    count = np.maximum(known.sum(axis=0), 1)
    mean = np.where(known, faps, 0).sum(axis=0) / count
    extent = np.sqrt((np.where(known, faps - mean, 0) ** 2).sum(axis=0) / count)
    return Units(mean.astype(np.float32), extent.astype(np.float32))


def standardize(target: Floats, units: Units) -> Floats:
    """Express the FAPs of targets in units of their extent."""
    scale = np.where(units.extent > 0, units.extent, 1)
    faps = (target[..., :_NUM_FAPS] - units.mean) / scale
    return np.concatenate([faps, target[..., _NUM_FAPS:]], axis=-1).astype(np.float32)


def canonical(example: Example, network: LipNetwork) -> Floats:
    """Express the FAPs of an example's targets in units of the canonical face."""
    scale = np.exp(network.log_scale.detach().numpy()[example.speaker])
    offset = network.offset.detach().numpy()[example.speaker]
    faps = (example.targets[..., :_NUM_FAPS] - offset) / scale
    return np.concatenate([faps, example.targets[..., _NUM_FAPS:]], axis=-1)


def joined(
    mean: Floats, projection: Floats, network: LipNetwork, linear: Array, units: Units
) -> LipPredictor:
    """Average both halves; closure and lip to teeth come only from the network.

    The width is widened around its mean. The log odds of a closure are raised, so that closures are
    predicted where this costs least (Bayes decision).
    """
    weights = {name: value.numpy() for name, value in network.state_dict().items()}
    num_components = projection.shape[1]
    num_delays = linear.shape[1]
    share = np.ones(NUM_OUTPUTS)
    share[:_NUM_FAPS] = 0.5 * units.extent
    share[[LIP_FAPS.index(fap) for fap in _WIDTH_FAPS]] *= _WIDTH_FACTOR
    history = np.zeros((HISTORY * num_components, num_delays, NUM_OUTPUTS))
    history[..., :_NUM_FAPS] = linear[:-1] * share[:_NUM_FAPS]
    shape = (num_delays, NUM_OUTPUTS)
    bias = weights["output.bias"].reshape(shape) * share
    bias[:, :_NUM_FAPS] += linear[-1] * share[:_NUM_FAPS] + units.mean
    bias[:, CLOSURE] += np.log(_MISSED_CLOSURE)
    output = weights["output.weight"].T.reshape(-1, *shape) * share
    return LipPredictor(
        delays=np.array(DELAYS_S, np.float32),
        feature_mean=mean,
        projection=projection,
        entry_weights=np.ascontiguousarray(weights["entry.weight"].T),
        entry_bias=weights["entry.bias"],
        input_weights=np.ascontiguousarray(weights["recurrent.weight_ih_l0"].T),
        input_bias=weights["recurrent.bias_ih_l0"],
        state_weights=np.ascontiguousarray(weights["recurrent.weight_hh_l0"].T),
        state_bias=weights["recurrent.bias_hh_l0"],
        history_weights=history.reshape(HISTORY, num_components, *shape).astype(np.float32),
        output_weights=output.astype(np.float32),
        output_bias=bias.astype(np.float32),
    )
