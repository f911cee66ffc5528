"""Phones told as vosk-server tells words."""

from __future__ import annotations

import pytest

from kouxing.services.gateway.vosk import Utterances
from kouxing.shared.phones.events import Phone

pytestmark = pytest.mark.unit


def phone(index: int, symbol: str, onset_s: float, *, final: bool = True) -> Phone:
    return Phone(
        index=index, symbol=symbol, onset_s=onset_s, duration_s=0.1, confidence=0.9, final=final
    )


def symbols(phones: list[Phone]) -> str:
    return " ".join(phone.symbol for phone in phones)


def test_an_utterance_is_told_once_when_it_is_over() -> None:
    said = Utterances()
    said.hear(active=True)
    said.accept(phone(0, "n", 0.1, final=False), is_silence=False)
    said.accept(phone(1, "i", 0.2, final=False), is_silence=False)
    assert (said.text, said.take()) == ("n i", [])
    said.accept(phone(0, "m", 0.1), is_silence=False)  # revised
    said.hear(active=False)
    assert (said.text, said.take()) == ("m i", [])  # one is not final yet
    said.accept(phone(1, "i", 0.2), is_silence=False)
    said.accept(phone(2, "sil", 0.3), is_silence=True)
    assert symbols(said.take()) == "m i"
    assert (said.text, said.take()) == ("", [])


def test_a_phone_may_be_withdrawn() -> None:
    said = Utterances()
    said.accept(phone(0, "n", 0.1, final=False), is_silence=False)
    said.accept(phone(0, "sil", 0.1), is_silence=True)
    assert said.text == ""


def test_speech_without_a_pause_is_told_as_far_as_it_is_final() -> None:
    said = Utterances()
    said.hear(active=True)
    for index in range(30):
        said.accept(phone(index, "a", float(index), final=index < 29), is_silence=False)
    assert len(said.take()) == 29
    assert (said.text, said.take()) == ("a", [])


def test_after_a_restart_what_is_final_stays_and_indices_count_anew() -> None:
    said = Utterances()
    said.accept(phone(0, "n", 0.1), is_silence=False)
    said.accept(phone(1, "i", 0.2, final=False), is_silence=False)
    said.restart()
    said.accept(phone(0, "e", 0.2), is_silence=False)
    assert symbols(said.take_all()) == "n e"


def test_what_was_told_before_it_was_final_is_not_told_again() -> None:
    said = Utterances()
    said.hear(active=True)
    said.accept(phone(0, "n", 0.1), is_silence=False)
    said.accept(phone(1, "i", 0.2, final=False), is_silence=False)
    assert symbols(said.take_all()) == "n i"
    said.accept(phone(1, "e", 0.2), is_silence=False)
    said.accept(phone(2, "h", 0.3), is_silence=False)
    assert symbols(said.take_all()) == "h"
    assert said.take_all() == []
    said.restart()
    said.accept(phone(0, "ao", 0.4), is_silence=False)
    assert symbols(said.take_all()) == "ao"
