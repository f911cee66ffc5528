"""Programs in documents; tests run the code that readers copy."""

import re
import textwrap
from pathlib import Path


def code_blocks(document: Path, language: str) -> list[str]:
    """Return the blocks of code in a language, including those in lists."""
    blocks = re.findall(rf"```{language}\n(.*?)```", document.read_text("utf-8"), re.DOTALL)
    return [textwrap.dedent(block) for block in blocks]
