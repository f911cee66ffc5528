"""Encodes a frame's blendshape weights, in the shape set and format that a viewer requested."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import msgspec
import numpy as np
from aiohttp import web

from kouxing.services.gateway.messages import browser_messages
from kouxing.services.gateway.messages.browser_messages import FORMATS
from kouxing.shared.errors import UserError
from kouxing.shared.face.shape_names import choose_set, find_shapes
from kouxing.shared.face.shapes import SHAPE_SETS

MAX_AVATAR_SHAPES = 1024
_BINARY_TYPES = {"weights": browser_messages.SHAPES_TYPE, "rest": browser_messages.REST_SHAPES_TYPE}


@dataclass(frozen=True, slots=True)
class ShapeEncoder:
    """Encodes frames as weights of one shape set, or of the shapes of an avatar."""

    shape_set: str
    message_format: str  # one of FORMATS
    targets: tuple[tuple[int, int], ...] = ()  # an avatar's meshes and the shapes within them
    indices: tuple[int, ...] = ()  # indices of the shapes' weights in the set

    def header_message(self) -> str:
        """Return the message with the names or the targets, in the order of the weights."""
        if self.targets:
            return browser_messages.encode_json("avatar", set=self.shape_set, targets=self.targets)
        return browser_messages.encode_json(
            "shapes", set=self.shape_set, names=SHAPE_SETS[self.shape_set].names
        )

    def encode(self, kind: str, epoch: int, media_time: int, faps: bytes) -> str | bytes:
        """Return the message for a frame: 68 little-endian float32, FAP units.

        ``kind`` is "weights" for a frame of a session, "rest" for the face at rest.
        """
        shapes = SHAPE_SETS[self.shape_set]
        weights = shapes.weights(np.frombuffer(faps, "<f4"))
        if self.targets:
            weights = weights[[*self.indices]]
        if self.message_format == "binary":
            payload = weights.astype("<f4").tobytes()
            return browser_messages.encode_binary(_BINARY_TYPES[kind], epoch, media_time, payload)
        rounded = [round(float(weight), 4) for weight in weights]
        fields = {
            "type": kind,
            "set": self.shape_set,
            "epoch": epoch,
            "media_time": media_time,
            "weights": rounded if self.targets else dict(zip(shapes.names, rounded, strict=True)),
        }
        encode = json.dumps if self.message_format == "json" else msgspec.msgpack.encode
        return encode(fields)


def parse_shape_query(query: Mapping[str, str]) -> ShapeEncoder | None:
    """Return the encoder for the shapes in a URL's query; None without shapes.

    Raises ``HTTPBadRequest`` if the shape set or the format does not exist.
    """
    shape_set, message_format = query.get("shapes", ""), query.get("format", FORMATS[0])
    if shape_set and shape_set not in SHAPE_SETS:
        raise web.HTTPBadRequest(text=f"shapes must be one of {', '.join(SHAPE_SETS)}\n")
    if message_format not in FORMATS:
        raise web.HTTPBadRequest(text=f"format must be one of {', '.join(FORMATS)}\n")
    return ShapeEncoder(shape_set, message_format) if shape_set else None


def make_avatar_encoder(meshes: Sequence[Sequence[str]], message_format: str) -> ShapeEncoder:
    """Return the encoder for an avatar with these names of shapes in each of its meshes.

    Raises ``UserError`` if the avatar cannot speak, or has too many shapes.
    """
    names = [name for mesh in meshes for name in mesh]
    if len(names) > MAX_AVATAR_SHAPES:
        raise UserError(f"the avatar has more than {MAX_AVATAR_SHAPES} shapes; send fewer")
    shape_set = choose_set(names)
    indices = {
        (number, mesh.index(name)): SHAPE_SETS[shape_set].names.index(shape)
        for number, mesh in enumerate(meshes)
        for name, shape in find_shapes(shape_set, mesh).items()
    }
    return ShapeEncoder(shape_set, message_format, tuple(indices), tuple(indices.values()))
