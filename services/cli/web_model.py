"""Writes the models for lip sync in a browser, which ``clients/kouxing-lips`` reads.

================ ====================================================================
file             contents
================ ====================================================================
``encoder.onnx`` the network of the audio encoder, unchanged
``model.bin``    arrays: mel bands, lip predictor, readout of feeling, blendshapes, expressions
``phones.bin``   arrays: HMMs and phone language model, needed only for phones
``blocks.onnx``  the block network, unchanged, needed only for final phones
``model.json``   types, shapes and offsets of these arrays; constants of the modules
================ ====================================================================

The constants come from the modules that the server runs, so a new model or threshold needs only a
new export.
"""

import json
from dataclasses import asdict, fields
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kouxing.services.recognizer.acoustic import blocks, encoder, model_file, network
from kouxing.services.recognizer.acoustic.acoustic_model import Topology
from kouxing.services.recognizer.acoustic.light import parse_light_model
from kouxing.services.recognizer.acoustic.load import model_path
from kouxing.services.recognizer.acoustic.model_file import read_archive
from kouxing.services.recognizer.front_end import resample, slices, vad, whisper_mel
from kouxing.services.recognizer.lips import lip_prediction, lip_predictor
from kouxing.services.recognizer.live import live_decoder, speech_segmenter, stream, voice_traits
from kouxing.services.recognizer.search import frame_search
from kouxing.services.recognizer.search.output_rule import MODEL_RULES, OutputRuleConfig
from kouxing.services.synthesizer import face_animator
from kouxing.services.synthesizer.config import SynthesizerConfig
from kouxing.services.synthesizer.lips.learned import closure_rule, lip_track, model, resting_lips
from kouxing.services.synthesizer.modifiers import expressiveness, feeling, nonverbal
from kouxing.shared import clock
from kouxing.shared.face import expression_motion, shapes
from kouxing.shared.face.expressions import MAX_EXPRESSIVENESS, MIN_EXPRESSIVENESS
from kouxing.shared.face.faps import MOUTH_FAPS, NUM_FAPS

FORMAT = "kouxing-lips 7"

_ALIGNMENT_BYTES = 8
# the constants that kouxing-lips and ovrlipsync use, by module
_CONSTANTS: dict[str, tuple[ModuleType, str]] = {
    "animator": (face_animator, "REST_S _VOICE_LEAD_S _SPEECH_LEAD_S _ROUNDING _MOUTH"),
    "blocks": (
        blocks,
        "FRAMES_PER_ENCODER_FRAME MAX_POSITIONS FLOOR_BANDS _PADDING _RIGHT_CONTEXT_FRAMES",
    ),
    "clock": (clock, "MEDIA_RATE_HZ"),
    "closures": (
        closure_rule,
        "_MIN_PROBABILITY _MAX_PROBABILITY _HOLD_S _EDGE_S _PARTED _WIDE_APART _ROUNDED "
        "_INNER_UPPER _INNER_LOWER _LEFT_CORNER _RIGHT_CORNER _UPPER _LOWER _LOWER_OUTER "
        "_INNER _OUTER _BOTH",
    ),
    "decoder": (
        frame_search,
        "IMPOSSIBLE _BEAM MAX_TOKENS SLOW_RATE _RATE_FRAMES _MAX_PENALTY_CHANGE",
    ),
    "encoder": (encoder, "PHONES_LAG_FRAMES"),
    "expression": (
        expression_motion,
        "CLOSED OPEN JAW UPPER LOWER _VISIBLE _EASE_S _FADE_S _FREE_S _BIND_S _WIDEST _WIDEST_JAW",
    ),
    "expressiveness": (
        expressiveness,
        "CLOSED JAW LOWER OPEN UPPER _WIDEST _USUAL_WIDTH _USUAL_PUSH _SIDEWAYS _MIN_WIDTH "
        "_MAX_PUSH _WIDTH _PUSH",
    ),
    "feeling": (feeling, "_GAIN _FILTER_S _SIZE _AROUSED _TIRED _PLEASANT _UNPLEASANT"),
    "learned": (
        model,
        "HOLD_S MAX_GAP_S NUM_MOUTH_FAPS TRANSITION_S _MEMORY_S _TEETH_LOG_ODDS "
        "_CLOSED_FRACTION _EPSILON _UNTRACKED _JITTER_SQUARED",
    ),
    "lips": (lip_predictor, "CLOSURE NUM_OUTPUTS _COLUMNS _ONES _OTHERS"),
    "lipPrediction": (lip_prediction, "ENCODER_FRAME_LAG_S"),
    "liveDecoder": (live_decoder, "_DEFAULT_CONFIDENCE"),
    "mel": (whisper_mel, "HOP_SAMPLES WINDOW_SAMPLES NUM_MELS FLOOR_BANDS _FLOOR _HANN _EDGES"),
    "modelFile": (model_file, "_LOG_STEP"),
    "network": (network, "MAX_POSITIONS FRAMES_PER_ENCODER_FRAME _LONGEST_WAVE"),
    "nonverbal": (
        nonverbal,
        "_HOLD_S _LEAD_S _LAUGH_EASE_S _LOUDNESS_DB _FORGET_DB_S _BREATH _SMILING _LOUD_NOTE",
    ),
    "pcm": (slices, "MEDIA_RATE_HZ SLICE_SAMPLES"),
    "resample": (resample, "SAMPLE_RATE_HZ _HALF_WIDTH _CUTOFF _KAISER_BETA _MAX_PHASES"),
    "rest": (
        resting_lips,
        "HOLD_S LEAD_S PART_S CLOSE_S CERTAIN _YIELD_S _END_S _MIN_PAUSE_S _RANGE_DB "
        "_FADE_DB _LAST_SOUND_S _LIKELY_BEFORE_S _LIKELY _DOUBT _ONSET_DB _ONSET_LEAD_S "
        "_ONSET_CLOSE_S _ONSET_S _MIN_BACKGROUND_DB _NUM_FIRST_LEVELS _BACKGROUND_RATE "
        "_BACKGROUND_RISE_DB AJAR",
    ),
    "segmenter": (
        speech_segmenter,
        "FRAMES_PER_ENCODER_FRAME HOP_S WINDOW_S _FIRST_FRAME_PARITY _RIGHT_CONTEXT_FRAMES "
        "_PRE_ROLL_FRAMES _MAX_RECENT",
    ),
    "shapes": (shapes, "NUM_FAPS _PATIENCE _ROUNDING"),
    "stream": (stream, "MEDIA_RATE_HZ SILENT_DB"),
    "track": (lip_track, "HOLD_S CLOSE_S _OPEN_S MAX_GAP_S"),
    "traits": (
        voice_traits,
        "NUM_TRAITS MIN_VOICE _FEELING_MEMORY _FEELING_PRIOR_WEIGHT _VOICE_PRIOR_WEIGHT "
        "_VOICE_MEMORY _DIGITS _EVIDENCE_FRACTION _START _STOP _MIN_LAUGHTER _LAUGH_ENCODER_FRAMES",
    ),
    "vad": (vad, "_NO_EVIDENCE _ENOUGH _IMPROBABLE _STOP_ENCODER_FRAMES"),
}


def web_model() -> dict[str, bytes]:
    """Return the contents of the files by name."""
    audio_encoder = encoder.load_encoder()
    readout = voice_traits.load_voice_readout()
    predictor = lip_predictor.load_lip_predictor()
    arrays: dict[str, NDArray[Any]] = {
        "mel.bands": whisper_mel.mel_bands(),
        **{f"lips.{field.name}": getattr(predictor, field.name) for field in fields(predictor)},
        **{f"traits.{field.name}": getattr(readout, field.name) for field in fields(readout)},
        **{f"expressions.{name}": faps for name, faps in expression_motion.EXPRESSION_FAPS.items()},
    }
    for name, shape_set in shapes.SHAPE_SETS.items():
        arrays |= {f"shapes.{name}.gram": shape_set.gram, f"shapes.{name}.right": shape_set.right}
    block_archive = read_archive(model_path("blocks"))
    light = parse_light_model(block_archive)
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
    blob, places = _pack_arrays(arrays)
    phone_blob, phone_places = _pack_arrays(phone_arrays)
    settings = SynthesizerConfig()
    header = {
        "format": FORMAT,
        "stateWidth": audio_encoder.state_width,
        "voices": {voice.name: int(voice) for voice in encoder.VoiceKind},
        "numFaps": NUM_FAPS,
        "mouthFaps": MOUTH_FAPS,
        "closureRule": asdict(closure_rule.ClosureRule()),
        "defaults": {
            "frameRateHz": settings.frame_rate_hz,
            "delayS": settings.delay_ms / 1e3,
            "expressiveness": settings.expressiveness,
            "feeling": settings.feeling,
            "expressivenessRange": (MIN_EXPRESSIVENESS, MAX_EXPRESSIVENESS),
        },
        "shapeNames": {name: shape_set.names for name, shape_set in shapes.SHAPE_SETS.items()},
        "expressionNames": list(expression_motion.EXPRESSION_FAPS),
        "constants": {
            name: {
                constant.lstrip("_"): np.asarray(getattr(module, constant)).tolist()
                for constant in constants.split()
            }
            for name, (module, constants) in _CONSTANTS.items()
        },
        "phones": {
            **_phones_header(topology),
            "acousticScale": float(block_archive.floats("acoustic_scale")),
        },
        "arrays": places,
        "phoneArrays": phone_places,
    }
    return {
        "encoder.onnx": _read_network(read_archive(encoder.ENCODER_PATH)),
        "blocks.onnx": _read_network(block_archive),
        "model.bin": blob,
        "phones.bin": phone_blob,
        "model.json": json.dumps(header, separators=(",", ":")).encode(),
    }


def _read_network(archive: model_file.Archive) -> bytes:
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
        "rateWeight": topology.rate_weight,
        "rules": {
            name: {"numStableFrames": rule.num_stable_frames, "minConfidence": rule.min_confidence}
            for name, rule in rules.items()
        },
    }


def _pack_arrays(arrays: dict[str, NDArray[Any]]) -> tuple[bytes, dict[str, dict[str, Any]]]:
    """Join arrays; return the bytes, and type, shape and first byte of each array."""
    blob = bytearray()
    places = {}
    for name, array in arrays.items():
        short = _to_shortest_type(array)
        blob += bytes(-len(blob) % _ALIGNMENT_BYTES)
        places[name] = {"type": short.dtype.name, "shape": short.shape, "begin": len(blob)}
        blob += short.tobytes()
    return bytes(blob), places


def _to_shortest_type(array: NDArray[Any]) -> NDArray[Any]:
    """Return an array in the shortest type that keeps its values. Integers keep their type."""
    if array.dtype.kind in "iu":
        return array
    for kind in (np.float16, np.float32):
        short = array.astype(kind)
        if np.array_equal(short, array):
            return short
    return array.astype(np.float64)
