"""The block model: its scores, its chunks and its file."""

from pathlib import Path

import numpy as np
import pytest
import torch

from kouxing.services.recognizer.acoustic import blocks as blocks_module
from kouxing.services.recognizer.acoustic.acoustic_model import score_segment
from kouxing.services.recognizer.acoustic.encoder import ENCODER_PATH
from kouxing.services.recognizer.acoustic.load import load_model
from kouxing.services.recognizer.acoustic.model_file import read_archive
from kouxing.services.recognizer.acoustic.network import encode_integer_inputs
from kouxing.shared.errors import UserError
from kouxing.training.blocks.export import export_onnx
from kouxing.training.blocks.network import block_layout
from kouxing.training.model_files import save_blocks, write_archive
from tests.block_networks import BLOCK, FRAMES, LENGTH, RIGHT, SCALE, blocks, networks

pytestmark = [pytest.mark.usefixtures("one_thread")]


def torch_scores(frames: np.ndarray, block_length: int, right_context: int = RIGHT) -> np.ndarray:
    """Return the scores of a recording's blocks, (blocks, 2 (B + R), states)."""
    encoder, readout = networks()
    num_positions = (len(frames) + 1) // 2
    layout = block_layout(num_positions, block_length, right_context)
    repeated = np.repeat(frames[-1:], 2 * num_positions + 1 - len(frames), axis=0)
    with torch.no_grad():
        features = encoder(torch.from_numpy(np.concatenate([frames, repeated]))[None], layout)
        rows = readout.read(features, layout)[0].numpy()
    scores = SCALE * (rows - blocks().log_prior)
    by_block: np.ndarray = scores[layout.blocks.numpy()].reshape(len(layout.blocks), -1, 180)
    return by_block


@pytest.mark.parametrize("hop", [1, 2])
def test_onnxruntime_and_pytorch_agree(hop: int) -> None:
    block, right = hop * BLOCK, LENGTH - hop * BLOCK
    expected = torch_scores(FRAMES, block, right)
    stream = blocks().create_stream()
    stream.set_hop(hop)
    start = 0
    for number, scores in enumerate(expected[: -4 // hop]):  # with a complete right context
        end = 2 * (block * number + LENGTH) + 1
        settled = stream.score(FRAMES[start:end])
        assert len(settled) == 2 * block
        assert len(stream.provisional) == 2 * right
        np.testing.assert_allclose(settled, scores[: 2 * block], atol=0.05)
        np.testing.assert_allclose(stream.provisional, scores[2 * block :], atol=0.05)
        start = end


@pytest.mark.parametrize("num_frames", [1, 6, 27])
def test_the_last_run_settles_all_positions_together(num_frames: int) -> None:
    frames = FRAMES[:num_frames]
    (expected,) = torch_scores(frames, LENGTH)
    scores = score_segment(blocks(), frames)
    assert len(scores) == num_frames
    np.testing.assert_allclose(scores, expected[:num_frames], atol=0.05)


def test_chunks_and_other_sessions_do_not_affect_scores() -> None:
    model = blocks()
    lone = model.create_stream()
    provisional = [lone.provisional]
    for frame in FRAMES:
        lone.score(frame[None])
        provisional.append(lone.provisional)
    expected = score_segment(model, FRAMES)
    rng = np.random.default_rng(0)
    num_streams = 18  # more than one run has
    streams = [model.create_stream() for _ in range(num_streams)]
    rows: list[list[np.ndarray]] = [[] for _ in streams]
    at = np.zeros(num_streams, int)
    while (at < len(FRAMES)).any():
        ready = rng.permutation(np.flatnonzero(at < len(FRAMES)))[: rng.integers(1, 19)]
        ends = [min(at[n] + int(rng.integers(1, 40)), len(FRAMES)) for n in ready]
        work = [(streams[n], FRAMES[at[n] : end]) for n, end in zip(ready, ends, strict=True)]
        at[ready] = ends
        for n, scores in zip(ready, model.score(work), strict=True):
            rows[n].append(scores)
            np.testing.assert_array_equal(streams[n].provisional, provisional[at[n]])
    for stream, parts in zip(streams, rows, strict=True):
        np.testing.assert_array_equal(np.concatenate([*parts, stream.score(None)]), expected)


def test_long_speech_restarts_the_table_with_an_empty_past(monkeypatch: pytest.MonkeyPatch) -> None:
    expected = score_segment(blocks(), FRAMES)
    monkeypatch.setattr(blocks_module, "MAX_POSITIONS", 40)
    short = score_segment(blocks(), FRAMES)
    np.testing.assert_array_equal(short[:56], expected[:56])  # with a complete right context
    assert not np.array_equal(short[80:160], expected[80:160])
    later = FRAMES.copy()
    later[:78] = later[later[:78].max(axis=1).argmax()]  # frames that only precede the restart
    np.testing.assert_array_equal(score_segment(blocks(), later)[80:], short[80:])


def test_rejects_a_file_with_bad_arrays(tmp_path: Path) -> None:
    path = tmp_path / "blocks.npz"
    save_blocks(path, blocks())
    arrays = read_archive(path).arrays
    changes: list[tuple[dict[str, np.ndarray], str]] = [
        ({"network": np.zeros(100, np.uint8)}, "network cannot be read"),
        ({"network": read_archive(ENCODER_PATH).array("network", None)}, "has the inputs"),
        ({"network": export_onnx(*networks(), BLOCK, past=6000)}, "has the sizes"),  # much memory
        (
            {"network": export_onnx(*networks(178), BLOCK)},
            r"its network outputs the shape \(1, 30, 178\)",
        ),
        ({"log_prior": np.zeros(7, np.float32)}, "log_prior has shape"),
    ]
    for change, message in changes:
        write_archive(path, {**arrays, **change})
        with pytest.raises(UserError, match=message):
            load_model(path)


def test_rejects_inputs_whose_length_needs_two_bytes() -> None:
    assert len(encode_integer_inputs({"a": 1})) < 128
    with pytest.raises(ValueError, match="a2, a3"):
        encode_integer_inputs({f"a{number}": 1 for number in range(9)})


def test_the_hop_may_change_at_any_time() -> None:
    stream = blocks().create_stream()
    rng = np.random.default_rng(0)
    rows = []
    for frame in FRAMES:
        stream.set_hop(int(rng.integers(1, 4)))
        rows.append(stream.score(frame[None]))
    rows.append(stream.score(None))
    assert max(map(len, rows)) == 2 * LENGTH
    np.testing.assert_allclose(
        np.concatenate(rows)[: 2 * BLOCK], torch_scores(FRAMES, BLOCK)[0][: 2 * BLOCK], atol=0.3
    )
    assert len(np.concatenate(rows)) == len(FRAMES)
