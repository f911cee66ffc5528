"""Follows the face of a session: pip install pyzmq msgpack.

usage: follow.py [SESSION [CONTROL-ADDRESS]]    (default: the newest session, tcp://127.0.0.1:5550)

Prints a line a frame, 50 a second: the time of its sound and how far the jaw opens, one of ARKit's
52 weights. It waits until there is a session, follows it to whatever host, and ends with it.
proto/PROTOCOL.md says what else there is, and has the names of the others.
"""

import itertools
import json
import os
import struct
import sys
import time
from pathlib import Path

import msgpack
import zmq

wanted, control_address = (*sys.argv[1:], *("", "tcp://127.0.0.1:5550")[len(sys.argv) - 1 :])
state = os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state"
key = json.loads(Path(state, "kouxing", "client.key").read_text(encoding="utf-8"))
context = zmq.Context()
numbers = itertools.count(1)  # of requests
JAW_OPEN = 24  # its place among ARKit's names


def connect(socket, endpoint):
    """Connect to an address and the public key of who is there."""
    address, socket.curve_serverkey = endpoint.encode().split()
    socket.curve_publickey, socket.curve_secretkey = key["public"].encode(), key["secret"].encode()
    socket.connect(address.decode())


def receive(socket):
    """Return the kind of the next message and its fields."""
    topic, body = socket.recv_multipart()
    return topic.decode().split("/")[0], msgpack.unpackb(body)


def ask(control, kind, session, **fields):
    """Send a request, and return the kind of the answer and its fields."""
    body = {"version": 3, "session": session, "request": str(next(numbers)), **fields}
    control.send_multipart([f"{kind}/{session}/".encode(), msgpack.packb(body)])
    return receive(control)


def sessions(control):
    """Yield what control knows of the wanted session, or of all, twice a second."""
    while True:
        kind, answer = ask(control, "status-request", wanted)
        yield answer["sessions"] if kind == "status-report" else []  # an error: there is none yet
        time.sleep(0.5)


control = context.socket(zmq.DEALER)
connect(control, f"{control_address} {key['control']}")
found = (
    [session for session in known if "faps" in session["endpoints"]] for known in sessions(control)
)
session = min(next(filter(None, found)), key=lambda each: each["age_s"])
name = session["session"]
_, report = ask(control, "status-request", "")
events = next(
    each["endpoints"]["events"] for each in report["services"] if each["service"] == "control"
)

face = context.socket(zmq.SUB)
connect(face, session["endpoints"]["faps"])
for kind in ("session-moved", "fap-frame", "end-of-faps", "joined"):  # joined last: none is missed
    face.subscribe(f"{kind}/{name}/")

epoch, newest, following = 0, (-1, 0), False
while True:
    kind, body = receive(face)
    if kind == "joined" and not following:  # it comes again whenever anybody joins
        following = True
        ask(control, "set-face", name, face={"shapes": ["arkit"]})
        connect(face, events)  # control tells there when the face is made elsewhere
        print("following", name, flush=True)
    elif kind == "session-moved":
        epoch = body["epoch"]
        connect(face, body["faps"])
        face.unsubscribe(f"joined/{name}/")
        face.subscribe(f"joined/{name}/")  # who joins a moved face gets its newest frames again
    elif kind == "end-of-faps" and body["epoch"] >= epoch:
        break
    elif kind == "fap-frame" and "arkit" in body["shapes"]:
        place = body["media_time"], body["sequence"]
        if place > newest:
            newest = place
            weights = struct.unpack("<52f", body["shapes"]["arkit"])
            print(f"{body['media_time'] / 16000:.3f} {weights[JAW_OPEN]:.2f}", flush=True)
