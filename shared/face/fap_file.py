"""Reads and writes MPEG-4 ``.fap`` text files, version 2.1, as Xface and Greta do.

The first line is ``2.1 NAME FPS NFRAMES``; NAME may contain spaces. Each frame has two lines: a
mask of 68 digits, then the frame number and one value for each 1 in the mask. Lines that start with
``#`` are comments. The reader also accepts these variants:

- Greta's mask has a 69th digit, and its FAP 1 has one number instead of four (FAP 2: six).
- The digits of a mask may be joined.
- Values may be ``inf`` or ``nan``, which count as 0.
- A file may set only the inner or only the outer lips; the others then follow.

FAP 1 is ``viseme_select1 viseme_select2 viseme_blend viseme_def`` and FAP 2 ``expression_select1
expression_intensity1 expression_select2 expression_intensity2 init_face expression_def`` (ISO/IEC
14496-2, annex C). A single number selects one viseme or expression at full strength.
"""

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from kouxing.shared.arrays import Floats, Integers, Mask
from kouxing.shared.errors import UserError
from kouxing.shared.face.faps import NUM_FAPS
from kouxing.shared.files.output_file import open_output, path_as_text
from kouxing.shared.files.user_file import read_file, split_lines

_VERSION = "2.1"
MAX_BYTES = 256 << 20  # several hours
MAX_FRAMES = 1_000_000
_GRETA_MASK_DIGITS = NUM_FAPS + 1
# Maximum of each number of FAP 1 and FAP 2. The flags at the end have no meaning for a head with
# given shapes, and programs write any value there.
_ANY = 2**31
_VISEME_LIMITS = (14, 14, 63, _ANY)
_EXPRESSION_LIMITS = (6, 63, 6, 63, _ANY, _ANY)
# numbers that follow a selection by itself
_VISEME_ALONE = (0, 63, 0)
_EXPRESSION_ALONE = (63, 0, 0, 0, 0)
_LIP_PAIRS = dict(zip(range(4, 14), range(51, 61), strict=True))  # inner and outer lip FAPs


@dataclass(frozen=True, slots=True)
class FapAnimation:
    """FAP frames at a constant rate."""

    name: str
    frame_rate_hz: float
    faps: Floats  # (num_frames, 68), FAP units; FAP 1 and 2 hold the first selection
    visemes: Integers | None = None  # (num_frames, 4), the numbers of FAP 1; None if unset
    expressions: Integers | None = None  # (num_frames, 6), the numbers of FAP 2
    start_s: float = 0.0  # time of the first frame in the session


def read_fap(path: Path) -> FapAnimation:
    """Read a ``.fap`` file.

    Raises ``UserError`` if the file cannot be read or is not a valid ``.fap`` file; the text names
    the line.
    """
    text = read_file(path, MAX_BYTES).decode("utf-8-sig", "replace")
    number = 1  # of the line that is parsed
    try:
        lines = _lines(path, text)
        number, line = next(lines, (1, ""))
        name, frame_rate_hz, num_frames = _parse_header(line.split())
        num_lines = 0
        for number, _ in lines:  # noqa: B007 - an error names it
            num_lines += 1
            if num_lines > 2 * num_frames:
                raise ValueError(f"more frames than the header states: {num_frames}")
        if num_lines < 2 * num_frames:
            raise ValueError(f"the file ends after {num_lines // 2} of {num_frames} frames")
        lines = itertools.islice(_lines(path, text), 1, None)
        faps = np.zeros((num_frames, NUM_FAPS), dtype=np.float32)
        visemes = np.zeros((num_frames, len(_VISEME_LIMITS)), dtype=np.int64)
        expressions = np.zeros((num_frames, len(_EXPRESSION_LIMITS)), dtype=np.int64)
        used = np.zeros(NUM_FAPS, dtype=bool)
        first: int | None = None  # number of the first frame
        for frame in range(num_frames):
            number, line = next(lines)
            mask = _parse_mask(line)
            number, line = next(lines)
            words = line.split()
            visemes[frame], expressions[frame], values = _parse_values(words, mask)
            faps[frame, 2:][mask[2:]] = values
            written = _parse_int(words[0], "a frame number")
            first = written if first is None else first
            if written != first + frame:
                raise ValueError(f"found frame {written}, expected frame {first + frame}")
            used |= mask
    except ValueError as error:
        raise UserError(
            f"{path}, line {number}: {error}; use a .fap file of version {_VERSION}"
        ) from error
    faps[:, 0], faps[:, 1] = visemes[:, 0], expressions[:, 0]
    _complete_lips(faps, used)
    used_visemes, used_expressions = visemes if used[0] else None, expressions if used[1] else None
    return FapAnimation(name, frame_rate_hz, faps, used_visemes, used_expressions)


def _complete_lips(faps: Floats, used: Mask) -> None:
    """Copy the FAPs of the inner lips to the outer lips, or vice versa, if a file lacks one."""
    for inner, outer in _LIP_PAIRS.items():
        if used[inner - 1] and not used[outer - 1]:
            faps[:, outer - 1] = faps[:, inner - 1]
        elif used[outer - 1] and not used[inner - 1]:
            faps[:, inner - 1] = faps[:, outer - 1]


def write_fap(path: Path, animation: FapAnimation) -> None:
    """Write a ``.fap`` file in Xface's style.

    Raises ``UserError`` if the file cannot be written.
    """
    visemes, expressions = animation.visemes, animation.expressions
    low = animation.faps[:, 2:]
    # nine digits represent every float32 exactly
    rows = [[f"{value:.9g}" for value in row] for row in low]
    for high in (expressions, visemes):
        if high is not None:
            rows = [[*map(str, numbers), *row] for numbers, row in zip(high, rows, strict=True)]
    digits = [str(int(high is not None)) for high in (visemes, expressions)]
    mask = " ".join([*digits, *["1"] * 66])
    name = " ".join(path_as_text(animation.name).split()) or "kouxing"
    lines = [f"{_VERSION} {name} {animation.frame_rate_hz:.10g} {len(low)}"]
    for number, row in enumerate(rows):
        lines += [mask, f"{number} {' '.join(row)}"]
    with open_output(path) as file:
        file.write(("\n".join(lines) + "\n").encode())


def _lines(path: Path, text: str) -> Iterator[tuple[int, str]]:
    """Yield line numbers and lines, without empty lines and comments."""
    for number, line in enumerate(split_lines(path, text), start=1):
        if line.strip() and not line.lstrip().startswith("#"):
            yield number, line


def _parse_header(words: list[str]) -> tuple[str, float, int]:
    if not words or words[0] != _VERSION:
        actual = f"version '{words[0]}'" if words else "nothing"
        raise ValueError(f"expected '{_VERSION} NAME FPS NFRAMES', found {actual}")
    if len(words) < 4:
        raise ValueError(f"expected '{_VERSION} NAME FPS NFRAMES'")
    try:
        frame_rate_hz = float(words[-2])
    except ValueError:
        frame_rate_hz = math.nan
    if not 1.0 <= frame_rate_hz <= 1000.0:
        raise ValueError(f"frame rate '{words[-2]}' is not between 1 and 1000")
    num_frames = _parse_int(words[-1], "a number of frames")
    if num_frames < 0:
        raise ValueError(f"the number of frames is {num_frames}")
    if num_frames > MAX_FRAMES:
        raise ValueError(f"more than {MAX_FRAMES} frames; split the file")
    return " ".join(words[1:-2]), frame_rate_hz, num_frames


def _parse_int(word: str, description: str) -> int:
    try:
        return int(word)
    except ValueError:
        raise ValueError(f"'{word}' is not {description}") from None


def _parse_mask(line: str) -> Mask:
    digits = "".join(line.split())
    if len(digits) not in (NUM_FAPS, _GRETA_MASK_DIGITS) or set(digits) - {"0", "1"}:
        raise ValueError(
            f"expected a mask of {NUM_FAPS} (Greta: {_GRETA_MASK_DIGITS}) digits 0 or 1"
        )
    if digits[NUM_FAPS:] == "1":
        raise ValueError("the mask sets a 69th FAP; the standard has only 68")
    return np.array([digit == "1" for digit in digits[:NUM_FAPS]])


def _parse_values(words: list[str], mask: Mask) -> tuple[list[int], list[int], Floats]:
    """Return the numbers of FAP 1 (4) and FAP 2 (6), and the other values in the mask.

    The first word is the number of the frame.
    """
    try:
        values = [float(word) for word in words[1:]]
    except ValueError:
        raise ValueError("a value is not a number") from None
    # the length of the line shows how many numbers FAP 1 and 2 have
    for num_viseme in (len(_VISEME_LIMITS), 1) if mask[0] else (0,):
        for num_expression in (len(_EXPRESSION_LIMITS), 1) if mask[1] else (0,):
            high = num_viseme + num_expression
            if len(values) == high + int(mask[2:].sum()):
                low = np.array(values[high:], dtype=np.float64)
                sane = np.where(np.abs(low) <= np.finfo(np.float32).max, low, 0.0)
                return (
                    _parse_high(1, values[:num_viseme], _VISEME_LIMITS),
                    _parse_high(2, values[num_viseme:high], _EXPRESSION_LIMITS),
                    sane.astype(np.float32),
                )
    raise ValueError(f"found {len(values)} values, but the mask sets {int(mask.sum())} FAPs")


def _parse_high(fap: int, numbers: list[float], limits: tuple[int, ...]) -> list[int]:
    if not numbers:
        return [0] * len(limits)
    if len(numbers) == 1:
        numbers = [*numbers, *(_VISEME_ALONE if fap == 1 else _EXPRESSION_ALONE)]
    for value, limit in zip(numbers, limits, strict=True):
        if not (0 <= value <= limit and value == int(value)):
            raise ValueError(f"FAP {fap} is {value:g}; it must be an integer from 0 to {limit}")
    return [int(value) for value in numbers]
