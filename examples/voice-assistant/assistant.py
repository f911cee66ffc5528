"""A voice assistant with a face that can be interrupted: pip install aiohttp.

usage: assistant.py [GATEWAY]    (default: ws://127.0.0.1:8080; with a token: wss://HOST:8080?token=...)

Type what the user says, one line at a time. The face of the assistant's session speaks the answer,
on the page and in other programs. A line that is typed during an answer interrupts the answer: the
face stops immediately and continues with the new one. Replace `answer` by your language model and
`synthesize` by your text-to-speech.
"""

import array
import asyncio
import itertools
import math
import signal
import sys
import threading
from urllib.parse import urlsplit, urlunsplit

import aiohttp

signal.signal(signal.SIGINT, signal.SIG_DFL)  # Ctrl-C ends the program without a traceback

RATE_HZ = 16000
PITCH_HZ = 140
VOWELS_HZ = ((850, 1300), (300, 2300), (320, 800), (480, 850), (420, 1400))  # formants: a i u o e
SYLLABLE_S = 0.2
MESSAGE_BYTES = 2**16  # 2 s


def answer(text):
    """Return an answer to the user."""
    return f"you said {text}"


async def synthesize(text):
    """Yield 16-bit PCM in chunks of any length; here a hum with one vowel per letter."""
    for letter in text:
        states = [[0.0, 0.0], [0.0, 0.0]]
        samples = array.array("h")
        for number in range(int(SYLLABLE_S * RATE_HZ)):
            value = float(number % (RATE_HZ // PITCH_HZ) == 0 and letter != " ")
            for state, formant_hz in zip(states, VOWELS_HZ[ord(letter) % 5], strict=True):
                value += (
                    1.94 * math.cos(math.tau * formant_hz / RATE_HZ) * state[0] - 0.94 * state[1]
                )
                state[:] = value, state[0]
            samples.append(max(-32767, min(32767, int(1500 * value))))
        yield samples.tobytes()
        await asyncio.sleep(0)  # let other tasks run


async def speak(face, text):
    """Send an answer to the face and wait until it is spoken."""
    start_s = asyncio.get_running_loop().time()
    sent_s = 0.0
    try:
        async for pcm in synthesize(text):
            for begin in range(0, len(pcm), MESSAGE_BYTES):  # a whole sentence can be a large chunk
                await face.send_bytes(pcm[begin : begin + MESSAGE_BYTES])
            sent_s += len(pcm) / 2 / RATE_HZ
    except (OSError, aiohttp.ClientError) as error:
        print("cannot speak the answer:", error, flush=True)
    await asyncio.sleep(start_s + sent_s - asyncio.get_running_loop().time())


def read_lines(loop, lines):
    """Put the lines of the standard input into a queue; None at its end."""
    for line in sys.stdin:
        loop.call_soon_threadsafe(lines.put_nowait, line.strip())
    loop.call_soon_threadsafe(lines.put_nowait, None)


async def converse(face, lines):
    """Answer the user until an empty line or the end of the input."""
    speaking = None
    for number in itertools.count(1):
        line = await lines.get()
        if speaking is not None and not speaking.done() and line:
            speaking.cancel()
            await face.send_json({"flush": True})
            print("interrupted", flush=True)
        if not line:
            break
        print(f"answer {number}", flush=True)
        speaking = asyncio.create_task(speak(face, answer(line)))
    if speaking is not None:
        await speaking
    await face.send_json({"last": True})


async def main(gateway):
    """Open one session for the whole conversation."""
    scheme, host, _, query, _ = urlsplit(gateway)
    url = urlunsplit((scheme, host, "/microphone", query, ""))
    async with aiohttp.ClientSession() as http, http.ws_connect(url) as face:
        await face.send_json({"sample_rate_hz": RATE_HZ, "encoding": "s16le", "ahead": True})
        opened = await face.receive_json()
        if opened["type"] != "opened":
            raise SystemExit(opened["text"])
        print("the face is session", opened["session"], flush=True)
        loop, lines = asyncio.get_running_loop(), asyncio.Queue()
        threading.Thread(target=read_lines, args=(loop, lines), daemon=True).start()
        conversation = asyncio.create_task(converse(face, lines))
        async for message in face:  # until all is spoken and the gateway closes
            if message.type is aiohttp.WSMsgType.TEXT:
                raise SystemExit(message.json()["text"])
        if not conversation.done():
            raise SystemExit("the gateway has closed the connection; start the assistant again")
        await conversation


if __name__ == "__main__":
    address = sys.argv[1] if len(sys.argv) > 1 else "ws://127.0.0.1:8080"
    try:
        asyncio.run(main(address))
    except aiohttp.WSServerHandshakeError as error:
        sys.exit(f"{address} rejected the connection ({error.status}); copy the page's token")
    except aiohttp.ClientConnectorCertificateError:
        sys.exit(f"the certificate of {address} is not trusted; set SSL_CERT_FILE to its file")
    except (aiohttp.ClientError, OSError):
        sys.exit(f"cannot reach the gateway at {address}; start it with: kouxing run")
