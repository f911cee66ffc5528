"""The cache folder for the page's heads, which the package does not contain as GLB files."""

import os
from pathlib import Path


def page_heads_folder() -> Path:
    """Return ``$XDG_CACHE_HOME/kouxing/heads``, by default ``~/.cache/kouxing/heads``."""
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return cache / "kouxing" / "heads"
