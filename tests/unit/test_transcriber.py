"""Speech to text with sherpa-onnx."""

import sys
from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from kouxing.services.recognizer.offline.transcriber import Transcriber
from kouxing.shared.errors import UserError

SOUND = 0.1 * np.random.default_rng(0).standard_normal(16_000).astype(np.float32)
TOKENS = ("<blk>", "</s>", "<unk>", "你", "好")


@pytest.fixture
def paraformer(tmp_path: Path) -> Path:
    """Write a Paraformer that returns 你好 for any audio."""
    constants = {
        "all": 10.0 * np.eye(len(TOKENS), dtype=np.float32)[[3, 4, 1]][None],
        "number": np.array([3], np.int32),
    }
    info = helper.make_tensor_value_info
    graph = helper.make_graph(
        [
            helper.make_node("Identity", ["all"], ["logits"]),
            helper.make_node("Identity", ["number"], ["token_num"]),
        ],
        "paraformer",
        [
            info("speech", TensorProto.FLOAT, ["N", "T", 560]),
            info("speech_lengths", TensorProto.INT32, ["N"]),
        ],
        [
            info("logits", TensorProto.FLOAT, constants["all"].shape),
            info("token_num", TensorProto.INT32, [1]),
        ],
        [numpy_helper.from_array(value, name) for name, value in constants.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)
    properties = {"model_type": "paraformer", "lfr_window_size": "7", "lfr_window_shift": "6"}
    properties |= {"vocab_size": str(len(TOKENS)), "neg_mean": ",".join(["0"] * 560)}
    helper.set_model_props(model, properties | {"inv_stddev": ",".join(["1"] * 560)})
    folder = tmp_path / "sherpa-onnx-paraformer-zh"
    folder.mkdir()
    onnx.save(model, folder / "model.int8.onnx")
    lines = [f"{token} {number}\n" for number, token in enumerate(TOKENS)]
    (folder / "tokens.txt").write_text("".join(lines), encoding="utf-8")
    return folder


def test_the_smallest_file_of_a_model_is_used(paraformer: Path) -> None:
    (paraformer / "model.onnx").write_bytes(bytes(100_000))  # cannot be loaded
    transcriber = Transcriber(paraformer)
    assert [transcriber.transcribe(sound) for sound in (SOUND, SOUND[:8000])] == ["你好", "你好"]


def test_rejects_a_folder_without_a_model(tmp_path: Path, paraformer: Path) -> None:
    with pytest.raises(UserError, match=r"contains no tokens\.txt"):
        Transcriber(tmp_path)
    with pytest.raises(UserError, match="no model of a known kind"):
        Transcriber(paraformer.rename(tmp_path / "other"))
    damaged = (tmp_path / "other").rename(paraformer)
    (damaged / "tokens.txt").write_text("你 0\n", encoding="utf-8")
    with pytest.raises(UserError, match=r"paraformer-zh: sherpa-onnx cannot load the model"):
        Transcriber(damaged)


def test_reports_which_package_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "sherpa_onnx", None)
    with pytest.raises(UserError, match=r"pip install 'kouxing\[speech-to-text\]'"):
        Transcriber(tmp_path)
