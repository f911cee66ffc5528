"""Reads model files: npz archives of plain arrays, without pickle. Every size is checked."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from kouxing.services.recognizer.acoustic.acoustic_model import NUM_PHRASE_POSITIONS, Topology
from kouxing.services.recognizer.search.phone_lm import MAX_ORDER, PhoneLanguageModel
from kouxing.shared.arrays import Floats
from kouxing.shared.errors import UserError
from kouxing.shared.files.array_file import read_arrays
from kouxing.shared.phones.inventory import PhoneInventory, load_inventory

# For model files without a phone language model.
PHONE_LM_PATH = Path(__file__).parents[1] / "models" / "phone_lm.npz"

MAX_BYTES = 256 * 1024 * 1024  # limit for a file, compressed or not
_MAX_STATES = 10_000
_MAX_NODES = 10_000_000
_MAX_WEIGHT = 10.0
_MAX_RATE_WEIGHT = 1000.0
Component = TypeVar("Component")
_LOG_STEP = np.float32(0.05)  # nats; a phone language model's logs are stored in 8 bits


@dataclass(frozen=True, slots=True)
class Archive:
    """The arrays of a model file."""

    arrays: dict[str, NDArray[Any]]

    def __contains__(self, name: str) -> bool:
        return name in self.arrays

    def array(self, name: str, shape: tuple[int, ...] | None) -> NDArray[Any]:
        """Return an array of a given shape (None: any); ValueError if it does not fit."""
        if name not in self.arrays:
            raise ValueError(f"{name} is missing")
        array = self.arrays[name]
        if shape is not None and array.shape != shape:
            raise ValueError(f"{name} has shape {array.shape}, expected {shape}")
        return array

    def floats(self, name: str, *shape: int) -> Floats:
        """Return an array of finite numbers of a given shape; ValueError if it does not fit."""
        values = self.array(name, shape).astype(np.float32)
        if not np.isfinite(values).all():
            raise ValueError(f"{name} contains values that are not finite")
        return values


def read_archive(path: Path) -> Archive:
    """Read a model file; raises ``UserError`` if it is missing or not a model file."""
    if not path.exists():
        raise UserError(
            f"there is no acoustic model at {path}; use blocks, light, gmm, universal, or a model"
            " file"
        )
    return Archive(read_arrays(path, MAX_BYTES, "an acoustic model; reinstall or train one"))


def load_component(
    path: Path, expected_format: str, name: str, build: Callable[[Archive], Component]
) -> Component:
    """Read a component of the recognizer, such as the encoder; ``name`` appears in errors.

    Raises ``UserError`` if the file is missing, broken or of another format.
    """
    archive = read_archive(path)
    try:
        stored_format = str(archive.array("format", ()))
        if stored_format != expected_format:
            raise ValueError(f"it has the format {stored_format!r}, expected {expected_format!r}")
        return build(archive)
    except ValueError as error:
        raise UserError(f"{name} {path}: {error}; train it again") from error


def parse_topology(archive: Archive) -> Topology:
    """Build the HMMs after checking every size; raises as ``parse_phone_lm``."""
    phone_lm = (
        parse_phone_lm(archive) if "lm_children" in archive else _shipped_phone_lm_for(archive)
    )
    num_phones = len(phone_lm.inventory)
    first_state = archive.array("first_state", (num_phones + 1,)).astype(np.int64)
    if first_state[0] != 0 or (np.diff(first_state) < 1).any() or first_state[-1] > _MAX_STATES:
        raise ValueError("its states are not in order")
    num_states = int(first_state[-1])
    lm_scale = float(archive.floats("lm_scale"))
    phone_penalty = float(archive.floats("phone_penalty"))
    if not 0 <= lm_scale <= _MAX_WEIGHT or abs(phone_penalty) > _MAX_WEIGHT:
        raise ValueError(f"lm_scale is {lm_scale:g}, phone_penalty {phone_penalty:g}")
    rate_weight = float(archive.floats("rate_weight")) if "rate_weight" in archive else 0.0
    if not 0 <= rate_weight <= _MAX_RATE_WEIGHT:
        raise ValueError(f"rate_weight is {rate_weight:g}")
    return Topology(
        phone_lm=phone_lm,
        first_state=first_state,
        log_stay=archive.floats("log_stay", num_states),
        log_leave=archive.floats("log_leave", num_states),
        lm_scale=lm_scale,
        phone_penalty=phone_penalty,
        rate_weight=rate_weight,
        duration_mean_s=archive.floats("duration_mean_s", NUM_PHRASE_POSITIONS, num_phones),
        duration_spread_s=archive.floats("duration_spread_s", NUM_PHRASE_POSITIONS, num_phones),
    )


@cache
def shipped_phone_lm() -> PhoneLanguageModel:
    """Return the shipped phone language model."""
    return parse_phone_lm(read_archive(PHONE_LM_PATH))


def _shipped_phone_lm_for(archive: Archive) -> PhoneLanguageModel:
    """Return the shipped phone language model, if it is for the archive's language."""
    language, shipped = parse_inventory(archive).language, shipped_phone_lm()
    if language != shipped.inventory.language:
        raise ValueError(f"it has no phone language model, and {language} has no shipped one")
    return shipped


def phone_lm_arrays(phone_lm: PhoneLanguageModel) -> dict[str, NDArray[Any]]:
    """Return the arrays of a phone language model, with the name and phones of its language."""
    log_prob, log_backoff = (
        np.rint(log / _LOG_STEP) for log in (phone_lm.log_prob, phone_lm.log_backoff)
    )
    return {
        "language": np.array(phone_lm.inventory.language),
        "phones": np.array(phone_lm.inventory.phones),
        "lm_children": phone_lm.num_children,
        "lm_phone": phone_lm.phone,
        "lm_log_prob": np.clip(-log_prob, 0, 255).astype(np.uint8),  # the sign is always negative
        "lm_log_backoff": np.clip(log_backoff, -127, 127).astype(np.int8),
    }


def parse_phone_lm(archive: Archive) -> PhoneLanguageModel:
    """Build a phone language model after checking every number.

    Raises
    ------
    ValueError
        If an array does not fit.
    UserError
        If the model's language is not installed.
    """
    inventory = parse_inventory(archive)
    num_phones = len(inventory)
    children = archive.array("lm_children", None).astype(np.int64)
    if children.ndim != 1 or not 1 + num_phones <= len(children) <= _MAX_NODES:
        raise ValueError(f"lm_children has shape {children.shape}")
    node = np.arange(len(children))
    first_child = 1 + np.cumsum(children) - children
    if (
        children.min() < 0
        or children[0] != num_phones
        or children.sum() != len(children) - 1
        or (first_child <= node)[children > 0].any()
    ):
        raise ValueError("its phone language model does not form a tree")
    phone = archive.array("lm_phone", children.shape).astype(np.int64)
    is_first = np.zeros(len(phone) + 1, dtype=bool)
    is_first[first_child] = True
    if phone.min() < 0 or phone.max() >= num_phones or (np.diff(phone) < 1)[~is_first[1:-1]].any():
        raise ValueError("the phones of its phone language model are not in order")
    phone_lm = PhoneLanguageModel(
        inventory=inventory,
        num_children=children.astype(np.uint8),
        phone=phone.astype(np.uint8),
        log_prob=-_LOG_STEP * archive.floats("lm_log_prob", len(phone)),
        log_backoff=_LOG_STEP * archive.floats("lm_log_backoff", len(phone)),
    )
    if len(phone_lm.levels) > MAX_ORDER + 2:
        raise ValueError(f"its phone language model has n-grams of more than {MAX_ORDER} phones")
    return phone_lm


def parse_inventory(archive: Archive) -> PhoneInventory:
    """Load the inventory of the file's language, and check that the file has the same phones."""
    inventory = load_inventory(str(archive.array("language", ())))
    if tuple(archive.array("phones", None).tolist()) != inventory.phones:
        raise ValueError(f"its phones differ from the installed language {inventory.language}")
    return inventory
