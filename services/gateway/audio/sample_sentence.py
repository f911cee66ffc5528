"""The sample sentence: a recording that the gateway plays in a separate session."""

import asyncio
import secrets
from collections.abc import Callable
from importlib import resources
from pathlib import Path

from kouxing_client import KouxingError

from kouxing.services.gateway.audio.audio_sessions import AudioClient, error_text
from kouxing.shared.audio.audio_file import open_audio
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
        self.lip_model = ""  # empty: the default; it can change while the sentence is spoken
        self.characters: Characters = ()  # known before the session starts
        self._audio_client = audio_client
        self._task: asyncio.Task[None] | None = None

    def play(self, lip_model: str, on_end: Callable[[str, str], None]) -> None:
        """Start the sentence, unless it is playing.

        ``on_end`` is called at the end with the session and an error message, which is empty if the
        sentence was played.
        """
        if not self.session:
            self.session = f"sample-{secrets.token_hex(4)}"
            self.lip_model = lip_model
            self._task = asyncio.get_running_loop().create_task(self._play(on_end))

    def stop(self) -> None:
        """End the sentence early."""
        if self._task is not None:
            self._task.cancel()

    async def _play(self, on_end: Callable[[str, str], None]) -> None:
        error = ""
        try:
            if not self.characters:  # takes 0.3 s
                self.characters = await asyncio.to_thread(
                    split_characters, SAMPLE_TEXT, load_inventory()
                )
            await self._speak()
        except (UserError, KouxingError) as refusal:
            error = error_text(refusal)
        finally:
            session, self.session = self.session, ""
            on_end(session, error)

    async def _speak(self) -> None:
        loop = asyncio.get_running_loop()
        source = open_audio(SAMPLE_FILE)
        async with self._audio_client.open(
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
                    await session.set_face(lip_model=lip_model)
                session.send(as_integers(block).tobytes(), len(block))
                due_s += len(block) / source.sample_rate_hz
                await asyncio.sleep(due_s - loop.time())
