"""Converts letters to sounds with espeak-ng (GPL-3), which runs as a separate process."""

import shutil
import subprocess
from collections.abc import Sequence
from itertools import chain

from kouxing.shared.errors import UserError

_TIMEOUT_S = 60.0
_INSTALL = (
    "espeak-ng is missing, and texts in this language need it; install it"
    " (Debian: apt-get install espeak-ng; macOS: brew install espeak-ng)"
)


def transcribe_phrases(phrases: Sequence[Sequence[str]], voice: str) -> list[list[str]]:
    """Return the IPA of each word of each phrase; phones of more than one letter are tied.

    A word is read within its phrase, or alone if espeak-ng joins words of the phrase. A
    silent word has an empty text. ``voice`` is an espeak-ng voice.

    Raises ``UserError`` if espeak-ng is missing or fails.
    """
    together = _lines_of([" ".join(phrase) for phrase in phrases], voice)
    spoken = [
        (phrase, [line] if len(phrase) == 1 else line.split())
        for phrase, line in zip(phrases, together, strict=True)
    ]
    joined = [phrase for phrase, words in spoken if len(words) != len(phrase)]
    alone = iter(_lines_of([*chain(*joined)], voice))
    return [
        words if len(words) == len(phrase) else [next(alone) for _ in phrase]
        for phrase, words in spoken
    ]


def _lines_of(texts: Sequence[str], voice: str) -> list[str]:
    """Return the IPA of each text, which has no punctuation."""
    lines = _run(texts, voice) if texts else []
    if len(lines) == len(texts):
        return lines
    return [" ".join(_run([text], voice)) for text in texts]  # espeak-ng splits long texts


def _run(texts: Sequence[str], voice: str) -> list[str]:
    program = shutil.which("espeak-ng")
    if program is None:
        raise UserError(_INSTALL)
    command = [program, "-q", "--ipa", "--tie=\u0361", "-v", voice]
    try:
        result = subprocess.run(  # noqa: S603 - no shell
            command,
            input="\n".join(texts),
            capture_output=True,
            encoding="utf-8",
            check=True,
            timeout=_TIMEOUT_S,
        )
    except (OSError, subprocess.SubprocessError) as error:
        raise UserError(f"espeak-ng failed: {error}; reinstall it") from None
    return result.stdout.splitlines()
