"""A second readout of the block network: its scores, and what the first readout keeps."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch

from kouxing.services.recognizer.acoustic import load
from kouxing.services.recognizer.acoustic.acoustic_model import score_segment
from kouxing.services.recognizer.acoustic.blocks import BlockModel
from kouxing.services.recognizer.acoustic.load import load_model
from kouxing.services.recognizer.live.live_decoder import StreamOutput
from kouxing.services.recognizer.live.recognizer import Recognizer
from kouxing.shared import fast_record
from kouxing.shared.errors import UserError
from kouxing.shared.phones.events import Phone
from kouxing.shared.phones.inventory import load_inventory
from kouxing.training.blocks.network import BlockReadout, block_layout
from kouxing.training.model_files import save_universal
from kouxing.training.networks.network import ReadoutShape
from kouxing.training.universal.encoder import BLOCK_LENGTH, RIGHT_CONTEXT, FeatureEncoder
from kouxing.training.universal.recipe import export_extension
from tests.block_networks import BLOCK, FRAMES, LENGTH, SCALE, blocks, networks
from tests.live_streams import LiveStream
from tests.system import HELLO

pytestmark = [pytest.mark.usefixtures("one_thread")]

LAYERS = (-3, -1)
SHAPE = ReadoutShape(inner=40, gru=24, dropout=0.0, noise=0.0)


@cache
def readout() -> BlockReadout:
    torch.manual_seed(1)
    return BlockReadout(64, 180, SHAPE).eval()


@cache
def extended() -> BlockModel:
    extension = export_extension(readout(), blocks(), LAYERS)
    return replace(blocks(), network=np.concatenate([blocks().network, extension]))


@pytest.mark.parametrize("hop", [1, 2])
def test_the_second_readout_agrees_with_pytorch(hop: int) -> None:
    encoder, _ = networks()
    layout = block_layout(len(FRAMES) // 2, hop * BLOCK, LENGTH - hop * BLOCK)
    repeated = torch.from_numpy(np.concatenate([FRAMES, FRAMES[-1:]]))[None]
    with torch.no_grad():
        hidden = encoder(repeated, layout)
        features = torch.cat([hidden[..., :32], hidden[..., -32:]], dim=-1)
        expected = readout().read(features, layout)[0, : len(FRAMES) // 2].flatten(0, 1).numpy()
    stream = extended().create_stream()
    stream.set_hop(hop)
    scores = np.concatenate([stream.score(frame[None]) for frame in FRAMES])
    num_alike = len(FRAMES) - 2 * LENGTH  # with a complete right context
    wanted = SCALE * (expected - blocks().log_prior)
    np.testing.assert_allclose(scores[:num_alike], wanted[:num_alike], atol=0.05)


def test_the_first_readout_and_the_caches_do_not_change() -> None:
    model, both = blocks(), extended()
    stream, other = model.create_stream(), both.create_stream()
    for frames in np.split(FRAMES, 5):
        stream.append_frames(frames)
        other.append_frames(frames)
        while stream.is_due:
            outputs, both_outputs = (
                network.runner.run([scored.block()])
                for network, scored in ((model, stream), (both, other))
            )
            np.testing.assert_array_equal(outputs[2], both_outputs[2])
            assert not np.array_equal(outputs[0], both_outputs[0])
            for scored, arrays in ((stream, outputs), (other, both_outputs)):
                scored.append_outputs(scored.block(), *(array[0] for array in arrays))


def test_training_uses_the_features_of_the_network() -> None:
    encoder, _ = networks()
    layout = block_layout(len(FRAMES) // 2, BLOCK_LENGTH, RIGHT_CONTEXT)
    repeated = np.concatenate([FRAMES, FRAMES[-1:]])
    with torch.no_grad():
        hidden = encoder(torch.from_numpy(repeated)[None], layout)[0, :, -32:].numpy()
    first, second = FeatureEncoder(blocks(), (-1,)).encode([FRAMES, FRAMES[:75]])
    assert first.shape == (17, BLOCK_LENGTH + RIGHT_CONTEXT, 32)
    assert len(second) == 4
    rows = hidden[layout.blocks.numpy()]
    exists = layout.is_valid.numpy()
    exists[-4:] = False  # they lack positions here
    error = np.abs(first[exists] - rows[exists]).mean()  # of 8-bit integers
    assert error < 0.02 * rows[exists].std()


def test_a_file_belongs_to_one_block_network(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "universal.npz"
    monkeypatch.setattr(load, "_block_network", lambda: blocks().network)
    extension = export_extension(readout(), blocks(), LAYERS)
    save_universal(path, extended(), extension)
    model = load_model(path)
    assert isinstance(model, BlockModel)
    np.testing.assert_array_equal(score_segment(model, FRAMES), score_segment(extended(), FRAMES))
    monkeypatch.setattr(load, "_block_network", lambda: blocks().network[:-1])
    with pytest.raises(UserError, match="another version of the block model"):
        load_model(path)


def phones_of(results: list[StreamOutput]) -> list[Phone]:
    return [result for result in results if isinstance(result, Phone)]


def test_sessions_of_two_languages_share_a_recognizer() -> None:
    recognizer = Recognizer(load_model())
    streams = [recognizer.create_stream(language=name) for name in ("mandarin", "universal")]
    for stream in streams:
        stream.accept_waveform(HELLO)
        stream.input_finished()
    recognizer.decode_streams(streams)
    mandarin, other = (phones_of(stream.take_results()) for stream in streams)
    alone = LiveStream(load_model())
    assert mandarin == phones_of(alone.feed(HELLO) + alone.finish())
    symbols = {phone.symbol for phone in other}
    assert len(symbols) > 5
    assert symbols <= {*load_inventory("universal").phones}
    with pytest.raises(UserError, match="'tlh' is not installed"):
        recognizer.create_stream(language="tlh")


def test_the_shipped_model_keeps_the_state_after_the_kept_positions() -> None:
    model = load_model("universal")
    assert isinstance(model, BlockModel)
    stream = model.create_stream()
    stream.append_frames(FRAMES[:100])
    block = stream.block()
    first, second = (
        model.runner.run([fast_record.replace(block, num_kept=num)])[1] for num in (2, 4)
    )
    assert not np.array_equal(first, second)


def test_the_block_network_is_read_once() -> None:
    shipped = load_model()
    assert load_model("blocks") is shipped
    assert isinstance(shipped, BlockModel)
    assert load._block_network() is shipped.network
