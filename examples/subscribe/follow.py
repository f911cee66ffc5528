"""Follows the face of a session: pip install ./clients/python.

usage: follow.py [SESSION [CONTROL-ADDRESS]]
(default: the newest session, $KOUXING_CONTROL or tcp://127.0.0.1:5550)

Prints a line per frame, 50 per second: the time of its sound and the opening of the jaw, one of
ARKit's 52 weights. It waits for a session, follows it to other hosts, and ends with the session.
"""

import signal
import sys
import time

from kouxing_client import Client, KouxingError, Refused

signal.signal(signal.SIGINT, signal.SIG_DFL)  # Ctrl-C ends the program without a traceback


def wait_for_session(client, name):
    """Return a session as soon as it is open; if the name is empty, the newest."""
    is_waiting = False
    while True:
        try:
            return client.follow(name)
        except Refused as refusal:
            if refusal.code != "unknown-session":
                raise
        if not is_waiting:
            print(f"waiting for {name or 'a session'}", file=sys.stderr)
            is_waiting = True
        time.sleep(0.5)


name, address = (*sys.argv[1:], "", "")[:2]
try:
    with Client(address or None) as client, wait_for_session(client, name) as session:
        faces = session.shapes("arkit")
        print("following", session.name, flush=True)
        for face in faces:
            print(f"{face.time_s:.3f} {face.by_name['jawOpen']:.2f}", flush=True)
except KouxingError as error:
    sys.exit(str(error))
