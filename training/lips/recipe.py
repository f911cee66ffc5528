"""From clips of real lips to the model of lips from sound.

    clips -> [voice detector, acoustic network] -> principal components -> recurrent network and
    each speaker's units -> ridge regression in canonical units -> mean of the two

Every clip that is not held out and whose licence allows it is trained on; no setting is chosen by
them. Each goes in once as it is and in augmented copies, so that few voices stand for more. A
teacher may label further speech, which nobody filmed (:mod:`kouxing.training.lips.teacher`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.progress import track

from kouxing.corpora.lip_clips import label_clip, read_clips
from kouxing.corpora.speech_corpus import may_ship
from kouxing.services.recognizer.acoustic.load import load_model
from kouxing.services.recognizer.acoustic.network import FRAMES_PER_POSITION
from kouxing.services.recognizer.acoustic.neural import NeuralModel
from kouxing.services.recognizer.front_end.whisper_mel import NUM_MELS
from kouxing.services.recognizer.lips import (
    CLOSURE,
    LIP_FAPS,
    NUM_LAYERS,
    NUM_OUTPUTS,
    LipPredictor,
)
from kouxing.shared.errors import UserError
from kouxing.training.lips.card import Trained, write_card
from kouxing.training.lips.positions import Speech, components_of, features_of, speech_of
from kouxing.training.lips.recurrent import Example, LipNetwork, train_network
from kouxing.training.lips.ridge import HISTORY, fit_ridge, history_of
from kouxing.training.lips.targets import Touch, targets_at, touches
from kouxing.training.lips.teacher import (
    draw_recordings,
    label_recordings,
    load_encoder,
    train_teacher,
)

Floats = NDArray[np.float32]
Array = NDArray[np.float64]

# 5 ms less than a face's delay of 0, 20, 50, 60, 100 or 160 ms: so long before a frame of the face
# the sound of a position ends.
DELAYS_S = (-0.005, 0.015, 0.045, 0.055, 0.095, 0.155)
NUM_COPIES = 1  # augmented, of each clip
NUM_EPOCHS = 12
# Of the log-mel frames and of each layer's values: components, and extent of the first and of the
# last. What is small counts less, in the network and in the ridge: it holds the speaker.
COMPONENTS = ((32, 0.5, 0.5), *[(96, 1.0, 0.2)] * NUM_LAYERS)
_NUM_MEL_FEATURES = FRAMES_PER_POSITION * NUM_MELS
_NUM_FAPS = len(LIP_FAPS)
_MIN_VARIANCE = 1e-8
_MISSED_CLOSURE = 2.0  # false ones that a missed closure is worth
# A regression tells less than the lips do: on strangers its width has 0.6 of their extent. So much
# more undoes the half of that, and rounds lips at u and ü, at no cost in the median error.
_WIDENED = 1.3
_WIDTH_FAPS = (6, 53)


@dataclass(frozen=True, slots=True)
class Units:
    """Mean and extent of each FAP over all training speech, FAP units."""

    mean: Floats  # (15,)
    extent: Floats  # (15,)


@dataclass(frozen=True, slots=True)
class Basis:
    """What the model's inputs and outputs are measured in."""

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
    any_licence: bool = False,
) -> None:
    """Train lips from sound; write the model and its card.

    Parameters
    ----------
    folder
        Clips with lips.
    output
        The ``.npz`` file to write; the card is written beside it as ``.md``.
    speech
        Folders of recordings without lips, in any language, which the teacher labels. Their
        licences are unknown: name only folders that may be used.
    whisper
        Folder with Whisper base, see :func:`training.neural.whisper_weights.load_whisper`, for the
        teacher.
    seed
        The same seed gives the same model.
    any_licence
        Train also on clips whose licence forbids giving the model away.

    Raises
    ------
    UserError
        If no clip may be used, there is no teacher for speech without lips, the shipped acoustic
        model is not neural, or a file cannot be read.
    """
    if speech and whisper is None:
        raise UserError("only a teacher can label what --speech names: give --whisper too")
    model = load_model()
    if not isinstance(model, NeuralModel):
        raise UserError("lips from sound need the neural acoustic model; reinstall it")
    clips = read_clips(folder, any_licence=any_licence, language=None)
    used = [
        clip for clip in clips if clip.part != "held" and (any_licence or may_ship(clip.licence))
    ]
    if not used:
        raise UserError(
            f"no clip in {folder} may be used; give clips with a free licence, or --any-licence"
        )
    recordings = draw_recordings(speech, seed)
    heard = track(speech_of(model, clips), description="clips", total=len(clips))
    positions = {clip.name: stretches for clip, stretches in zip(clips, heard, strict=True)}
    copies = [
        stretch
        for copy in range(1, NUM_COPIES + 1)
        for stretches in track(
            speech_of(model, used, copy), description="augmented copies", total=len(used)
        )
        for stretch in stretches
    ]
    trained_on = [stretch for clip in used for stretch in positions[clip.name]]
    if not trained_on:
        raise UserError(f"nobody speaks in the clips of {folder}; give clips with speech")
    filmed = [*trained_on, *copies]
    targets = _targets(model, filmed, touches(clips))
    basis = basis_of(trained_on, targets)
    examples = examples_of(filmed, targets, basis)
    labelled = []
    if whisper and recordings:
        teacher = train_teacher(
            load_encoder(whisper), filmed, examples, DELAYS_S, num_epochs=NUM_EPOCHS, seed=seed
        )
        labelled = label_recordings(
            teacher,
            model,
            recordings,
            lambda stretch: components_of(stretch, basis.mean, basis.projection),
            DELAYS_S,
            speaker=1 + max(example.speaker for example in examples),
        )
    lips, losses = fit(examples, labelled, basis, seed)
    lips.save(output)
    own = targets[: len(trained_on)]
    write_card(
        output, Trained(lips, losses, used, trained_on, own, labelled, seed), clips, positions
    )


def _targets(model: NeuralModel, speech: Sequence[Speech], touch: dict[str, Touch]) -> list[Floats]:
    """Targets of every stretch, FAP units, (positions, delays, 17)."""
    code = model.inventory.code
    clips = {each.clip.name: each.clip for each in speech if each.clip.language == code}
    phones = {
        name: label_clip(model, clip) for name, clip in track(clips.items(), description="phones")
    }
    return [
        targets_at(
            each.clip,
            phones.get(each.clip.name),
            touch[each.clip.speaker],
            each.known_s * each.speed,
            [delay_s * each.speed for delay_s in DELAYS_S],
        )
        for each in speech
    ]


def basis_of(unchanged: Sequence[Speech], targets: Sequence[Floats]) -> Basis:
    """Find the components of speech without augmentation and the units of targets, FAP units."""
    return Basis(*principal_components(features_of(unchanged)), units_of(targets))


def examples_of(speech: Sequence[Speech], targets: Sequence[Floats], basis: Basis) -> list[Example]:
    """Return filmed stretches as examples; targets in FAP units, (positions, delays, 17) each."""
    speakers = sorted({each.clip.speaker for each in speech})
    return [
        Example(
            components_of(each, basis.mean, basis.projection),
            standardised(target, basis.units),
            speakers.index(each.clip.speaker),
        )
        for each, target in zip(speech, targets, strict=True)
    ]


def fit(
    examples: Sequence[Example],
    labelled: Sequence[Example],
    basis: Basis,
    seed: int,
    num_epochs: int = NUM_EPOCHS,
) -> tuple[LipPredictor, list[float]]:
    """Fit a model; return it and the mean loss of each epoch.

    Parameters
    ----------
    examples
        Filmed stretches.
    labelled
        Those that a teacher labelled. The ridge regression takes as many positions of them.
    basis
        What the examples are measured in.
    seed
        The same seed gives the same model.
    num_epochs
        Of the network.
    """
    network, losses = train_network(examples, labelled, num_epochs=num_epochs, seed=seed)
    every = max(1, round(_num_positions(labelled) / _num_positions(examples)))
    linear_on = [*examples, *labelled[::every]]
    linear = fit_ridge(
        [history_of(example.components) for example in linear_on],
        [canonical(example, network)[..., :_NUM_FAPS] for example in linear_on],
    )
    return joined(basis.mean, basis.projection, network, linear, basis.units), losses


def _num_positions(examples: Sequence[Example]) -> int:
    return sum(len(each.components) for each in examples)


def principal_components(features: Floats) -> tuple[Floats, Floats]:
    """Return the mean of features, (n, features), and the projection to their components.

    The log-mel frames and each layer have components of their own.
    """
    mean = features.mean(axis=0)
    ends = np.linspace(_NUM_MEL_FEATURES, len(mean), NUM_LAYERS + 1).astype(int)
    parts = np.split(np.arange(len(mean)), ends[:-1])
    projection = np.zeros((len(mean), sum(number for number, _, _ in COMPONENTS)), np.float32)
    first = 0
    for part, (number, first_extent, last_extent) in zip(parts, COMPONENTS, strict=True):
        centred = features[:, part] - mean[part]
        covariance = (centred.T @ centred).astype(np.float64) / len(centred)
        variances, directions = np.linalg.eigh(covariance)
        kept = min(number, len(part))
        extents = np.linspace(first_extent, last_extent, kept)
        scale = extents / np.sqrt(np.maximum(variances[::-1][:kept], _MIN_VARIANCE))
        projection[part, first : first + kept] = directions[:, ::-1][:, :kept] * scale
        first += number
    return mean, projection


def units_of(targets: Sequence[Floats]) -> Units:
    """Measure the FAPs; one that no clip tracks has the extent 0, so that it stays at 0."""
    faps = np.concatenate([target[..., :_NUM_FAPS].reshape(-1, _NUM_FAPS) for target in targets])
    known = ~np.isnan(faps)
    count = np.maximum(known.sum(axis=0), 1)
    mean = np.where(known, faps, 0).sum(axis=0) / count
    extent = np.sqrt((np.where(known, faps - mean, 0) ** 2).sum(axis=0) / count)
    return Units(mean.astype(np.float32), extent.astype(np.float32))


def standardised(target: Floats, units: Units) -> Floats:
    """Return targets with the FAPs in units of their extent."""
    scale = np.where(units.extent > 0, units.extent, 1)
    faps = (target[..., :_NUM_FAPS] - units.mean) / scale
    return np.concatenate([faps, target[..., _NUM_FAPS:]], axis=-1).astype(np.float32)


def canonical(example: Example, network: LipNetwork) -> Floats:
    """Return an example's targets with the FAPs in the canonical face's units."""
    scale = np.exp(network.log_scale.detach().numpy()[example.speaker])
    offset = network.offset.detach().numpy()[example.speaker]
    faps = (example.targets[..., :_NUM_FAPS] - offset) / scale
    return np.concatenate([faps, example.targets[..., _NUM_FAPS:]], axis=-1)


def joined(
    mean: Floats, projection: Floats, network: LipNetwork, linear: Array, units: Units
) -> LipPredictor:
    """Join both parts, half of each; closure and lip to teeth come from the network alone.

    The width is widened around its mean. A closure is told where that costs least (Bayes'
    decision), so its log odds are raised.
    """
    weights = {name: value.numpy() for name, value in network.state_dict().items()}
    num_components = projection.shape[1]
    num_delays = linear.shape[1]
    share = np.ones(NUM_OUTPUTS)
    share[:_NUM_FAPS] = 0.5 * units.extent
    share[[LIP_FAPS.index(fap) for fap in _WIDTH_FAPS]] *= _WIDENED
    history = np.zeros((HISTORY * num_components, num_delays, NUM_OUTPUTS))
    history[..., :_NUM_FAPS] = linear[:-1] * share[:_NUM_FAPS]
    shape = (num_delays, NUM_OUTPUTS)
    bias = weights["output.bias"].reshape(shape) * share
    bias[:, :_NUM_FAPS] += linear[-1] * share[:_NUM_FAPS] + units.mean
    bias[:, CLOSURE] += np.log(_MISSED_CLOSURE)
    output = weights["output.weight"].T.reshape(-1, *shape) * share
    exact = LipPredictor(
        delays=np.array(DELAYS_S, np.float32),
        feature_mean=mean,
        projection=projection,
        entry_weights=weights["entry.weight"].T,
        entry_bias=weights["entry.bias"],
        input_weights=weights["recurrent.weight_ih_l0"].T,
        input_bias=weights["recurrent.bias_ih_l0"],
        state_weights=weights["recurrent.weight_hh_l0"].T,
        state_bias=weights["recurrent.bias_hh_l0"],
        history_weights=history.reshape(HISTORY, num_components, *shape).astype(np.float32),
        output_weights=output.astype(np.float32),
        output_bias=bias.astype(np.float32),
    )
    return replace(
        exact,
        **{
            name: np.ascontiguousarray(getattr(exact, name))
            for name in ("entry_weights", "input_weights", "state_weights")
        },
    )
