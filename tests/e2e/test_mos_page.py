"""A listening test over HTTP: crashes, repeated requests, and judges in a real browser."""

import json
import shutil
import subprocess
import sys
from collections.abc import Iterator
from http.client import HTTPConnection
from itertools import product
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest

from kouxing.evaluation.mos.store import read_answers
from kouxing.evaluation.mos.study import load_study, new_study, places_of_judge
from kouxing.evaluation.system.chromium import Chromium
from tests.system import ROOT, free_port

CONDITIONS = ("reference", "anchor")
SENTENCES = ("one", "two")


class MosServer:
    """``kouxing mos serve`` in a process that can be killed and started again."""

    def __init__(self, folder: Path, *options: str) -> None:
        self.folder = folder
        self._options = options
        self.port = free_port()
        self.start()

    def start(self) -> None:
        code = "from kouxing.evaluation.mos.commands import app; app()"
        command = [sys.executable, "-c", code, "serve", str(self.folder), f"--set=port={self.port}"]
        self._process = subprocess.Popen(
            [*command, *self._options], cwd=ROOT, stderr=subprocess.PIPE, text=True
        )
        assert self._process.stderr is not None
        self.line = self._process.stderr.readline()
        assert self.line.startswith("judges open http"), self.line

    def kill(self) -> None:
        """Kill the process, as in a crash."""
        self._process.kill()
        self._process.communicate()

    def stop(self) -> int:
        self._process.terminate()
        self._process.communicate(timeout=60)
        return self._process.returncode

    def ask(
        self, path: str, body: object = None, *, raw: bytes = b"", **headers: str
    ) -> tuple[int, bytes]:
        """Return the status and the body of the answer."""
        connection = HTTPConnection("127.0.0.1", self.port, timeout=60)
        content = raw or (None if body is None else json.dumps(body).encode())
        connection.request("GET" if content is None else "POST", path, content, headers)
        answer = connection.getresponse()
        result = answer.status, answer.read()
        connection.close()
        return result

    def state(self, path: str, body: object = None) -> dict[str, Any]:
        status, content = self.ask(path, body)
        assert status == 200, content
        state: dict[str, Any] = json.loads(content)
        return state

    def add_judge(self) -> str:
        token: str = self.state("/judges", {})["judge"]
        return token


@pytest.fixture
def folder(tmp_path: Path, video: Path) -> Path:
    folder = tmp_path / "study"
    for sentence, condition in product(SENTENCES, CONDITIONS):
        (folder / condition).mkdir(parents=True, exist_ok=True)
        shutil.copy(video, folder / condition / f"{sentence}.mp4")
    new_study(folder)
    return folder


@pytest.fixture
def server(folder: Path, request: pytest.FixtureRequest) -> Iterator[MosServer]:
    server = MosServer(folder, *getattr(request, "param", ()))
    yield server
    assert server.stop() == 0


def test_answers_survive_a_crash_and_count_once(server: MosServer, video: Path) -> None:
    token = server.add_judge()
    for place in range(-2, 2):
        assert server.ask(f"/stimulus/{place}?judge={token}") == (200, video.read_bytes())
        answer = {"place": place, "sync": 4, "realism": 3 + place, "language": "en"}
        assert server.state(f"/answers?judge={token}", answer)["place"] == place + 1
        if place == 0:
            server.kill()
            server.start()
    assert server.state(f"/state?judge={token}")["place"] == 2
    again = {"place": 0, "sync": 1, "realism": 1, "language": "zh"}
    assert server.state(f"/answers?judge={token}", again)["place"] == 2
    places = places_of_judge(0, load_study(server.folder))
    assert [
        (answer.place, answer.sentence, answer.condition, answer.scale, answer.score)
        for answer in read_answers(server.folder)
    ] == [
        (place, *places[place], scale, score)
        for place in range(-2, 2)
        for scale, score in (("sync", 4), ("realism", 3 + place))
    ]


def test_sends_only_the_next_video_and_rejects_invalid_answers(server: MosServer) -> None:
    valid_answer = {"place": -2, "sync": 3, "realism": 3, "language": "zh"}
    token = server.add_judge()
    files = ("study.json", "answers.jsonl", "..%2f..%2fserver.py", "server.py", "good/one.mp4")
    videos = (f"stimulus/{name}?judge={token}" for name in ("-1", "0", "..%2fstudy.json"))
    for path in (*files, *videos, "stimulus/-2?judge=nobody"):
        assert server.ask(f"/{path}")[0] in (403, 404), path
    answers = f"/answers?judge={token}"
    assert server.ask(f"/stimulus/-2?judge={token}")[0] == 200
    changes: list[dict[str, object]] = [{"sync": value} for value in (6, True, "3")]
    changes += [{"realism": 0}, {"language": "fr"}, {"language": ["zh"]}]
    incomplete = {"place": -2, "sync": 3, "realism": 3}
    for body in (*({**valid_answer, **change} for change in changes), incomplete, [], 3):
        assert server.ask(answers, body)[0] == 400, body
    for place in (-1, 0, 1, 10**30):
        assert server.ask(answers, {**valid_answer, "place": place})[0] == 409
    assert server.ask(answers, raw=b"[" * 1000)[0] == 400
    assert server.ask(answers, raw=b"x" * 5000)[0] == 413
    assert server.ask(answers, valid_answer, Origin="http://evil.example")[0] == 403
    assert server.ask(answers, valid_answer, Host="evil.example")[0] == 403
    assert read_answers(server.folder) == []
    assert server.state(answers, valid_answer)["place"] == -1


@pytest.mark.parametrize("server", [("--set", "gateway.token=secret")], indirect=True)
def test_the_gateways_token_protects_everything_but_the_page(server: MosServer) -> None:
    assert server.line.endswith("/#token=secret\n")
    assert server.ask("/")[0] == server.ask("/main.js")[0] == 200
    for path in ("/state", "/stimulus/-2"):
        assert server.ask(path)[0] == 403
    for path in ("/judges", "/answers", "/judges?token=wrong"):
        assert server.ask(path, {})[0] == 403
    assert server.state("/state?token=secret") == {"title": "study", "videos": 4}
    assert server.ask("/judges?token=secret", {})[0] == 200


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Chromium]:
    folder = tmp_path_factory.mktemp("browser")
    browser = Chromium(folder, (390, 844), folder / "none.wav")
    browser.command("Network.enable")
    browser.resize(390, 844, mobile=True)
    yield browser
    browser.close()


def test_judges_score_every_video_in_a_browser(browser: Chromium, server: MosServer) -> None:
    Page(browser, server).score_all_clips({"reference": 5, "anchor": 2})
    assert browser.page_errors == []
    study = load_study(server.folder)
    answers = [answer for answer in read_answers(server.folder) if answer.place >= 0]
    assert {(answer.sentence, answer.condition) for answer in answers} == set(study.files)
    assert len(answers) == 2 * len(study.files)
    assert {answer.language for answer in answers} == {"zh", "en"}  # a reload resets it


IS_WELCOME = "document.getElementById('welcome')?.checkVisibility()"
VIDEO = "document.getElementById('video')"


class Page:
    """The page in a browser."""

    def __init__(self, browser: Chromium, server: MosServer) -> None:
        self._browser = browser
        self._server = server
        self._address = f"http://127.0.0.1:{server.port}/"
        browser.command("Emulation.setUserAgentOverride", userAgent="test", acceptLanguage="en-GB")

    def open(self) -> None:
        self._browser.command("Page.navigate", url=self._address)
        self._browser.wait_for(IS_WELCOME)

    def press(self, name: str) -> None:
        button = f"document.getElementById('{name}')"
        self._browser.wait_for(f"{button}?.matches(':enabled') && {button}.checkVisibility()")
        self._browser.evaluate(f"{button}.scrollIntoView({{block: 'center'}})")
        self._browser.click(name)

    def score_all_clips(self, scores: dict[str, int]) -> None:
        """Score sync by condition, realism one less; the judge is interrupted."""
        browser = self._browser
        self.open()
        assert browser.evaluate("document.documentElement.lang") == "en"
        self.press("language")
        assert browser.evaluate("document.documentElement.lang") == "zh"
        browser.evaluate("for (let n = 0; n < 2; n++) document.getElementById('begin').click()")
        browser.wait_for("document.getElementById('task').checkVisibility()")
        places = places_of_judge(0, load_study(self._server.folder))
        for place, (_, condition) in places.items():
            self._wait_for_place(place)
            assert not browser.evaluate("document.getElementById('sync-4').matches(':enabled')")
            if place == 2:  # the video is lost with the page, answers are not
                self.press("play")
                browser.command("Page.reload")
                self._wait_for_place(place)
            self.press("play")
            self.press(f"sync-{scores[condition]}")
            self.press(f"realism-{scores[condition] - 1}")
            self.press("send")
        browser.wait_for("!document.getElementById('end').hidden")
        assert urlsplit(browser.evaluate("location.href")).query == ""

    def _wait_for_place(self, place: int) -> None:
        self._browser.wait_for(f"{VIDEO}?.src.split('?')[0].endsWith('/stimulus/{place}')")
        hint = "document.getElementById('practice').checkVisibility()"
        assert self._browser.evaluate(hint) == (place < 0)
        progress = self._browser.evaluate("document.getElementById('progress').value")
        assert progress == max(place, 0)
