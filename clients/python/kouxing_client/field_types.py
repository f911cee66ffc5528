"""The types of the fields of messages, with their ranges; PROTOCOL.md describes them."""

from typing import Annotated

from msgspec import Meta

NUM_FAPS = 68
MASK_BYTES = 9  # one bit per FAP; FAP 1 is the least significant bit of the first byte
MAX_SHAPES = 256  # per set
MAX_TEXT = 2000  # characters
MAX_ENDPOINT = 256  # characters
MAX_AUDIO_BYTES = 64 * 1024  # in one message
SESSION_NAME = "[A-Za-z0-9_-]{0,64}"  # empty: no session
NO_LINE_BREAK = r"(?!\n)"  # "$" alone also matches before a final line break


def full_match(pattern: str) -> Meta:
    """Return the rule that a regular expression matches a whole text."""
    return Meta(pattern=f"^{pattern}${NO_LINE_BREAK}")


Version = Annotated[int, Meta(ge=1, le=65535)]
SessionName = Annotated[str, full_match(SESSION_NAME)]
Name = Annotated[str, Meta(min_length=1, max_length=128)]
Text = Annotated[str, Meta(max_length=MAX_TEXT)]
Count = Annotated[int, Meta(ge=0, le=2**53)]
Samples = Annotated[int, Meta(ge=0, le=2**53)]  # at 16 kHz
Seconds = Annotated[float, Meta(ge=0)]
Milliseconds = Annotated[float, Meta(ge=0)]
Probability = Annotated[float, Meta(ge=0, le=1)]
PhoneSymbol = Annotated[str, full_match("[a-z]{1,4}")]
FapValues = Annotated[bytes, Meta(min_length=4 * NUM_FAPS, max_length=4 * NUM_FAPS)]
FapMask = Annotated[bytes, Meta(min_length=MASK_BYTES, max_length=MASK_BYTES)]
ShapeWeights = Annotated[bytes, Meta(max_length=4 * MAX_SHAPES)]
ShapeMap = Annotated[dict[Name, ShapeWeights], Meta(max_length=16)]
Endpoint = Annotated[str, Meta(max_length=MAX_ENDPOINT)]
EndpointMap = Annotated[dict[Name, Endpoint], Meta(max_length=16)]
MetricMap = Annotated[dict[Name, float], Meta(max_length=512)]  # control can have 80
Role = Annotated[str, full_match("(control|worker|observer)")]
ServiceStatus = Annotated[str, full_match("(ready|draining)")]
SessionStatus = Annotated[str, full_match("(starting|open)")]
