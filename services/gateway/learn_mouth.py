"""Learn my mouth: turn a browser's recording of a speaker's lips into a mouth profile.

The browser sends a landmark file (``docs/my_mouth.md``). A worker process learns the profile.
Nothing is stored.
"""

import asyncio
import base64
import multiprocessing
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from typing import Any

from aiohttp import web

from kouxing.services.gateway.http import discard_body
from kouxing.services.mouth_profiles import worker
from kouxing.shared.errors import UserError
from kouxing.shared.logs import LOG

MAX_BYTES = 8 << 20
UPLOAD_LIMIT_S = 60.0
LEARNING_LIMIT_S = 180.0
PRESENCE_CHECK_S = 0.5  # interval at which a disconnected browser is noticed

_SPAWN = multiprocessing.get_context("spawn")


class MouthLearner:
    """Learns one speaker's mouth at a time, in a process of its own."""

    def __init__(self, learn: worker.Learn = worker.learn_from_landmarks) -> None:
        self._learn = learn
        self._is_busy = False
        self._process: SpawnProcess | None = None
        self._is_closing = False

    @property
    def is_learning(self) -> bool:
        """Whether a process is learning."""
        return self._process is not None

    def close(self) -> None:
        """Stop the current learning process and reject further recordings."""
        self._is_closing = True
        if self._process is not None and self._process.is_alive():
            self._process.kill()

    async def serve(self, request: web.Request) -> web.StreamResponse:
        """Answer a recording with the learned mouth profile, or with an error."""
        if self._is_closing:
            return _error(503, "the gateway is stopping")
        if self._is_busy:
            await discard_body(request)
            return _error(503, "another mouth is being learned; try again in a minute")
        self._is_busy = True
        try:
            upload = request.clone(client_max_size=MAX_BYTES)
            recording = await asyncio.wait_for(upload.read(), UPLOAD_LIMIT_S)
            return web.json_response(await self._learn_from(request, recording))
        except web.HTTPRequestEntityTooLarge:
            await discard_body(request)
            return _error(413, f"the recording is larger than {MAX_BYTES >> 20} MiB")
        except TimeoutError:
            return _error(408, f"the recording did not arrive within {UPLOAD_LIMIT_S:g} s")
        except UserError as error:
            return _error(422, str(error))
        finally:
            self._is_busy = False

    async def _learn_from(self, request: web.Request, recording: bytes) -> dict[str, object]:
        connection, child_end = _SPAWN.Pipe()
        process = _SPAWN.Process(target=worker.run, args=(self._learn, child_end), daemon=True)
        with worker.single_threaded_children():
            process.start()
        child_end.close()
        self._process = process
        exchange = asyncio.create_task(asyncio.to_thread(_exchange, connection, recording))
        deadline_s = asyncio.get_running_loop().time() + LEARNING_LIMIT_S
        try:
            while not exchange.done():
                await asyncio.wait({exchange}, timeout=PRESENCE_CHECK_S)
                if asyncio.get_running_loop().time() > deadline_s:
                    raise UserError(
                        f"learning took longer than {LEARNING_LIMIT_S:g} s; try again later"
                    )
                if request.transport is None:
                    raise UserError("the browser has disconnected")
        finally:
            process.kill()
            status, result = await exchange
            process.join()
            process.close()
            connection.close()
            self._process = None
        if self._is_closing:
            raise UserError("the gateway is stopping")
        if status == "refused":
            raise UserError(result)
        if status == "failed":
            LOG.error("learning a mouth failed: %s", result)
            raise UserError("learning failed; see the gateway's log")
        content, figures = result
        return {"mouth_profile": base64.b64encode(content).decode(), **figures}


def _exchange(connection: Connection, recording: bytes) -> tuple[str, Any]:
    """Send the recording to the process and wait for its answer."""
    try:
        connection.send_bytes(recording)
        answer: tuple[str, Any] = connection.recv()
    except (EOFError, OSError):
        return "failed", "the process ended early"
    return answer


def _error(status: int, text: str) -> web.Response:
    return web.json_response({"error": text}, status=status)
