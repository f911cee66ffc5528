"""Finds Node, which runs other lip-sync programs."""

import shutil
import sys
from pathlib import Path

from kouxing.shared.errors import UserError


def find_node() -> str:
    """Return the Node next to Python, or else on the path; UserError if there is none."""
    node = shutil.which("node", path=str(Path(sys.executable).parent)) or shutil.which("node")
    if node is None:
        raise UserError("other lip-sync programs need Node: pip install 'kouxing[page]'")
    return node
