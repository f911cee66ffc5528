"""Sound of a session, joined to messages."""

import numpy as np
from kouxing_client.messages import Sound

from kouxing.services.recognizer.sessions.sound_packets import SoundPackets
from kouxing.shared.clock import to_seconds
from kouxing.shared.phones.events import Waveform
from kouxing.shared.wire.speech import AudioState, Progress


def messages(*starts: int, num_samples: int = 320, face_delay_s: float = 0.06) -> list[Sound]:
    """Return the messages of pieces of sound that start at these times, and of the end."""
    packets = SoundPackets(face_delay_s)
    pieces = [
        Waveform(time_s=to_seconds(start), samples=np.full(num_samples, start / 2**15, np.float32))
        for start in starts
    ]
    results: list[Waveform | Progress] = [*pieces, Progress(), Progress(state=AudioState.ENDED)]
    return [message for result in results for message in packets.add(result)]


def spans(sounds: list[Sound]) -> list[tuple[int, int]]:
    return [(sound.media_time, len(sound.pcm) // 2) for sound in sounds]


def test_joins_two_pieces_of_20_ms_and_sends_the_rest_at_the_end() -> None:
    sounds = messages(0, 320, 640)
    assert spans(sounds) == [(0, 640), (640, 320)]
    assert np.frombuffer(sounds[0].pcm, "<i2").tolist() == [0] * 320 + [320] * 320


def test_does_not_join_across_a_gap_long_pieces_or_for_a_face_without_delay() -> None:
    assert spans(messages(0, 640, 960)) == [(0, 320), (640, 640)]
    assert spans(messages(0, 800, num_samples=800)) == [(0, 800), (800, 800)]
    assert spans(messages(0, 320, face_delay_s=0.0)) == [(0, 320), (320, 320)]
