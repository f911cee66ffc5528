"""Universal phones: a second readout of the block network, for all languages.

The file has an extension of the shipped block network instead of a network
(:mod:`kouxing.training.universal.recipe`). Its phones are the universal inventory.
"""

import hashlib

import numpy as np

from kouxing.services.recognizer.acoustic.blocks import BlockModel, build_block_model
from kouxing.services.recognizer.acoustic.model_file import Archive
from kouxing.shared.arrays import UInt8

FORMAT = "universal 1"


def parse_universal_model(archive: Archive, network: UInt8) -> BlockModel:
    """Build the model on the block network; raises ``ValueError`` if something does not fit."""
    if str(archive.array("block_network", ())) != compute_network_hash(network):
        raise ValueError("it belongs to another version of the block model")
    extension = archive.array("extension", None).astype(np.uint8)
    return build_block_model(archive, np.concatenate([network, extension]))


def compute_network_hash(network: UInt8) -> str:
    """Return the hash that identifies a block network."""
    return hashlib.sha256(network.tobytes()).hexdigest()
