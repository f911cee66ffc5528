"""The initial networks: the recognizer's and the teacher's."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

from kouxing.services.recognizer.acoustic.acoustic_model import AcousticModel
from kouxing.services.recognizer.acoustic.neural import NeuralModel
from kouxing.services.recognizer.front_end.features import HOP_S
from kouxing.shared.errors import UserError
from kouxing.shared.phones.inventory import PhoneInventory
from kouxing.training.neural.alignment import STATES_PER_PHONE
from kouxing.training.neural.export import network_of
from kouxing.training.neural.network import Network, Shape
from kouxing.training.neural.teacher import NUM_LAYERS, WholeEncoder
from kouxing.training.neural.whisper_weights import load_whisper

LOOK_AHEADS_MS = (10, 30, 60, 100, 200)  # of the output layers besides the main one
FRAME_MS = 1000 * HOP_S
_MAX_LOOK_AHEAD = 100  # feature frames


def init_network(
    whisper: Path | None,
    before: AcousticModel | None,
    inventory: PhoneInventory,
    look_aheads: tuple[int, ...],
) -> Network:
    """Make the network to train, with the weights of Whisper or of an earlier model.

    Raises UserError if there are no weights, or the model has other states or output layers.
    """
    num_states = STATES_PER_PHONE * len(inventory)
    if before is None:
        if whisper is None:
            raise UserError(
                "training starts with Whisper's weights or an earlier model; give --whisper, "
                "--start-from or both"
            )
        network = Network(Shape(num_states=num_states, look_aheads=look_aheads))
        load_whisper(network, whisper)
        return network
    if before.inventory.language != inventory.language:
        raise UserError(
            f"the model of --start-from is for {before.inventory.language}, the aligner for "
            f"{inventory.language}; give models of one language"
        )
    if isinstance(before, NeuralModel) and tuple(before.look_aheads.tolist()) == look_aheads:
        with suppress(KeyError):  # the network was not exported here
            return network_of(before.network, look_aheads)
    requested = ", ".join(f"{frames * FRAME_MS:g}" for frames in look_aheads)
    raise UserError(
        f"the model of --start-from was not trained here with the look-aheads {requested} ms; "
        "give one that was"
    )


def init_encoder(whisper: Path, num_states: int) -> WholeEncoder:
    """Make the teacher's encoder, with Whisper's weights."""
    encoder = WholeEncoder(Shape(num_states=num_states, look_aheads=(), layers=NUM_LAYERS))
    load_whisper(encoder, whisper)
    return encoder


def all_look_aheads(main_ms: float) -> tuple[int, ...]:
    """Return the look-aheads of all output layers, ascending, feature frames.

    Raises UserError if the main one is not a multiple of 10 ms, or out of range.
    """
    main = main_ms / FRAME_MS
    if not (1 <= main <= _MAX_LOOK_AHEAD and main == round(main)):
        raise UserError(
            f"a look-ahead of {main_ms:g} ms cannot be trained; give 10, 20, 30... up to "
            f"{_MAX_LOOK_AHEAD * FRAME_MS:g}"
        )
    others = [round(ms / FRAME_MS) for ms in LOOK_AHEADS_MS]
    return tuple(sorted({*others, round(main)}))
