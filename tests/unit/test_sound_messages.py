"""Sound of a session, joined to messages."""

import numpy as np
from kouxing_client.messages import Sound

from kouxing.services.recognizer.sessions.sound_messages import SoundMessages
from kouxing.shared.clock import to_seconds
from kouxing.shared.phones.events import Waveform
from kouxing.shared.wire.speech import AudioState, Progress


def messages(*starts: int, num_samples: int = 320, face_delay_s: float = 0.06) -> list[Sound]:
    """Return the messages of chunks of sound that start at these times, and of the end."""
    joined = SoundMessages(face_delay_s)
    chunks = [
        Waveform(time_s=to_seconds(start), samples=np.full(num_samples, start / 2**15, np.float32))
        for start in starts
    ]
    results: list[Waveform | Progress] = [*chunks, Progress(), Progress(state=AudioState.ENDED)]
    return [message for result in results for message in joined.add(result)]


def spans(sounds: list[Sound]) -> list[tuple[int, int]]:
    return [(sound.media_time, len(sound.pcm) // 2) for sound in sounds]


def test_joins_two_chunks_of_20_ms_and_sends_the_rest_at_the_end() -> None:
    sounds = messages(0, 320, 640)
    assert spans(sounds) == [(0, 640), (640, 320)]
    assert np.frombuffer(sounds[0].pcm, "<i2").tolist() == [0] * 320 + [320] * 320


def test_joins_only_adjacent_short_chunks_of_a_delayed_face() -> None:
    assert spans(messages(0, 640, 960)) == [(0, 320), (640, 640)]
    assert spans(messages(0, 800, num_samples=800)) == [(0, 800), (800, 800)]
    assert spans(messages(0, 320, face_delay_s=0.0)) == [(0, 320), (320, 320)]
