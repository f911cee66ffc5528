"""A stream that does not end: drift, memory and lost phones over a day of sound.

Control, a recognizer and a synthesizer serve one session that is not paced, so a day passes as fast
as they can work. Recordings are spoken round after round, in other voices, places, levels and
noise, so that no two rounds are alike. But every tenth and the one after it are the first again:
the second of these has the same before it every time, and must give the same phones. The sound
comes at 44.1 kHz, a rate that does not divide media time's 16 kHz.
"""

from __future__ import annotations

import difflib
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from kouxing.corpora.figures import new_figure
from kouxing.evaluation.system.load import SERVING, usage_of
from kouxing.evaluation.system.speakers import read_text, voiced
from kouxing.evaluation.system.systems import LocalSystem
from kouxing.shared.client import Client, Session
from kouxing.shared.clock import MEDIA_RATE_HZ
from kouxing.shared.errors import UserError
from kouxing.shared.wire.face import FapFrame
from kouxing.shared.wire.speech import Phone

RATE_HZ = 44_100
CHUNK = RATE_HZ // 25  # samples: 40 ms
SAME_EVERY = 10  # rounds
PAUSE_S = 1.6  # after each round: its phones are final then
AHEAD_S = 4.0  # of the frames that have come; what waits on the way is no growth
QUIET_S = 3.0  # without a frame, on a busy machine, too: all have come
LIMIT_S = 60.0  # without a frame, though some are owed
_GRID = 2560  # samples at 16 kHz: whole blocks of the voice detector, frames and slices


@dataclass(frozen=True, slots=True)
class Round:
    """What was seen up to the end of a round."""

    number: int
    media_s: float  # since the session's first sample
    wall_s: float  # since the same
    drift: int  # samples at 16 kHz by which frames lag more than after the first round; exactly 0
    num_irregular: int  # frames of the round not 1 / frame rate after the one before
    num_phones: int  # of the round, final
    num_unfinished: int  # of the round's phones, those left out or never final
    num_lost: int | None  # of the second round's phones, in one that is the same after the same
    memory_mb: dict[str, float]  # by service


class Listener:
    """Counts what comes out of the session."""

    def __init__(self, session: Session) -> None:
        self._output = session.subscribe(FapFrame, Phone)
        self._step = round(MEDIA_RATE_HZ / session.opened.frame_rate_hz)
        self._phones: dict[int, Phone] = {}  # of the round, by index
        self._next_index = 0
        self.newest = -self._step  # media time of the newest frame
        self.num_irregular = 0

    def wait(self, timeout_s: float) -> bool:
        """Take what comes within the time; return whether anything did."""
        any_came = self._output.wait(timeout_s)
        for received in self._output.receive():
            match received.message:
                case FapFrame(media_time=media_time):
                    self.num_irregular += media_time != self.newest + self._step
                    self.newest = media_time
                case Phone() as phone:
                    self._phones[phone.index] = phone
        return any_came

    def take_round(self) -> tuple[list[str], int, int]:
        """Return the symbols of the round's phones, how many are unfinished, irregular frames."""
        indices = sorted(self._phones)
        num_due = (indices[-1] + 1 if indices else self._next_index) - self._next_index
        final = [self._phones[index] for index in indices if self._phones[index].final]
        self._next_index += num_due
        self._phones.clear()
        num_irregular, self.num_irregular = self.num_irregular, 0
        return (
            [phone.symbol for phone in final if phone.duration],
            num_due - len(final),
            num_irregular,
        )


def measure(
    paths: Sequence[Path],
    hours: float,
    console: Console,
    on_round: Callable[[list[Round]], None] = lambda _: None,
) -> list[Round]:
    """Speak for so many hours of media time; return what was seen after each round.

    Parameters
    ----------
    paths
        Recordings that are spoken.
    hours
        Until then no round is the last.
    on_round
        Is given all rounds after each.

    Raises
    ------
    UserError
        If a file is no audio, or the services cannot start or fall silent.
    """
    text = read_text(paths)
    rounds: list[Round] = []
    with (
        tempfile.TemporaryDirectory() as folder,
        LocalSystem(Path(folder), console, services=SERVING) as system,
        Client(system.control) as client,
    ):
        session = client.open_session(sample_rate_hz=RATE_HZ, paced=False)
        listener = Listener(session)
        begin_s, lag = time.monotonic(), None
        second: list[str] = []
        while not rounds or rounds[-1].media_s < hours * 3600:
            number = len(rounds)
            _speak(session, listener, sound_of(text, number))
            _wait_for_frames(session, listener, lag)
            lag = session.media_time - listener.newest if lag is None else lag
            symbols, num_unfinished, num_irregular = listener.take_round()
            is_compared = number % SAME_EVERY == 1
            if is_compared:
                second = second or symbols
            rounds.append(
                Round(
                    number=number,
                    media_s=session.media_time / MEDIA_RATE_HZ,
                    wall_s=time.monotonic() - begin_s,
                    drift=session.media_time - listener.newest - lag,
                    num_irregular=num_irregular,
                    num_phones=len(symbols),
                    num_unfinished=num_unfinished,
                    num_lost=lost_phones(second, symbols) if is_compared else None,
                    memory_mb={
                        service: usage.memory_mb for service, usage in usage_of(client).items()
                    },
                )
            )
            on_round(rounds)
        session.close()
    return rounds


def sound_of(text: NDArray[np.float32], number: int) -> NDArray[np.int16]:
    """Return what is spoken in a round, at 44.1 kHz, shape (n,)."""
    rng = np.random.default_rng(number)
    sound = text
    if number % SAME_EVERY > 1:
        level = 10 ** rng.uniform(-0.6, 0.1)  # -12 to 2 dB
        noise = rng.normal(scale=10 ** rng.uniform(-4.0, -2.5), size=len(text))
        sound = np.clip(level * np.resize(voiced(text, number), len(text)) + noise, -1.0, 1.0)
    length = -(-(len(sound) + round(PAUSE_S * MEDIA_RATE_HZ)) // _GRID) * _GRID
    at = np.arange(length * RATE_HZ // MEDIA_RATE_HZ) * (MEDIA_RATE_HZ / RATE_HZ)
    samples: NDArray[np.int16] = (
        np.interp(at, np.arange(length), np.pad(sound, (0, length - len(sound)))) * 32767
    ).astype(np.int16)
    return samples


def _speak(session: Session, listener: Listener, sound: NDArray[np.int16]) -> None:
    for begin in range(0, len(sound), CHUNK):
        chunk = sound[begin : begin + CHUNK]
        _wait_until(
            lambda: session.media_time - listener.newest < AHEAD_S * MEDIA_RATE_HZ, listener
        )
        _wait_until(lambda chunk=chunk: session.send(chunk), listener)  # type: ignore[misc]
        for error in session.errors():
            raise UserError(f"{error.code}: {error.text}")


def _wait_for_frames(session: Session, listener: Listener, lag: int | None) -> None:
    """Wait for the frames of all that was spoken; the first time until no more come."""
    end_s = time.monotonic() + LIMIT_S
    if lag is None:
        while listener.wait(QUIET_S):
            pass
    while lag is not None and session.media_time - listener.newest > lag:
        if listener.wait(0.1):
            end_s = time.monotonic() + LIMIT_S
        elif time.monotonic() > end_s:  # what is missing counts as drift
            return


def _wait_until(condition: Callable[[], bool], listener: Listener) -> None:
    end_s = time.monotonic() + LIMIT_S
    while not condition():
        if listener.wait(0.05):
            end_s = time.monotonic() + LIMIT_S
        elif time.monotonic() > end_s:
            raise UserError("the services take no more sound")
    listener.wait(0.0)


def lost_phones(before: Sequence[str], symbols: Sequence[str]) -> int:
    """Return how many phones of a round before did not come again in their order."""
    blocks = difflib.SequenceMatcher(None, before, symbols, autojunk=False).get_matching_blocks()
    return len(before) - sum(block.size for block in blocks)


def summary(rounds: Sequence[Round]) -> dict[str, float]:
    """Return what the rounds come to; growth is from the end of the first quarter, per hour."""
    last = rounds[-1]
    quarter = rounds[len(rounds) // 4]
    hours = max(last.media_s - quarter.media_s, 1e-3) / 3600
    return {
        "hours": last.media_s / 3600,
        "times_real_time": last.media_s / last.wall_s,
        "largest_drift": float(max(abs(each.drift) for each in rounds)),
        "irregular_frames": float(sum(each.num_irregular for each in rounds)),
        "phones": float(sum(each.num_phones for each in rounds)),
        "unfinished_phones": float(sum(each.num_unfinished for each in rounds)),
        "lost_phones": float(sum(each.num_lost or 0 for each in rounds)),
        **{
            f"{service}_mb_per_hour": (memory_mb - quarter.memory_mb[service]) / hours
            for service, memory_mb in last.memory_mb.items()
        },
    }


def show(rounds: Sequence[Round], console: Console) -> None:
    """Print some of the rounds as a table, and what all come to."""
    services = list(rounds[0].memory_mb)
    table = Table(
        "hours", "times real time", "drift", "irregular", "phones", "unfinished", "lost",
        *(f"{service} MB" for service in services),
    )  # fmt: skip
    for number in sorted({*np.linspace(0, len(rounds) - 1, 12, dtype=int).tolist()}):
        each = rounds[number]
        table.add_row(
            f"{each.media_s / 3600:.2f}",
            f"{each.media_s / each.wall_s:.1f}",
            str(each.drift),
            str(each.num_irregular),
            str(each.num_phones),
            str(each.num_unfinished),
            "" if each.num_lost is None else str(each.num_lost),
            *(f"{each.memory_mb[service]:.1f}" for service in services),
        )
    console.print(table)
    for name, value in summary(rounds).items():
        console.print(f"{name.replace('_', ' ')}: {value:.4g}")


def draw(rounds: Sequence[Round]) -> Any:
    """Draw memory, drift and what was lost over the hours; return the figure."""
    hours = [each.media_s / 3600 for each in rounds]
    figure = new_figure(11.0, 4.0)
    memory, lost = figure.subplots(1, 2)
    for service in rounds[0].memory_mb:
        memory.plot(hours, [each.memory_mb[service] for each in rounds], label=service)
    memory.set_ylabel("memory, MB")
    memory.set_ylim(bottom=0)
    lost.plot(hours, [each.drift for each in rounds], label="drift, samples at 16 kHz")
    for label, values in (
        ("irregular frames", [each.num_irregular for each in rounds]),
        ("unfinished phones", [each.num_unfinished for each in rounds]),
        ("lost phones", [each.num_lost or 0 for each in rounds]),
    ):
        lost.plot(hours, np.cumsum(values), label=f"{label}, in all")
    for axes in (memory, lost):
        axes.set_xlabel("hours of sound")
        axes.grid(alpha=0.3)
        axes.legend(fontsize=8)
    return figure
