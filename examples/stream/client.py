"""Streams a wav file (16 kHz, mono, 16 bits) and prints how far the jaw opens.

usage: client.py FILE.wav    (pip install pyzmq msgpack)
"""

import json
import secrets
import struct
import sys
import wave
from pathlib import Path

import msgpack
import zmq

context = zmq.Context()
key = json.loads(Path("~/.local/state/kouxing/client.key").expanduser().read_text(encoding="utf-8"))


def connect(kind, endpoint):
    """Return a socket that is connected to an address with a public key."""
    socket = context.socket(kind)
    if kind == zmq.DEALER:
        socket.routing_id = b"\1" + secrets.token_bytes(15)
    address, socket.curve_serverkey = endpoint.encode().split()
    socket.curve_publickey, socket.curve_secretkey = key["public"].encode(), key["secret"].encode()
    socket.connect(address.decode())
    return socket


def send(socket, kind, session, **fields):
    """Send a message."""
    body = {"version": 3, "session": session, **fields}
    socket.send_multipart([f"{kind}/{session}/".encode(), msgpack.packb(body)])


def receive(socket):
    """Return the kind of the next message and its fields."""
    topic, body = socket.recv_multipart()
    return topic.decode().split("/")[0], msgpack.unpackb(body)


control = connect(zmq.DEALER, "tcp://127.0.0.1:5550 " + key["control"])
send(control, "open-session", "", request="1", paced=False)
kind, opened = receive(control)
if kind != "session-opened":
    sys.exit(opened["text"])
session, token = opened["session"], opened["token"]

faps = connect(zmq.SUB, opened["faps"])
for kind in ("fap-frame", "end-of-faps", "joined"):  # joined last
    faps.subscribe(f"{kind}/{session}/")
receive(faps)  # joined: from now on, no frame is missed

audio = connect(zmq.DEALER, opened["audio"])
sequence, media_time, is_last = 0, 0, False
with wave.open(sys.argv[1]) as file:
    while not is_last:
        pcm = file.readframes(320)  # 20 ms
        sequence, is_last = sequence + 1, not pcm
        send(
            audio,
            "audio-chunk",
            session,
            token=token,
            sequence=sequence,
            media_time=media_time,
            pcm=pcm,
            last=is_last,
        )
        media_time += len(pcm) // 2

while (message := receive(faps))[0] == "fap-frame":
    values = struct.unpack("<68f", message[1]["values"])
    print("at", message[1]["media_time"] / 16000, "s the jaw opens by", values[2])  # FAP 3

send(control, "close-session", session, request="2", token=token)
receive(control)
