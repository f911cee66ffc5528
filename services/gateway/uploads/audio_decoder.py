"""Process that decodes an uploaded audio file to a 16-bit WAV file on standard output."""

import errno
import os
import resource
import sys
import wave
from pathlib import Path

from kouxing.shared.audio.audio_file import limited_blocks, open_audio
from kouxing.shared.audio.level_check import LevelCheck
from kouxing.shared.audio.pcm import as_integers
from kouxing.shared.errors import USER_ERROR, UserError

MAX_DURATION_S = 3600
MAX_CPU_S = 60
MAX_MEMORY_BYTES = 4 << 30


def storage_error(error: OSError) -> UserError:
    """Return the error for a temporary file that cannot be written."""
    is_full = error.errno in (errno.ENOSPC, errno.EDQUOT)
    reason = "the disk is full" if is_full else error.strerror or str(error)
    return UserError(
        f"the gateway cannot store the file: {reason}; free space in its temporary folder, or set"
        " TMPDIR to another folder and restart the gateway"
    )


def decode(path: Path) -> None:
    """Write a file's sound in mono, and its warnings to standard error.

    Raises ``UserError`` if the file cannot be read or is too long.
    """
    source = open_audio(path, block_s=1.0)
    level = LevelCheck()
    with wave.open(sys.stdout.buffer, "wb") as output:
        output.setparams((1, 2, source.sample_rate_hz, 0, "NONE", ""))
        for block in limited_blocks(source, MAX_DURATION_S):
            level.add(block)
            output.writeframes(as_integers(block.mean(axis=1)).tobytes())
    for warning in (*source.notices, *source.warnings, *level.warnings(str(path))):
        print(warning, file=sys.stderr)


if __name__ == "__main__":
    resource.setrlimit(resource.RLIMIT_CPU, (MAX_CPU_S, MAX_CPU_S))
    resource.setrlimit(resource.RLIMIT_AS, (MAX_MEMORY_BYTES, MAX_MEMORY_BYTES))
    try:
        decode(Path(sys.argv[1]))
    except UserError as error:
        print(error, file=sys.stderr)
        sys.exit(USER_ERROR)
    except OSError as error:
        print(storage_error(error), file=sys.stderr, flush=True)
        os._exit(USER_ERROR)  # Python would write the rest at exit, and fail
