"""The built-in heads, the configuration key ``head``, and the files of heads for the page."""

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from kouxing.shared.errors import UserError
from kouxing.shared.face.config import FaceConfig
from kouxing.shared.settings.config import Check, KnownNames

HEAD_NAMES = tuple(
    sorted(path.stem for path in (Path(__file__).parent / "driver/head/assets").glob("*.npz"))
)
DEFAULT_HEAD = "woman"


def page_file(name: str) -> str:
    """Return the name of the GLB file with a built-in head, as the page loads it."""
    return "head.glb" if name == DEFAULT_HEAD else f"head-{name}.glb"


def page_heads_folder() -> Path:
    """Return ``$XDG_CACHE_HOME/kouxing/heads``, by default ``~/.cache/kouxing/heads``.

    It has the page's heads of an installed package, which contains no GLB files. Raises
    ``UserError`` if the user has no home folder.
    """
    try:
        cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    except RuntimeError:
        raise UserError("this user has no home folder; set XDG_CACHE_HOME to a folder") from None
    return cache / "kouxing" / "heads"


@dataclass(frozen=True, kw_only=True)
class HeadConfig(FaceConfig):
    """The keys of services that show a head."""

    head: Annotated[
        str,
        Check(lambda name: name or DEFAULT_HEAD),  # gateway.head was once empty
        KnownNames(lambda: HEAD_NAMES, r".*\.\w+", ", or a file (.glb, .gltf, .vrm or .npz)"),
    ] = DEFAULT_HEAD
    """Head in windows, videos and the page: built in, or an avatar. A gateway without 'kouxing run'
    needs a GLB file from 'kouxing head export' instead of an avatar."""
