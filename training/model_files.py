"""Writes the recognizer's model files: npz archives of plain arrays, without pickle."""

from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kouxing.services.recognizer.acoustic import blocks, gmm, universal
from kouxing.services.recognizer.acoustic.acoustic_model import Topology
from kouxing.services.recognizer.acoustic.model_file import phone_lm_arrays, shipped_phone_lm
from kouxing.services.recognizer.lips import lip_predictor
from kouxing.services.recognizer.live import voice_traits
from kouxing.shared.arrays import UInt8
from kouxing.shared.files.output_file import open_output

_LANGUAGE = ("language", "phones")  # arrays


def write_archive(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write a model file."""
    with open_output(path) as file:
        np.savez_compressed(file, allow_pickle=False, **arrays)


def topology_arrays(topology: Topology) -> dict[str, NDArray[Any]]:
    """Return the arrays of the HMMs, and of their phone language model unless it is shipped."""
    arrays, shipped = map(phone_lm_arrays, (topology.phone_lm, shipped_phone_lm()))
    if all(np.array_equal(array, shipped[name]) for name, array in arrays.items()):
        arrays = {name: arrays[name] for name in _LANGUAGE}
    return {
        **arrays,
        "lm_scale": np.array(topology.lm_scale, np.float32),
        "phone_penalty": np.array(topology.phone_penalty, np.float32),
        "rate_weight": np.array(topology.rate_weight, np.float32),
        "first_state": topology.first_state,
        "log_stay": topology.log_stay,
        "log_leave": topology.log_leave,
        "duration_mean_s": topology.duration_mean_s,
        "duration_spread_s": topology.duration_spread_s,
    }


def save_gmm(path: Path, model: gmm.GmmModel) -> None:
    """Write a Gaussian mixture model."""
    _save_acoustic_model(
        path,
        gmm.FORMAT,
        model.topology,
        weights=model.mixtures.weights,
        means=model.mixtures.means,
        covars=model.mixtures.covars,
        rotation=model.rotation,
        prior_mean=model.prior_mean,
        half_width=model.half_width,
        acoustic_scale=model.acoustic_scale,
    )


def save_blocks(path: Path, model: blocks.BlockModel) -> None:
    """Write a block model."""
    _save_acoustic_model(
        path,
        blocks.FORMAT,
        model.topology,
        network=model.network,
        log_prior=model.log_prior,
        acoustic_scale=model.acoustic_scale,
    )


def save_universal(path: Path, model: blocks.BlockModel, extension: UInt8) -> None:
    """Write a model that extends the network of the shipped block model."""
    _save_acoustic_model(
        path,
        universal.FORMAT,
        model.topology,
        block_network=universal.compute_network_hash(model.network[: -len(extension)]),
        extension=extension,
        log_prior=model.log_prior,
        acoustic_scale=model.acoustic_scale,
    )


def _save_acoustic_model(path: Path, form: str, topology: Topology, **arrays: Any) -> None:
    others = {name: np.asarray(values) for name, values in arrays.items()}
    write_archive(path, {"format": np.array(form), **topology_arrays(topology), **others})


def save_lip_predictor(path: Path, predictor: lip_predictor.GruLipPredictor) -> None:
    """Write a lip predictor, with weights of 16 bits."""
    arrays = {field.name: getattr(predictor, field.name) for field in fields(predictor)}
    halves = {name: array.astype(np.float16) for name, array in arrays.items()}
    exact = {name: arrays[name] for name in ("delays", "output_bias")}
    write_archive(path, {"format": np.array(lip_predictor.FORMAT), **halves, **exact})


def save_voice_readout(path: Path, readout: voice_traits.VoiceReadout) -> None:
    """Write a readout of voice traits."""
    arrays = {name: getattr(readout, name) for name in ("weights", "bias", "mean")}
    write_archive(path, {"format": np.array(voice_traits.FORMAT), **arrays})
