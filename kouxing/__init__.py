"""kouxing: live speech in, a talking 3-D face out.

The links in this folder map the repository's top-level folders to one import package.
"""

import os
from pathlib import Path


def _choose_numba_folder() -> None:
    """Set a temporary cache folder for numba if no permanent one is writable.

    Otherwise numba raises an error, for example for a user without a home folder if the
    installation is read-only.
    """
    cache = Path(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~"))  # noqa: PTH111 (no error)
    existing = next(folder for folder in (cache, *cache.absolute().parents) if folder.exists())
    if "NUMBA_CACHE_DIR" in os.environ or any(
        os.access(folder, os.W_OK) for folder in (Path(__file__).parent, existing)
    ):
        return
    import atexit  # noqa: PLC0415 (rarely needed)
    import shutil  # noqa: PLC0415
    import tempfile  # noqa: PLC0415

    os.environ["NUMBA_CACHE_DIR"] = tempfile.mkdtemp(prefix="kouxing-")
    atexit.register(shutil.rmtree, os.environ["NUMBA_CACHE_DIR"], ignore_errors=True)


_choose_numba_folder()
