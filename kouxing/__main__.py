"""Runs the command line, as ``kouxing`` or ``python -m kouxing``, and ``kouxing-rhubarb``.

Ctrl-C during slow imports ends the command without a traceback.
"""

import gc
import signal


def main() -> None:
    """Run the command line."""
    gc.disable()  # during imports, collection frees nothing and takes 1/6 of the startup time
    interrupt = signal.signal(signal.SIGINT, signal.SIG_DFL)
    from kouxing.shared.interrupt import install_interrupt_handler

    if interrupt is signal.default_int_handler:  # not in a shell's background
        install_interrupt_handler()
        interrupt = signal.signal(signal.SIGINT, signal.SIG_DFL)
    from kouxing.services.cli.main import main as run_command_line

    signal.signal(signal.SIGINT, interrupt)
    gc.freeze()  # imported modules stay in memory
    gc.enable()
    signal.signal(signal.SIGPIPE, signal.SIG_DFL)  # as in `kouxing phones my.wav | head`
    run_command_line()


def rhubarb() -> None:
    """Run ``kouxing-rhubarb``. Ctrl-C ends it at once, because it writes its output at the end."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # not in a shell's background
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    from kouxing.services.cli.rhubarb import main as run_rhubarb

    run_rhubarb()


if __name__ == "__main__":
    main()
