"""From corpora to the window model: labels, readout, model card.

Everything but the readout is given: Whisper's encoder, which stays as it is, and the HMMs, the
phone language model, the states' prior and the search's weights of a neural model made before.
That model also aligns the recordings with their texts.

The training can be interrupted: labels and readout are kept beside the output, as ``.labels.npz``
and ``.readout.pt``, and the same command goes on from them. They are deleted at the end.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import torch

from corpora.speech_corpus import RowErrors
from services.recognizer.acoustic.load import MODEL_PATH, load_model
from services.recognizer.acoustic.network import Floats, open_session
from services.recognizer.acoustic.neural import NeuralModel
from services.recognizer.acoustic.window import MAX_WINDOW_FRAMES, WindowModel
from shared.errors import UserError
from training.model_card import write_card
from training.neural.batches import Recording
from training.neural.initial_network import init_encoder
from training.neural.teacher import WholeEncoder
from training.progress import Report
from training.training_set import FRAMES_PER_MINUTE, load_examples
from training.window.export import onnx_of
from training.window.labels import label, load_labels, save_labels
from training.window.readout import BATCH_S, train_readout

NUM_STEPS = 450
WINDOW_FRAMES, HOP_FRAMES = 250, 10


def train_window(
    corpora: Sequence[Path],
    output: Path,
    *,
    whisper: Path,
    start: Path | None = None,
    untranscribed: Sequence[Path] = (),
    seed: int = 0,
    num_steps: int = NUM_STEPS,
    shipping: bool = True,
    report: Report = print,
) -> None:
    """Train the window model, and write the model and its card.

    Parameters
    ----------
    corpora
        Folders that :func:`corpora.speech_corpus.read_corpus` reads; splits ``train`` and ``dev``.
    output
        The ``.npz`` file to write; the card is written beside it as ``.md``.
    whisper
        Folder with Whisper base, see :func:`training.neural.whisper_weights.load_whisper`.
    start
        A neural model: its HMMs, phone language model, prior and weights are taken over; it aligns.
        Without it, that is the model that ships.
    untranscribed
        Folders of recordings in any language, which the teacher labels. Their licences are
        unknown: name only folders that may be used.
    seed
        Of the draw of recordings, new weights, windows and augmentation.
    num_steps
        Number of batches of 70 s of sound.
    shipping
        Leave out rows whose licence forbids giving the model away.
    report
        Receives lines of progress.

    Raises
    ------
    UserError
        If there is nothing to train on, ``start`` is no neural model, or a file cannot be read.
    """
    start = start or MODEL_PATH
    before = load_model(start)
    if not isinstance(before, NeuralModel):
        raise UserError(f"{start} is no neural model; give one that 'kouxing train neural' made")
    torch.set_num_threads(1)  # the same sums on every machine
    torch.manual_seed(seed)
    encoder = init_encoder(whisper, before.topology.num_states).eval()
    errors = RowErrors()
    examples = load_examples(
        corpora, errors, before.inventory, shipping=shipping, with_samples=True
    )
    labels, readout_state = output.with_suffix(".labels.npz"), output.with_suffix(".readout.pt")
    if not labels.exists():
        labelled = label(
            examples,
            untranscribed,
            aligner=before,
            encoder=encoder,
            errors=errors,
            seed=seed,
            report=report,
        )
        save_labels(labels, labelled)
    recordings = load_labels(labels)
    readout = train_readout(
        encode_by(encoder),
        recordings,
        before.topology.num_states,
        seed=seed,
        num_steps=num_steps,
        kept=readout_state,
        report=report,
    )
    model = WindowModel(
        topology=before.topology,
        network=onnx_of(encoder, readout, MAX_WINDOW_FRAMES // 2),
        log_prior=before.log_prior,
        acoustic_scale=before.acoustic_scale,
        window_frames=WINDOW_FRAMES,
        hop_frames=HOP_FRAMES,
    )
    model.save(output)
    write_card(
        output,
        title="Window model: Whisper's encoder on the last seconds, with a learnt readout",
        details=f"with Whisper's weights (Radford et al. 2023, MIT licence), seed {seed}, "
        f"{num_steps} steps of {BATCH_S} s of sound, aligned by `{start.name}`, "
        + _details(recordings),
        examples=examples,
        errors=errors,
        chosen=None,
    )
    errors.print_to(report)
    labels.unlink()
    readout_state.unlink()


def encode_by(encoder: WholeEncoder) -> Callable[[Floats], Floats]:
    """Make the encoder in the recognizer's own arithmetic."""
    session = open_session(onnx_of(encoder, None, MAX_WINDOW_FRAMES // 2))

    def encode(frames: Floats) -> Floats:
        features: Floats = session.run(None, {"frames": frames})[0]
        return features

    return encode


def _details(recordings: Sequence[Recording]) -> str:
    """Tell the card how much was drawn."""
    minutes = sum(len(recording.targets) for recording in recordings) / FRAMES_PER_MINUTE
    return f"on {len(recordings)} recordings of {minutes:.0f} minutes drawn from those below"
