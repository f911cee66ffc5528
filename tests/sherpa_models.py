"""Folders of tiny speech recognizers in sherpa-onnx's formats, which return 你好 for any audio."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

TOKENS = ("<blk>", "</s>", "<unk>", "你", "好", "<|zh|>", "<|NEUTRAL|>", "<|Speech|>", "<|woitn|>")
_WORD = [TOKENS.index(character) for character in "你好"]
_TAGS = [5, 6, 7, 8]  # before the text of SenseVoice
_FEATURES = {
    "lfr_window_size": 7,
    "lfr_window_shift": 6,
    "vocab_size": len(TOKENS),
    "neg_mean": ",".join(["0"] * 560),
    "inv_stddev": ",".join(["1"] * 560),
}
_LANGUAGES = {"auto": 0, "zh": 3, "en": 4, "yue": 7, "ja": 11, "ko": 12}

Shape = Sequence[int | str]
Node = tuple[str, Sequence[str], str, Mapping[str, int]]  # operator, inputs, output, attributes


def _node(operator: str, inputs: Sequence[str], output: str, attributes: Mapping[str, int]) -> Any:
    node = helper.make_node(operator, inputs, [output])
    node.attribute.extend(helper.make_attribute(*attribute) for attribute in attributes.items())
    return node


def _write(
    path: Path,
    nodes: Sequence[Node],
    inputs: Mapping[str, tuple[int, Shape]],
    outputs: Mapping[str, tuple[int, Shape]],
    constants: Mapping[str, np.ndarray],
    about: Mapping[str, object],
) -> None:
    graph = helper.make_graph(
        [_node(*node) for node in nodes],
        path.stem,
        [helper.make_tensor_value_info(name, *kind) for name, kind in inputs.items()],
        [helper.make_tensor_value_info(name, *kind) for name, kind in outputs.items()],
        [numpy_helper.from_array(np.asarray(value), name) for name, value in constants.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)
    helper.set_model_props(model, {key: str(value) for key, value in about.items()})
    onnx.checker.check_model(model)
    onnx.save(model, path)


def _folder(path: Path) -> Path:
    path.mkdir()
    lines = [f"{token} {number}\n" for number, token in enumerate(TOKENS)]
    (path / "tokens.txt").write_text("".join(lines), encoding="utf-8")
    return path


def _logits(tokens: Sequence[int]) -> np.ndarray:
    return 10.0 * np.eye(len(TOKENS), dtype=np.float32)[list(tokens)][None]


def paraformer(path: Path) -> Path:
    """Write a Paraformer."""
    tokens = [*_WORD, 1]
    _write(
        _folder(path) / "model.onnx",
        [("Identity", ["all"], "logits", {}), ("Identity", ["number"], "token_num", {})],
        {
            "speech": (TensorProto.FLOAT, ["N", "T", 560]),
            "speech_lengths": (TensorProto.INT32, ["N"]),
        },
        {
            "logits": (TensorProto.FLOAT, [1, len(tokens), len(TOKENS)]),
            "token_num": (TensorProto.INT32, [1]),
        },
        {"all": _logits(tokens), "number": np.array([len(tokens)], np.int32)},
        _FEATURES | {"model_type": "paraformer"},
    )
    return path


def sense_voice(path: Path) -> Path:
    """Write a SenseVoice: four tags, then a token for each frame."""
    begin = [*_TAGS, _WORD[0], 0, _WORD[1]]
    _write(
        _folder(path) / "model.onnx",
        [
            ("ReduceSum", ["x", "last_axis"], "sum", {"keepdims": 1}),
            ("Mul", ["sum", "nothing"], "zeros", {}),
            ("Add", ["zeros", "blank"], "blanks", {}),
            ("Slice", ["blanks", "three", "end", "one"], "rest", {}),
            ("Concat", ["begin", "rest"], "logits", {"axis": 1}),
        ],
        {
            "x": (TensorProto.FLOAT, ["N", "T", 560]),
            **{name: (TensorProto.INT32, ["N"]) for name in ("x_length", "language", "text_norm")},
        },
        {"logits": (TensorProto.FLOAT, ["N", "T_out", len(TOKENS)])},
        {
            "last_axis": np.array([2], np.int64),
            "nothing": np.zeros((1, 1, len(TOKENS)), np.float32),
            "blank": _logits([0]),
            "begin": _logits(begin),
            "three": np.array([3], np.int64),
            "end": np.array([10_000], np.int64),
            "one": np.array([1], np.int64),
        },
        _FEATURES
        | {"model_type": "sense_voice_ctc", "normalize_samples": 0, "with_itn": 14}
        | {"without_itn": 15}
        | {f"lang_{name}": number for name, number in _LANGUAGES.items()},
    )
    return path


def transducer(path: Path) -> Path:
    """Write a transducer whose decoder derives the next token from the last one."""
    size = len(TOKENS)
    _folder(path)
    _write(
        path / "encoder.onnx",
        [
            ("ReduceSum", ["x", "last_axis"], "sum", {"keepdims": 1}),
            ("Mul", ["sum", "nothing"], "encoder_out", {}),
            ("Identity", ["x_lens"], "encoder_out_lens", {}),
        ],
        {
            "x": (TensorProto.FLOAT, ["N", "T", 80]),
            "x_lens": (TensorProto.INT64, ["N"]),
        },
        {
            "encoder_out": (TensorProto.FLOAT, ["N", "T", size]),
            "encoder_out_lens": (TensorProto.INT64, ["N"]),
        },
        {"last_axis": np.array([2], np.int64), "nothing": np.zeros((1, 1, size), np.float32)},
        {"model_type": "zipformer2", "version": 1},
    )
    following = {0: _WORD[0], _WORD[0]: _WORD[1]}
    after = _logits([following.get(token, 0) for token in range(size)])[0]
    _write(
        path / "decoder.onnx",
        [
            ("Gather", ["y", "newest"], "last", {"axis": 1}),
            ("Gather", ["after", "last"], "decoder_out", {"axis": 0}),
        ],
        {"y": (TensorProto.INT64, ["N", 2])},
        {"decoder_out": (TensorProto.FLOAT, ["N", size])},
        {"newest": np.array(1, np.int64), "after": after},
        {"context_size": 2, "vocab_size": size},
    )
    _write(
        path / "joiner.onnx",
        [("Add", ["encoder_out", "decoder_out"], "logit", {})],
        {name: (TensorProto.FLOAT, ["N", size]) for name in ("encoder_out", "decoder_out")},
        {"logit": (TensorProto.FLOAT, ["N", size])},
        {},
        {"joiner_dim": size},
    )
    return path
