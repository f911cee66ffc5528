"""Messages with a frame's blendshape weights, in the set and format that a viewer asked for."""

import json
from collections.abc import Mapping
from dataclasses import dataclass

import msgspec
import numpy as np

from kouxing.services.gateway import wire
from kouxing.shared.errors import UserError
from kouxing.shared.face.shapes import SHAPE_SETS

FORMATS = ("binary", "json", "msgpack")
_BINARY_TYPES = {"weights": wire.SHAPES_TYPE, "rest": wire.REST_SHAPES_TYPE}


@dataclass(frozen=True, slots=True)
class ShapeEncoder:
    """Encodes frames as weights of one shape set."""

    shape_set: str
    message_format: str  # one of FORMATS

    def names_message(self) -> str:
        """Return the message with the names of the shapes, in the order of binary weights."""
        return wire.text("shapes", set=self.shape_set, names=SHAPE_SETS[self.shape_set].names)

    def encode(self, kind: str, epoch: int, media_time: int, faps: bytes) -> str | bytes:
        """Return the message for a frame: 68 little-endian float32, FAP units.

        ``kind`` is "weights" for a frame of a session, "rest" for the face at rest.
        """
        shapes = SHAPE_SETS[self.shape_set]
        weights = shapes.weights(np.frombuffer(faps, "<f4"))
        if self.message_format == "binary":
            payload = weights.astype("<f4").tobytes()
            return wire.binary(_BINARY_TYPES[kind], epoch, media_time, payload)
        fields = {
            "type": kind,
            "set": self.shape_set,
            "epoch": epoch,
            "media_time": media_time,
            "weights": {
                name: round(float(weight), 4)
                for name, weight in zip(shapes.names, weights, strict=True)
            },
        }
        encode = json.dumps if self.message_format == "json" else msgspec.msgpack.encode
        return encode(fields)


def parse_shape_query(query: Mapping[str, str]) -> ShapeEncoder | None:
    """Return the encoder for the shapes in a URL's query; None without shapes.

    Raises ``UserError`` if the shape set or the format does not exist.
    """
    shape_set, message_format = query.get("shapes", ""), query.get("format", FORMATS[0])
    if shape_set and shape_set not in SHAPE_SETS:
        raise UserError(f"shapes must be one of {', '.join(SHAPE_SETS)}")
    if message_format not in FORMATS:
        raise UserError(f"format must be one of {', '.join(FORMATS)}")
    return ShapeEncoder(shape_set, message_format) if shape_set else None
