"""A PulseAudio server without a loudspeaker."""

import contextlib
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.system import LIMIT_S, wait_until

_COMMAND = (
    *"pulseaudio -n --daemonize=no --exit-idle-time=-1 --use-pid-file=no --disable-shm=yes".split(),
    *("-L", "module-null-sink sink_properties=device.description=Loudspeaker"),
    *("-L", "module-native-protocol-unix"),
)


@contextlib.contextmanager
def sound_server(folder: Path) -> Iterator[None]:
    """Run the server for this process and its children, with its files in a folder."""
    quiet = subprocess.DEVNULL
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("HOME", str(folder))
        patch.setenv("XDG_RUNTIME_DIR", str(folder))
        server = subprocess.Popen(_COMMAND, stderr=quiet)
        try:
            info = ["pactl", "info"]
            wait_until(lambda: subprocess.call(info, stdout=quiet, stderr=quiet) == 0)
            yield
        finally:
            server.terminate()
            server.wait(LIMIT_S)
