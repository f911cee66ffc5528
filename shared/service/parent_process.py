"""The link of a service to its parent process, if the parent restarts services.

Two environment variables describe the link. Their names start with an underscore, because they are
not settings.
"""

import contextlib
import os

PARENT_VARIABLE = "_KOUXING_SUPERVISOR"  # process id
# file descriptor of a pipe that gets a byte per heartbeat
HEARTBEAT_PIPE_VARIABLE = "_KOUXING_HEARTBEAT_PIPE"
IDLE_HEARTBEAT = b"-"  # the byte of a service that sends a heartbeat only every second
_PARENT = int(os.environ.get(PARENT_VARIABLE, "0"))  # 0: no such process


def has_exited() -> bool:
    """Return whether the process that started this one has exited."""
    return _PARENT != 0 and os.getppid() != _PARENT


def write_heartbeat(*, is_idle: bool) -> None:
    """Write the byte of a heartbeat to the pipe, if the pipe exists."""
    if pipe := os.environ.get(HEARTBEAT_PIPE_VARIABLE):
        with contextlib.suppress(OSError):  # the pipe is full, or the process has exited
            os.write(int(pipe), IDLE_HEARTBEAT if is_idle else b".")
