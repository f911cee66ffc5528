"""Follows the face of a session: pip install pyzmq msgpack.

usage: follow.py [SESSION [CONTROL-ADDRESS]]    (default: the newest session, tcp://127.0.0.1:5550)

Prints a line per frame, 50 per second: the time of its sound and the opening of the jaw, one of
ARKit's 52 weights. It waits for a session, follows it to other hosts, and ends with the session.
proto/PROTOCOL.md describes all messages and lists the names of the weights.
"""

import itertools
import json
import os
import signal
import struct
import sys
import time
from pathlib import Path

import msgpack
import zmq

signal.signal(signal.SIGINT, signal.SIG_DFL)  # Ctrl-C ends the program without a traceback

wanted, control_address = (*sys.argv[1:], *("", "tcp://127.0.0.1:5550")[len(sys.argv) - 1 :])
state = os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state"
key_file = Path(state, "kouxing", "client.key")
if not key_file.is_file():
    sys.exit(f"{key_file} does not exist; start kouxing, or copy the file from its machine")
key = json.loads(key_file.read_text(encoding="utf-8"))
context = zmq.Context()
numbers = itertools.count(1)  # of requests
JAW_OPEN = 24  # index in ARKit's names
MAX_WAIT_MS = 15_000  # for an answer of control


def connect(socket, endpoint):
    """Connect to an endpoint: an address and the server's public key."""
    address, socket.curve_serverkey = endpoint.encode().split()
    socket.curve_publickey, socket.curve_secretkey = key["public"].encode(), key["secret"].encode()
    socket.connect(address.decode())


def receive(socket):
    """Return the kind and the fields of the next message."""
    topic, body = socket.recv_multipart()
    return topic.decode().split("/")[0], msgpack.unpackb(body)


def ask(control, kind, session, **fields):
    """Send a request; return the kind and the fields of the answer."""
    body = {"version": 3, "session": session, "request": str(next(numbers)), **fields}
    control.send_multipart([f"{kind}/{session}/".encode(), msgpack.packb(body)])
    if not control.poll(MAX_WAIT_MS):
        context.destroy(linger=0)
        sys.exit(f"control does not answer at {control_address}; start it with: kouxing run")
    return receive(control)


def sessions(control):
    """Yield the status of the wanted session, or of all sessions, twice per second."""
    while True:
        kind, answer = ask(control, "status-request", wanted)
        yield answer["sessions"] if kind == "status-report" else []  # an error: no session yet
        time.sleep(0.5)


control = context.socket(zmq.DEALER)
connect(control, f"{control_address} {key['control']}")
candidates = (
    [session for session in known if "faps" in session["endpoints"]] for known in sessions(control)
)
session = min(next(filter(None, candidates)), key=lambda candidate: candidate["age_s"])
name = session["session"]
_, report = ask(control, "status-request", "")
events = next(
    service["endpoints"]["events"]
    for service in report["services"]
    if service["service"] == "control"
)

face = context.socket(zmq.SUB)
connect(face, session["endpoints"]["faps"])
# joined is last, so that no frame is missed
for kind in ("session-moved", "fap-frame", "end-of-faps", "joined"):
    face.subscribe(f"{kind}/{name}/")

epoch, newest, following = 0, (-1, 0), False
while True:
    kind, body = receive(face)
    if kind == "joined" and not following:  # it arrives for every subscriber that joins
        following = True
        ask(control, "set-face", name, face={"shapes": ["arkit"]})
        connect(face, events)  # control publishes there when the session moves
        print("following", name, flush=True)
    elif kind == "session-moved":
        epoch = body["epoch"]
        connect(face, body["faps"])
        face.unsubscribe(f"joined/{name}/")
        face.subscribe(f"joined/{name}/")  # after joining, the newest frames arrive again
    elif kind == "end-of-faps" and body["epoch"] >= epoch:
        break
    elif kind == "fap-frame" and "arkit" in body["shapes"]:
        position = body["media_time"], body["sequence"]
        if position > newest:
            newest = position
            weights = struct.unpack("<52f", body["shapes"]["arkit"])
            print(f"{body['media_time'] / 16000:.3f} {weights[JAW_OPEN]:.2f}", flush=True)
