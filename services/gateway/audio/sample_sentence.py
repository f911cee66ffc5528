"""The sample sentence: a recording that the gateway plays in a separate session."""

import asyncio
import secrets
from collections.abc import Callable
from importlib import resources
from pathlib import Path

from kouxing_client import KouxingError

from kouxing.services.gateway.audio.audio_sessions import AudioClient, AudioSession, error_text
from kouxing.shared.audio.audio_file import AudioSource, open_audio
from kouxing.shared.audio.pcm import as_integers
from kouxing.shared.errors import UserError
from kouxing.shared.phones.inventory import load_inventory
from kouxing.shared.phones.syllable_captions import Characters, split_characters

SAMPLE_FILE = Path(str(resources.files("kouxing.shared") / "demo" / "hello-female.wav"))
SAMPLE_TEXT = "你好，欢迎来到口型。你听到的每一个字，都由我的脸实时说出来。"


class SampleSentence:
    """Speaks the sample sentence in real time, at most once at a time."""

    def __init__(self, audio_client: AudioClient) -> None:
        self.session = ""  # session of the sentence while it is spoken
        self.open_sessions: list[str] = []  # also those whose last frames are still shown
        self.lip_model = ""  # empty: the default; it can change while the sentence is spoken
        self.characters: Characters = ()  # known before the session starts
        self._audio_client = audio_client
        self._tasks: set[asyncio.Task[None]] = set()

    def play(self, lip_model: str, on_end: Callable[[str, str], None]) -> None:
        """Start the sentence, unless it is being spoken.

        ``on_end`` is called at the end with the session and an error message, which is empty if the
        sentence was played.
        """
        if not self.session:
            self.session = f"sample-{secrets.token_hex(4)}"
            self.open_sessions.append(self.session)
            self.lip_model = lip_model
            task = asyncio.get_running_loop().create_task(self._play(self.session, on_end))
            self._tasks.add(task)
            task.add_done_callback(self._tasks.discard)

    def stop(self) -> None:
        """End the sentence early."""
        for task in self._tasks:
            task.cancel()

    async def _play(self, name: str, on_end: Callable[[str, str], None]) -> None:
        error = ""
        try:
            if not self.characters:  # takes 0.3 s
                self.characters = await asyncio.to_thread(
                    split_characters, SAMPLE_TEXT, load_inventory()
                )
            await self._speak(name)
        except (UserError, KouxingError) as refusal:
            error = error_text(refusal)
        finally:
            self._end_speech(name)
            self.open_sessions.remove(name)
            on_end(name, error)

    def _end_speech(self, name: str) -> None:
        """Allow the next sentence to start."""
        if self.session == name:
            self.session = ""

    async def _speak(self, name: str) -> None:
        source = open_audio(SAMPLE_FILE)
        async with self._audio_client.open(
            session=name, sample_rate_hz=source.sample_rate_hz, num_channels=source.num_channels
        ) as session:
            try:
                await self._stream(source, session)
            finally:
                self._end_speech(name)

    async def _stream(self, source: AudioSource, session: AudioSession) -> None:
        """Send the audio in real time. Raises ``KouxingError`` if the session has an error."""
        loop = asyncio.get_running_loop()
        lip_model = ""
        due_s = loop.time()
        for block in [*source.blocks]:  # reads all, because only then the short file is closed
            if session.is_closed:
                break
            if lip_model != self.lip_model:
                lip_model = self.lip_model
                await session.set_face(lip_model=lip_model)
            session.send(as_integers(block).tobytes(), len(block))
            due_s += len(block) / source.sample_rate_hz
            await asyncio.sleep(due_s - loop.time())
            for error in session.take_errors():
                raise error
