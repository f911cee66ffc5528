"""Messages that are cut, mixed and damaged again and again: refused, or read the same twice."""

from __future__ import annotations

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import Bundle, RuleBasedStateMachine, rule

from kouxing.shared.wire.codec import BadMessage, decode, encode
from kouxing.shared.wire.message import Message
from tests.samples import SAMPLES

pytestmark = pytest.mark.property

Parts = tuple[bytes, ...]
PLACES = st.floats(0, 1, exclude_max=True)  # of a part's length


def at(place: float, part: bytes) -> int:
    return int(place * len(part))


class Damage(RuleBasedStateMachine):
    parts = Bundle("parts")

    @rule(target=parts, message=st.sampled_from(SAMPLES))
    def send(self, message: Message) -> Parts:
        return tuple(encode(message))

    @rule(target=parts, before=parts, place=PLACES, byte=st.binary(min_size=1, max_size=1))
    def change_a_byte(self, before: Parts, place: float, byte: bytes) -> Parts:
        *head, body = before
        position = at(place, body)
        return (*head, body[:position] + byte + body[position + 1 :])

    @rule(target=parts, before=parts, place=PLACES)
    def cut(self, before: Parts, place: float) -> Parts:
        return (*before[:-1], before[-1][: at(place, before[-1])])

    @rule(target=parts, before=parts, other=parts, place=PLACES)
    def put_into_another(self, before: Parts, other: Parts, place: float) -> Parts:
        *head, body = before
        position = at(place, body)
        return (*head, body[:position] + other[-1] + body[position:])

    @rule(target=parts, before=parts, other=parts)
    def exchange_topics(self, before: Parts, other: Parts) -> Parts:
        return (*other[:-1], before[-1])

    @rule(target=parts, before=parts, other=parts)
    def join(self, before: Parts, other: Parts) -> Parts:
        return (*before, *other)[:4]

    @rule(target=parts, depth=st.integers(1, 60_000), before=parts)
    def nest(self, depth: int, before: Parts) -> Parts:
        return (*before[:-1], b"\x81\xa1x" * depth)

    @rule(parts=parts)
    def read(self, parts: Parts) -> None:
        try:
            message = decode(parts)
        except BadMessage:
            return
        again = encode(message)
        assert encode(decode(again)) == again


Damage.TestCase.settings = settings(max_examples=100, stateful_step_count=30)
TestDamage = Damage.TestCase
