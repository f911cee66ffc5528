"""A headless Firefox with one page, driven by WebDriver BiDi."""

import asyncio
import json
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any, Self

import aiohttp

from tests.system import wait_until

_TIMEOUT_S = 60.0
_PREFERENCES = {
    "media.navigator.streams.fake": True,  # the microphone plays a tone
    "media.navigator.permission.disabled": True,
    "media.autoplay.default": 1,  # blocked until a click
    "datareporting.policy.dataSubmissionEnabled": False,
}


class Firefox:
    """A headless Firefox with one page."""

    def __init__(self, folder: Path) -> None:
        program = shutil.which("firefox-esr") or shutil.which("firefox")
        assert program is not None, "Firefox is not installed; install the package firefox-esr"
        folder.mkdir()
        lines = (f"user_pref({json.dumps(k)}, {json.dumps(v)});" for k, v in _PREFERENCES.items())
        (folder / "user.js").write_text("\n".join(lines))
        command = [program, "--headless", "--no-remote", "--remote-debugging-port=0"]
        self._log = folder / "log"
        with self._log.open("w") as log:
            self._process = subprocess.Popen(
                [*command, "--profile", folder, "about:blank"], stderr=log, stdout=log
            )
        self._loop = asyncio.new_event_loop()
        self._num_sent = 0

    def __enter__(self) -> Self:
        pattern = re.compile(r"WebDriver BiDi listening on (ws://\S+)")
        wait_until(lambda: pattern.search(self._log.read_text()))
        match = pattern.search(self._log.read_text())
        assert match is not None
        self._loop.run_until_complete(self._connect(f"{match.group(1)}/session"))
        self.command("session.new", capabilities={})
        self._context = self.command("browsingContext.getTree")["contexts"][0]["context"]
        return self

    def __exit__(self, *_: object) -> None:
        self._loop.run_until_complete(self._http.close())
        self._loop.close()
        self._process.terminate()
        self._process.wait(_TIMEOUT_S)

    async def _connect(self, address: str) -> None:
        self._http = aiohttp.ClientSession()
        self._socket = await self._http.ws_connect(address, max_msg_size=0)

    def command(self, method: str, **parameters: object) -> dict[str, Any]:
        """Run a command of the protocol."""
        return self._loop.run_until_complete(self._command(method, parameters))

    async def _command(self, method: str, parameters: dict[str, object]) -> dict[str, Any]:
        self._num_sent += 1
        await self._socket.send_json({"id": self._num_sent, "method": method, "params": parameters})
        while True:
            answer = await self._socket.receive_json(timeout=_TIMEOUT_S)
            if answer.get("id") == self._num_sent:
                if answer["type"] == "error":
                    raise RuntimeError(answer["message"])
                result: dict[str, Any] = answer["result"]
                return result

    def open(self, address: str) -> None:
        """Load a page."""
        self.command(
            "browsingContext.navigate", context=self._context, url=address, wait="complete"
        )

    def evaluate(self, script: str) -> Any:
        """Return the value of an expression of the page, which may be a promise."""
        result = self.command(
            "script.evaluate",
            expression=f"(async () => JSON.stringify(await ({script})) ?? 'null')()",
            target={"context": self._context},
            awaitPromise=True,
        )
        if "exceptionDetails" in result:
            raise RuntimeError(result["exceptionDetails"]["text"])
        return json.loads(result["result"]["value"])

    def wait_for(self, condition: str) -> None:
        """Wait until an expression becomes true."""
        wait_until(lambda: self.evaluate(f"Boolean({condition})"))

    def click(self, name: str) -> None:
        """Click on the middle of an element, by its ID."""
        place = f"document.getElementById('{name}').getBoundingClientRect()"
        x, y = self.evaluate(
            f"(() => {{ const {{ x, y, width, height }} = {place};"
            " return [x + width / 2, y + height / 2]; })()"
        )
        steps: list[dict[str, object]] = [
            {"type": "pointerMove", "x": round(x), "y": round(y)},
            {"type": "pointerDown", "button": 0},
            {"type": "pointerUp", "button": 0},
        ]
        pointer = {"type": "pointer", "id": "mouse", "actions": steps}
        self.command("input.performActions", context=self._context, actions=[pointer])
