"""A headless Chromium with one page, driven by the Chrome DevTools Protocol.

Playwright is not used: its package is 53 MB, because it contains Node.
"""

import asyncio
import contextlib
import functools
import http.server
import json
import shutil
import subprocess
import threading
import wave
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import aiohttp

from kouxing.evaluation.system.wait import wait_until
from kouxing.shared.arrays import Floats
from kouxing.shared.audio.pcm import as_integers
from kouxing.shared.errors import UserError

_TIMEOUT_S = 120.0


def find_chromium() -> str | None:
    """Return the path of Chromium, or None if it is not installed."""
    return shutil.which("chromium") or shutil.which("google-chrome")


class Chromium:
    """A headless Chromium with one page, drawn without a GPU.

    Raises ``UserError`` if Chromium is not installed.

    The microphone repeats a WAV file, the camera an MJPEG file at 30 frames per second. ``folder``
    is for the profile.
    """

    def __init__(
        self, folder: Path, size_px: tuple[int, int], microphone: Path, camera: Path | None = None
    ) -> None:
        program = find_chromium()
        if program is None:
            raise UserError("Chromium is not installed; install the package chromium")
        command = [
            program,
            *("--headless", "--no-sandbox", "--disable-gpu", "--use-gl=angle"),
            *("--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-quic"),
            *("--no-first-run", "--disable-background-networking", "--disable-sync"),
            "--disable-component-update",
            # the address bar's pages take longer to load than the rest of the browser
            "--disable-features=WebUIOmniboxPopup,WebUIOmniboxAimPopup",
            "--autoplay-policy=document-user-activation-required",
            *("--use-fake-device-for-media-stream", "--use-fake-ui-for-media-stream"),
            f"--use-file-for-fake-audio-capture={microphone}",
            *([f"--use-file-for-fake-video-capture={camera}"] if camera else []),
            f"--window-size={size_px[0]},{size_px[1]}",
            f"--user-data-dir={folder}",
            "--remote-debugging-port=0",
            "about:blank",
        ]
        folder.mkdir(parents=True, exist_ok=True)
        self._messages = folder / "messages.txt"
        with self._messages.open("wb") as messages:
            self._process = subprocess.Popen(command, stderr=messages)  # noqa: S603 - on the path
        self._loop = asyncio.new_event_loop()
        self._connections: list[aiohttp.ClientSession | aiohttp.ClientWebSocketResponse] = []
        self._num_sent = 0
        self.page_errors: list[str] = []
        try:
            self._port = self._wait_for_port(folder)
            self._loop.run_until_complete(self._connect())
            self.command("Runtime.enable")
            self.command("Log.enable")
            self.resize(*size_px)
        except BaseException:
            self.close()
            raise

    def _wait_for_port(self, folder: Path) -> int:
        port_file = folder / "DevToolsActivePort"

        def has_started() -> bool:
            return port_file.is_file() and "\n" in port_file.read_text()

        wait_until(lambda: has_started() or self._process.poll() is not None, _TIMEOUT_S)
        if not has_started():
            messages = self._messages.read_text("utf-8", "replace").splitlines()
            raise UserError(f"Chromium did not start: {messages[-1] if messages else 'no message'}")
        return int(port_file.read_text().split()[0])

    async def _connect(self) -> None:
        self._http = aiohttp.ClientSession()
        self._connections.append(self._http)
        async with self._http.get(f"http://127.0.0.1:{self._port}/json/list") as answer:
            targets = await answer.json()
        url = next(target for target in targets if target["type"] == "page")["webSocketDebuggerUrl"]
        self._socket = await self._http.ws_connect(url, max_msg_size=0)
        self._connections.append(self._socket)

    def close(self) -> None:
        """Close the browser."""
        for connection in reversed(self._connections):
            self._loop.run_until_complete(connection.close())
        self._loop.close()
        self._process.terminate()
        self._process.wait(_TIMEOUT_S)

    def command(self, method: str, **parameters: object) -> dict[str, Any]:
        """Run a command of the protocol."""
        return self._loop.run_until_complete(self._command(method, parameters))

    async def _command(self, method: str, parameters: dict[str, object]) -> dict[str, Any]:
        self._num_sent += 1
        message = {"id": self._num_sent, "method": method, "params": parameters}
        await self._socket.send_json(message)
        while True:
            answer = await self._socket.receive_json(timeout=_TIMEOUT_S)
            if answer.get("method") in ("Runtime.exceptionThrown", "Log.entryAdded"):
                self.page_errors.append(json.dumps(answer["params"]))
            if answer.get("id") == self._num_sent:
                if "error" in answer:
                    raise RuntimeError(answer["error"])
                result: dict[str, Any] = answer["result"]
                return result

    def resize(self, width_px: int, height_px: int, *, mobile: bool = False) -> None:
        """Resize the window; ``mobile`` emulates a phone."""
        size = {"width": width_px, "height": height_px, "deviceScaleFactor": 1}
        self.command("Emulation.setDeviceMetricsOverride", **size, mobile=mobile)

    def cpu_s(self, kind: str = "GPU") -> float:
        """Return the CPU time of the processes of a kind: GPU (it draws), renderer or utility."""
        return self._loop.run_until_complete(self._cpu_s(kind))

    async def _cpu_s(self, kind: str) -> float:
        async with self._http.get(f"http://127.0.0.1:{self._port}/json/version") as answer:
            url = (await answer.json())["webSocketDebuggerUrl"]
        async with self._http.ws_connect(url) as socket:
            await socket.send_json({"id": 1, "method": "SystemInfo.getProcessInfo"})
            processes = (await socket.receive_json())["result"]["processInfo"]
        return float(sum(process["cpuTime"] for process in processes if process["type"] == kind))

    def evaluate(self, script: str) -> Any:
        """Return the value of an expression of the page."""
        result = self.command(
            "Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True
        )
        if "exceptionDetails" in result:
            raise RuntimeError(result["exceptionDetails"])
        return result["result"].get("value")

    def click(self, name: str) -> None:
        """Click on an element with the mouse, as a user does; see ``center_of``."""
        x, y = self.center_of(name)
        press: dict[str, object] = {"x": x, "y": y, "button": "left", "clickCount": 1}
        for event in ("mousePressed", "mouseReleased"):
            self.command("Input.dispatchMouseEvent", type=event, **press)

    def center_of(self, name: str) -> tuple[float, float]:
        """Scroll to an element, and return its center in pixels of the window.

        ``name`` is the element's ID, which the rest of a CSS selector may follow. Raises
        RuntimeError if the element is covered or does not react to the mouse.
        """
        x, y = self.evaluate(
            "(async () => {"
            "const drawn = () => new Promise((done) => requestAnimationFrame(done));"
            f"const target = document.querySelector('#{name}');"
            "let x, y, width, height, before;"
            "do {"  # until the page no longer moves
            "before = x + ',' + y;"
            "await drawn(); await drawn();"
            "target.scrollIntoView({ block: 'nearest' });"
            "({ x, y, width, height } = target.getBoundingClientRect());"
            "} while (before !== x + ',' + y);"
            "const center = [x + width / 2, y + height / 2];"
            "const hit = document.elementFromPoint(...center);"
            "if (!target.contains(hit)) throw Error(`at ${center}: ${hit?.outerHTML}`);"
            "return center; })()"
        )
        return x, y

    def wait_for(self, condition: str, timeout_s: float = _TIMEOUT_S) -> None:
        """Wait until an expression becomes true."""

        def holds() -> bool:
            try:
                return bool(self.evaluate(condition))
            except RuntimeError as error:
                if "navigated" in str(error):  # the page is being replaced
                    return False
                raise

        if not wait_until(holds, timeout_s):
            state = self.evaluate("JSON.stringify(window.kouxing?.state)")
            raise TimeoutError(f"{condition}; state {state}; {self.page_errors}")


@contextlib.contextmanager
def serve_folder(folder: Path) -> Iterator[str]:
    """Serve a folder like ``python -m http.server``; yield the origin."""

    class Handler(http.server.SimpleHTTPRequestHandler):
        def log_message(self, *_: object) -> None:
            pass

    handler = functools.partial(Handler, directory=str(folder))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield f"http://127.0.0.1:{server.server_port}"
        finally:
            server.shutdown()
            thread.join()


def write_wav(path: Path, samples: Floats, rate_hz: int) -> None:
    """Write samples (num_samples, num_channels) to a WAV file of 16 bits."""
    with wave.open(str(path), "wb") as file:
        file.setparams((samples.shape[1], 2, rate_hz, 0, "NONE", ""))
        file.writeframes(as_integers(samples).tobytes())
