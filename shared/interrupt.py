"""Ends a command on Ctrl-C, even if a library drops the exception.

Python raises ``KeyboardInterrupt`` in the running code. The exception is lost if a library called
this code, for example FFmpeg to read a file, or if a module with ``except:`` is being imported. It
is therefore raised repeatedly until it is handled.
"""

import contextlib
import signal
import sys
from collections.abc import Iterator
from typing import Any

_REPEAT_S = 0.5


def install_interrupt_handler() -> None:
    """Raise ``KeyboardInterrupt`` on Ctrl-C, repeatedly until it is handled.

    Libraries that drop it print no traceback.
    """
    sys.excepthook, sys.unraisablehook = _print_error, _print_unraisable
    signal.signal(signal.SIGALRM, _repeat)
    signal.signal(signal.SIGINT, _interrupt)


def is_interrupted() -> bool:
    """Return whether an interrupt has arrived that is not yet handled."""
    return _is_installed() and signal.getitimer(signal.ITIMER_REAL)[0] > 0.0


def clear_interrupt() -> None:
    """Stop repeating the exception, because it is handled."""
    if _is_installed():
        signal.setitimer(signal.ITIMER_REAL, 0.0)


def _is_installed() -> bool:
    return signal.getsignal(signal.SIGALRM) is _repeat  # otherwise the timer belongs to other code


@contextlib.contextmanager
def catch_interrupt() -> Iterator[None]:
    """Leave the block on Ctrl-C, without an exception."""
    try:
        yield
    except KeyboardInterrupt:
        clear_interrupt()


@contextlib.contextmanager
def delay_interrupt() -> Iterator[None]:
    """Delay ``KeyboardInterrupt`` by 0.5 s, so that the block can end between two items of work.

    SIGTERM has the same effect as Ctrl-C. The block calls ``is_interrupted`` after each item, and
    raises the exception itself.
    """
    if not _is_installed():
        yield
        return
    signals = (signal.SIGINT, signal.SIGTERM)
    earlier = [signal.signal(number, _start_timer) for number in signals]
    try:
        yield
    finally:
        for number, handler in zip(signals, earlier, strict=True):
            signal.signal(number, handler)


def _print_error(kind: type[BaseException], *rest: Any) -> None:
    if not issubclass(kind, KeyboardInterrupt):
        sys.__excepthook__(kind, *rest)


def _print_unraisable(error: Any) -> None:
    if not issubclass(error.exc_type, KeyboardInterrupt):
        sys.__unraisablehook__(error)


def _start_timer(*_: object) -> None:
    signal.setitimer(signal.ITIMER_REAL, _REPEAT_S, _REPEAT_S)


def _interrupt(*_: object) -> None:
    _start_timer()
    raise KeyboardInterrupt


def _repeat(*_: object) -> None:
    error = sys.exception()
    while error is not None:
        if isinstance(error, KeyboardInterrupt):
            return  # an except or finally block is running
        error = error.__context__
    raise KeyboardInterrupt
