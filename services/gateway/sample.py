"""The sample sentence: a recording that the gateway speaks in a session of its own."""

import asyncio
import secrets
from importlib import resources
from pathlib import Path

from kouxing.services.gateway.audio_sessions import AudioSessions
from kouxing.shared.audio_file import open_audio

SAMPLE_FILE = Path(str(resources.files("kouxing.shared") / "demo" / "hello-female.wav"))
SAMPLE_TEXT = "你好，欢迎来到口型。你听到的每一个字，都由我的脸实时说出来。"


class Sample:
    """One playback of the sample sentence.

    ``lip_model`` is empty for the system's default. It can be changed during playback.
    """

    def __init__(self, audio_sessions: AudioSessions, lip_model: str) -> None:
        self.session = f"sample-{secrets.token_hex(4)}"
        self.lip_model = lip_model
        self._audio_sessions = audio_sessions

    async def speak(self) -> None:
        """Speak the sentence in real time.

        Raises ``KouxingError`` if no session can be opened.
        """
        loop = asyncio.get_running_loop()
        source = open_audio(SAMPLE_FILE)
        async with self._audio_sessions.open(
            session=self.session,
            sample_rate_hz=source.sample_rate_hz,
            num_channels=source.num_channels,
        ) as session:
            lip_model = ""
            due_s = loop.time()
            for block in source.blocks:
                if session.is_closed:
                    break
                if lip_model != self.lip_model:
                    lip_model = self.lip_model
                    await session.set_lip_model(lip_model)
                session.send((block * 32767).astype("<i2").tobytes(), len(block))
                due_s += len(block) / source.sample_rate_hz
                await asyncio.sleep(due_s - loop.time())
