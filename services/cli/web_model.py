"""Writes the models for lip sync in a browser, which ``clients/kouxing-lips`` reads.

=============== ====================================================================
file            contents
=============== ====================================================================
``ear.onnx``    the network of the small ear, unchanged
``model.bin``   arrays: mel bands, lip predictor, readout of feeling, blendshapes, expressions
``phones.bin``  arrays: HMMs and phone language model, needed only for phones
``blocks.onnx`` the block network, unchanged, needed only for final phones
``model.json``  types, shapes and offsets of these arrays; constants of the modules
=============== ====================================================================

The constants come from the modules that the server runs. The package defines none of its own, so a
new model or threshold needs only a new export.
"""

from __future__ import annotations

import json
from dataclasses import asdict, fields
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kouxing.services.recognizer import (
    ear,
    lip_frames,
    lip_predictor,
    live_decoder,
    speech_segmenter,
    stream,
    voice_traits,
)
from kouxing.services.recognizer.acoustic import blocks, model_file, network
from kouxing.services.recognizer.acoustic.acoustic_model import Topology
from kouxing.services.recognizer.acoustic.light import light_model_from
from kouxing.services.recognizer.acoustic.load import model_path
from kouxing.services.recognizer.acoustic.model_file import read_archive
from kouxing.services.recognizer.front_end import features, pcm, resample, vad, whisper_mel
from kouxing.services.recognizer.search import decoder
from kouxing.services.recognizer.search.output_rule import MODEL_RULES, OutputRuleConfig
from kouxing.services.synthesizer import face_animator
from kouxing.services.synthesizer.config import SynthesizerConfig
from kouxing.services.synthesizer.lips.learnt import closures, model, rest, track
from kouxing.services.synthesizer.modifiers import expressiveness, feeling, nonverbal
from kouxing.shared import clock
from kouxing.shared.face import expression_motion, shapes
from kouxing.shared.face.expressions import MAX_EXPRESSIVENESS, MIN_EXPRESSIVENESS
from kouxing.shared.face.faps import MOUTH_FAPS, NUM_FAPS

FORMAT = "kouxing-lips 2"

_ALIGNMENT_BYTES = 8
_MAX_CONSTANT_SIZE = 400  # longer lists are arrays
_MODULES = {  # kouxing-lips and ovrlipsync use the numbers of these modules by name
    "animator": face_animator,
    "blocks": blocks,
    "clock": clock,
    "closures": closures,
    "decoder": decoder,
    "ear": ear,
    "expression": expression_motion,
    "expressiveness": expressiveness,
    "features": features,
    "feeling": feeling,
    "learnt": model,
    "lips": lip_predictor,
    "lipFrames": lip_frames,
    "liveDecoder": live_decoder,
    "mel": whisper_mel,
    "modelFile": model_file,
    "network": network,
    "nonverbal": nonverbal,
    "pcm": pcm,
    "resample": resample,
    "rest": rest,
    "segmenter": speech_segmenter,
    "shapes": shapes,
    "stream": stream,
    "track": track,
    "traits": voice_traits,
    "vad": vad,
}


def web_model() -> dict[str, bytes]:
    """Return the contents of the files by name."""
    small_ear = ear.load_ear()
    readout = voice_traits.load_voice_readout()
    predictor = lip_predictor.load_lip_predictor()
    arrays: dict[str, NDArray[Any]] = {
        "mel.bands": whisper_mel.mel_bands(),
        **{f"lips.{field.name}": getattr(predictor, field.name) for field in fields(predictor)},
        **{f"traits.{field.name}": getattr(readout, field.name) for field in fields(readout)},
        **{f"expressions.{name}": faps for name, faps in expression_motion.EXPRESSION_FAPS.items()},
    }
    for name, shape_set in shapes.SHAPE_SETS.items():
        gram, right = shape_set.equation
        arrays |= {f"shapes.{name}.gram": gram, f"shapes.{name}.right": right}
    block_archive = read_archive(model_path("blocks"))
    light = light_model_from(block_archive)
    topology = light.topology
    phone_arrays: dict[str, NDArray[Any]] = {
        **{
            name: array
            for name, array in model_file.phone_lm_arrays(topology.phone_lm).items()
            if name.startswith("lm_")
        },
        "first_state": topology.first_state.astype(np.int32),
        "log_stay": topology.log_stay,
        "log_leave": topology.log_leave,
        "duration_mean_s": topology.duration_mean_s,
        "log_prior": light.log_prior,
        "block_log_prior": block_archive.floats("log_prior", topology.num_states),
    }
    blob, places = _pack(arrays)
    phone_blob, phone_places = _pack(phone_arrays)
    settings = SynthesizerConfig()
    header = {
        "format": FORMAT,
        "stateWidth": small_ear.state_width,
        "voices": {voice.name: int(voice) for voice in ear.Voice},
        "numFaps": NUM_FAPS,
        "mouthFaps": MOUTH_FAPS,
        "closureRule": asdict(closures.ClosureRule()),
        "defaults": {
            "frameRateHz": settings.frame_rate_hz,
            "delayS": settings.delay_ms / 1e3,
            "expressiveness": settings.expressiveness,
            "feeling": settings.feeling,
            "expressivenessRange": (MIN_EXPRESSIVENESS, MAX_EXPRESSIVENESS),
        },
        "shapeNames": {name: shape_set.names for name, shape_set in shapes.SHAPE_SETS.items()},
        "expressionNames": list(expression_motion.EXPRESSION_FAPS),
        "constants": {name: _constants(module) for name, module in _MODULES.items()},
        "phones": {
            **_phones_header(topology),
            "acousticScale": float(block_archive.floats("acoustic_scale")),
        },
        "arrays": places,
        "phoneArrays": phone_places,
    }
    return {
        "ear.onnx": _network_in(read_archive(ear.EAR_PATH)),
        "blocks.onnx": _network_in(block_archive),
        "model.bin": blob,
        "phones.bin": phone_blob,
        "model.json": json.dumps(header, separators=(",", ":")).encode(),
    }


def _network_in(archive: model_file.Archive) -> bytes:
    return archive.array("network", None).astype(np.uint8).tobytes()


def _phones_header(topology: Topology) -> dict[str, Any]:
    """Return what the package needs about the phones in addition to arrays."""
    inventory = topology.inventory
    rules = {name: MODEL_RULES.get(name, OutputRuleConfig()) for name in ("light", "blocks")}
    return {
        "symbols": inventory.phones,
        "silence": inventory.silence,
        "closing": {
            viseme: [symbol for symbol, of in inventory.visemes.items() if of[0][0] == viseme]
            for viseme in ("b", "f")
        },
        "lmScale": topology.lm_scale,
        "phonePenalty": topology.phone_penalty,
        "rules": {
            name: {"numStableFrames": rule.num_stable_frames, "minConfidence": rule.min_confidence}
            for name, rule in rules.items()
        },
    }


def _pack(arrays: dict[str, NDArray[Any]]) -> tuple[bytes, dict[str, dict[str, Any]]]:
    """Join arrays; return the bytes, and type, shape and first byte of each array."""
    blob = bytearray()
    places = {}
    for name, array in arrays.items():
        short = _shortened(array)
        blob += bytes(-len(blob) % _ALIGNMENT_BYTES)
        places[name] = {"type": short.dtype.name, "shape": short.shape, "begin": len(blob)}
        blob += short.tobytes()
    return bytes(blob), places


def _shortened(array: NDArray[Any]) -> NDArray[Any]:
    """Return an array in the shortest type that keeps its values; integers keep theirs."""
    if array.dtype.kind in "iu":
        return array
    for kind in (np.float16, np.float32):
        short = array.astype(kind)
        if np.array_equal(short, array):
            return short
    return array.astype(np.float64)


def _constants(module: ModuleType) -> dict[str, Any]:
    """Return the numbers and lists of numbers that a module defines in upper case."""
    values = {
        name.lstrip("_"): np.asarray(value).tolist()
        for name, value in vars(module).items()
        if name.isupper() and isinstance(value, int | float | tuple | list | np.ndarray | np.number)
    }
    return {name: value for name, value in values.items() if _is_small_number_list(value)}


def _is_small_number_list(value: object) -> bool:
    numbers = np.asarray(value)
    return numbers.dtype.kind in "if" and numbers.size <= _MAX_CONSTANT_SIZE
