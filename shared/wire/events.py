"""Converts a recognizer's events to messages and back.

The recognizer service converts its results once, and the synthesizer service converts them back.
``shared/phones/events.py`` explains why there are two types.
"""

from collections.abc import Sequence
from operator import attrgetter
from typing import TypeAlias

import numpy as np
from kouxing_client.messages import Message, Phone, Speech

from kouxing.shared.clock import duration_to_samples, to_samples, to_seconds
from kouxing.shared.phones import events
from kouxing.shared.wire.speech import AudioState, LipPositions, Progress, Results

SpeechMessage: TypeAlias = Phone | LipPositions | Speech | Progress  # the parts of `results`


def is_state_report(message: Message) -> bool:
    """Return whether a message only reports the state of the client or another synthesizer."""
    return isinstance(message, Progress) and (
        message.newest_frame is not None
        or message.state in (AudioState.STALLED, AudioState.RESUMED)
    )


def batch_messages(messages: Sequence[Message]) -> Results:
    """Return one message with these messages of a session, at most ``MAX_BATCHED_MESSAGES``."""
    return Results(
        session=messages[0].session,
        epoch=messages[0].epoch,
        phones=[message for message in messages if isinstance(message, Phone)],
        lip_positions=[message for message in messages if isinstance(message, LipPositions)],
        speech=[message for message in messages if isinstance(message, Speech)],
        progress=[message for message in messages if isinstance(message, Progress)],
    )


def split_batch(results: Results) -> list[SpeechMessage]:
    """Return the messages of a batch in order."""
    messages: list[SpeechMessage] = [*results.phones, *results.lip_positions]
    messages += [*results.speech, *results.progress]
    return sorted(messages, key=attrgetter("sequence"))


def event_to_message(event: events.SoundEvent) -> SpeechMessage:
    """Return the message of an event; the sender sets session, epoch and sequence."""
    match event:
        case events.Phone():
            return Phone(
                media_time=to_samples(event.onset_s),
                index=event.index,
                symbol=event.symbol,
                duration=to_samples(event.duration_s),
                confidence=event.confidence,
                final=event.final,
            )
        case events.LipPositions():
            return LipPositions(
                media_time=to_samples(event.time_s),
                values=event.faps.astype("<f4").tobytes(),
                delay_samples=duration_to_samples(event.delay_s),
                closure=event.closure,
                lip_to_teeth=event.lip_to_teeth,
            )
        case events.SpeechChange():
            return Speech(media_time=to_samples(event.time_s), active=event.active)
        case events.Progress():
            return Progress(
                media_time=to_samples(event.time_s),
                level_db=event.level_db,
                zero_crossing_rate=event.zero_crossing_rate,
                pitch_hz=event.pitch_hz or None,
                arousal=event.arousal,
                valence=event.valence,
                laughter=event.is_laughter,
                breath=event.is_breath,
            )
        case events.AudioSkipped():
            return Progress(media_time=to_samples(event.time_s), state=AudioState.SKIPPED)
        case events.EndOfSound():
            return Progress(media_time=to_samples(event.time_s), state=AudioState.ENDED)


def message_to_event(message: SpeechMessage) -> events.SoundEvent:
    """Return the event in a message."""
    time_s = to_seconds(message.media_time)
    match message:
        case Phone():
            return events.Phone.from_message(message)
        case LipPositions():
            return events.LipPositions(
                time_s=time_s,
                delay_s=to_seconds(message.delay_samples),
                faps=np.frombuffer(message.values, "<f4"),
                closure=message.closure,
                lip_to_teeth=message.lip_to_teeth,
            )
        case Speech():
            return events.SpeechChange(active=message.active, time_s=time_s)
        case Progress(state=AudioState.SKIPPED):
            return events.AudioSkipped(time_s=time_s)
        case Progress(state=AudioState.ENDED):
            return events.EndOfSound(time_s=time_s)
        case Progress():
            return events.Progress(
                time_s=time_s,
                level_db=message.level_db,
                zero_crossing_rate=message.zero_crossing_rate,
                pitch_hz=message.pitch_hz or 0.0,
                arousal=message.arousal,
                valence=message.valence,
                is_laughter=message.laughter,
                is_breath=message.breath,
            )
