"""From clips of real lips to the model of lips from sound.

    clips -> [voice detector, acoustic network] -> principal components -> recurrent network and
    each speaker's units -> ridge regression in canonical units -> mean of the two

Every clip that is not held out and whose licence allows it is trained on; no setting is chosen by
them. Each goes in once as it is and in augmented copies, so that few voices stand for more. A
teacher may label further speech, which nobody filmed (:mod:`training.lips.teacher`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.progress import track

from corpora.lip_clips import label_clip, read_clips
from corpora.speech_corpus import may_ship
from services.recognizer.acoustic.load import load_model
from services.recognizer.acoustic.network import FRAMES_PER_POSITION
from services.recognizer.acoustic.neural import NeuralModel
from services.recognizer.front_end.whisper_mel import NUM_MELS
from services.recognizer.lips import (
    CLOSURE,
    LIP_FAPS,
    NUM_LAYERS,
    NUM_OUTPUTS,
    LipPredictor,
)
from shared.errors import UserError
from training.lips.card import Trained, write_card
from training.lips.positions import Speech, components_of, features_of, speech_of
from training.lips.recurrent import Example, LipNetwork, train_network
from training.lips.ridge import HISTORY, fit_ridge, history_of
from training.lips.targets import Touch, targets_at, touches
from training.lips.teacher import Lessons, hear, load_encoder, read_recordings, teach

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
    recordings = read_recordings(speech, seed)
    positions = {clip.name: speech_of(model, clip) for clip in track(clips, description="clips")}
    copies = [
        stretch
        for clip in track(used, description="augmented copies")
        for copy in range(1, NUM_COPIES + 1)
        for stretch in speech_of(model, clip, copy)
    ]
    trained_on = [stretch for clip in used for stretch in positions[clip.name]]
    if not trained_on:
        raise UserError(f"nobody speaks in the clips of {folder}; give clips with speech")
    targets = _targets(model, [*trained_on, *copies], touches(clips))
    lessons = None
    if whisper and recordings:
        lessons = hear(load_encoder(whisper), model, [*trained_on, *copies], recordings)
    lips, losses = fit([*trained_on, *copies], targets, trained_on, seed, lessons=lessons)
    lips.save(output)
    own = targets[: len(trained_on)]
    write_card(
        output, Trained(lips, losses, used, trained_on, own, lessons, seed), clips, positions
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


def fit(
    speech: Sequence[Speech],
    targets: Sequence[Floats],
    unchanged: Sequence[Speech],
    seed: int,
    num_epochs: int = NUM_EPOCHS,
    lessons: Lessons | None = None,
) -> tuple[LipPredictor, list[float]]:
    """Fit a model; return it and the mean loss of each epoch.

    Parameters
    ----------
    speech
        Stretches of speech.
    targets
        Of each, in FAP units, (positions, delays, 17).
    unchanged
        Those without augmentation, which the principal components are of.
    seed
        The same seed gives the same model.
    num_epochs
        Of the network, and of the teacher.
    lessons
        What a teacher labels.
    """
    mean, projection = principal_components(features_of(unchanged))
    units = units_of(targets)
    speakers = sorted({each.clip.speaker for each in speech})
    examples = [
        Example(
            components_of(each, mean, projection),
            standardised(target, units),
            speakers.index(each.clip.speaker),
        )
        for each, target in zip(speech, targets, strict=True)
    ]
    if lessons:
        known = [components_of(each, mean, projection) for each in lessons.speech]
        examples += teach(lessons, examples, known, DELAYS_S, num_epochs=num_epochs, seed=seed)
    network, losses = train_network(examples, num_epochs=num_epochs, seed=seed)
    linear = fit_ridge(
        [history_of(example.components) for example in examples],
        [canonical(example, network)[..., :_NUM_FAPS] for example in examples],
    )
    return joined(mean, projection, network, linear, units), losses


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
