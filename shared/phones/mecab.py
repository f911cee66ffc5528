"""Splits Japanese into words with their readings, with MeCab as a separate process.

wetext converts numbers to Chinese characters first.
"""

import shutil
import subprocess
from collections.abc import Sequence

from kouxing.shared.errors import UserError

_TIMEOUT_S = 60.0
_INSTALL = (
    "mecab is missing, and Japanese texts with Chinese characters need it; write kana, or install"
    " it (Debian: apt-get install mecab mecab-ipadic-utf8; macOS: brew install mecab mecab-ipadic)"
)
_FORMATS = (r"--node-format=%m\t%f[8]\n", r"--unk-format=%m\t\n", r"--eos-format=\n")


def has_mecab() -> bool:
    """Return whether MeCab is installed."""
    return shutil.which("mecab") is not None


def split_words(texts: Sequence[str]) -> list[list[tuple[str, str]]]:
    """Return the words of each text, each with its pronunciation in kana.

    If the pronunciation of a word is unknown, the word replaces it. Texts have no line breaks.
    Raises ``UserError`` if MeCab or its dictionary IPADIC is missing.
    """
    program = shutil.which("mecab")
    if program is None:
        raise UserError(_INSTALL)
    try:
        result = subprocess.run(  # noqa: S603 - no shell
            [program, *_FORMATS],
            input="".join(f"{text}\n" for text in texts),
            capture_output=True,
            encoding="utf-8",
            check=True,
            timeout=_TIMEOUT_S,
        )
    except (OSError, UnicodeError, subprocess.SubprocessError) as error:
        raise UserError(f"mecab failed: {error}; install mecab-ipadic-utf8") from None
    parts = result.stdout.split("\n\n")[: len(texts)]
    rows = [[line.partition("\t") for line in part.splitlines() if line] for part in parts]
    return [[(word, spoken or word) for word, _, spoken in row] for row in rows]


def read_numbers(numbers: Sequence[str]) -> list[str]:
    """Return the kana of each number with its sign and counter, such as 3時 or -5度.

    Raises ``UserError`` like ``split_words``.
    """
    from wetext import Normalizer  # noqa: PLC0415 (takes 0.3 s)

    normalize = Normalizer(lang="ja", operator="tn").normalize
    return [
        "".join(spoken for _, spoken in words) for words in split_words([*map(normalize, numbers)])
    ]
