"""Streams a wav file and prints how far the jaw opens.

usage: client.py FILE.wav [CONTROL-ADDRESS]    (pip install pyzmq msgpack)
"""

import json
import os
import secrets
import struct
import sys
from pathlib import Path

import msgpack
import zmq

MAX_WAIT_MS = 15_000  # for an answer of control

if len(sys.argv) < 2:
    sys.exit("usage: client.py FILE.wav [CONTROL-ADDRESS]")
control_address = [*sys.argv, "tcp://127.0.0.1:5550"][2]
state = os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state"
key_file = Path(state, "kouxing", "client.key")
if not key_file.is_file():
    sys.exit(f"{key_file} does not exist; start kouxing, or copy the file from its machine")
key = json.loads(key_file.read_text(encoding="utf-8"))
context = zmq.Context()


def read_wav(path):
    """Return the format of a wav file as `open-session` takes it, and its PCM."""
    file = path.read_bytes() if path.is_file() else b""
    chunks, at = {}, 12
    while file[:4] == b"RIFF" and at + 8 <= len(file):
        kind, size = struct.unpack_from("<4sI", file, at)
        size = size or len(file)  # the file was written as a stream
        chunks.setdefault(kind, file[at + 8 : at + 8 + size])
        at += 8 + size + size % 2
    if not {b"fmt ", b"data"} <= chunks.keys():
        sys.exit(f"{path} is not a wav file; convert yours: ffmpeg -i FILE speech.wav")
    header, pcm = chunks[b"fmt "], chunks[b"data"]
    code, num_channels, rate_hz, _, _, num_bits = struct.unpack_from("<HHIIHH", header)
    if code == 0xFFFE:  # extensible
        (code,) = struct.unpack_from("<H", header, 24)
    if code == 1 and num_bits in (24, 32):
        width = num_bits // 8
        pcm = pcm[: len(pcm) // width * width]
        upper = bytearray(len(pcm) // width * 2)  # the upper 16 bits
        upper[::2], upper[1::2] = pcm[width - 2 :: width], pcm[width - 1 :: width]
        pcm = bytes(upper)
    elif (code, num_bits) not in {(1, 16), (3, 32)}:
        sys.exit(f"{path}: convert it to 16 bits: ffmpeg -i {path} -c:a pcm_s16le speech.wav")
    encoding = "f32le" if code == 3 else "s16le"
    return {"encoding": encoding, "sample_rate_hz": rate_hz, "num_channels": num_channels}, pcm


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


audio_format, samples = read_wav(Path(sys.argv[1]))
control = connect(zmq.DEALER, f"{control_address} {key['control']}")
send(control, "open-session", "", request="1", paced=False, **audio_format)
if not control.poll(MAX_WAIT_MS):
    context.destroy(linger=0)
    sys.exit(f"control does not answer at {control_address}; start it with: kouxing run")
kind, opened = receive(control)
if kind != "session-opened":
    sys.exit(opened["text"])
session, token = opened["session"], opened["token"]

faps = connect(zmq.SUB, opened["faps"])
for kind in ("fap-frame", "end-of-faps", "joined"):  # joined last
    faps.subscribe(f"{kind}/{session}/")
receive(faps)  # joined: from now on, no frame is missed

audio = connect(zmq.DEALER, opened["audio"])
rate_hz = audio_format["sample_rate_hz"]
frame_bytes = audio_format["num_channels"] * (4 if audio_format["encoding"] == "f32le" else 2)
sequence, num_sent, is_last = 0, 0, False  # num_sent: samples per channel
while not is_last:
    begin, num_frames = num_sent * frame_bytes, rate_hz // 50  # 20 ms
    num_frames = min(num_frames, len(samples) // frame_bytes - num_sent)
    pcm = samples[begin : begin + num_frames * frame_bytes]
    sequence, is_last = sequence + 1, not pcm
    send(
        audio,
        "audio-chunk",
        session,
        token=token,
        sequence=sequence,
        media_time=num_sent * 16000 // rate_hz,
        pcm=pcm,
        last=is_last,
    )
    num_sent += num_frames

newest = 0
while (message := receive(faps))[0] != "end-of-faps":
    kind, frame = message
    if kind == "fap-frame" and frame["sequence"] > newest:  # some are repeated for others
        newest = frame["sequence"]
        values = struct.unpack("<68f", frame["values"])
        print("at", frame["media_time"] / 16000, "s the jaw opens by", values[2])  # FAP 3

send(control, "close-session", session, request="2", token=token)
receive(control)
