"""Frames as weights of shapes, in the form in which a viewer wants them."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass

import msgpack
import numpy as np

from kouxing.services.gateway import wire
from kouxing.shared.errors import UserError
from kouxing.shared.face.shapes import SHAPE_SETS

FORMATS = ("binary", "json", "msgpack")
_TYPES = {"weights": wire.SHAPES_TYPE, "rest": wire.REST_SHAPES_TYPE}


@dataclass(frozen=True, slots=True)
class ShapeView:
    """What a viewer asked for."""

    name: str  # of the set
    form: str  # of FORMATS

    def hello(self) -> str:
        """Return the message that names the shapes, in the order of binary weights."""
        return wire.text("shapes", set=self.name, names=SHAPE_SETS[self.name].names)

    def message(self, kind: str, epoch: int, media_time: int, faps: bytes) -> str | bytes:
        """Return a frame.

        Parameters
        ----------
        kind
            "weights" of a session, or of the face at "rest".
        epoch, media_time
            Those of the FAP frame; 0 at rest.
        faps
            68 little-endian float32.
        """
        shapes = SHAPE_SETS[self.name]
        weights = shapes.weights(np.frombuffer(faps, "<f4"))
        if self.form == "binary":
            return wire.binary(_TYPES[kind], epoch, media_time, weights.astype("<f4").tobytes())
        fields = {
            "type": kind,
            "set": self.name,
            "epoch": epoch,
            "media_time": media_time,
            "weights": {
                name: round(float(weight), 4)
                for name, weight in zip(shapes.names, weights, strict=True)
            },
        }
        if self.form == "json":
            return json.dumps(fields)
        packed: bytes = msgpack.packb(fields)
        return packed


def parse_shape_view(query: Mapping[str, str]) -> ShapeView | None:
    """Return the shapes that the query of an address asks for; None if it asks for none.

    Raises
    ------
    UserError
        If there is no such set or format.
    """
    name, form = query.get("shapes", ""), query.get("format", FORMATS[0])
    if name and name not in SHAPE_SETS:
        raise UserError(f"shapes: one of {', '.join(SHAPE_SETS)}")
    if form not in FORMATS:
        raise UserError(f"format: one of {', '.join(FORMATS)}")
    return ShapeView(name, form) if name else None
