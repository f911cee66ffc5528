"""A listening test over HTTP: crashes, double submits, and a scripted judge in a real browser."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections.abc import Iterator
from fractions import Fraction
from http.client import HTTPConnection
from itertools import product
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import av
import numpy as np
import pytest

from evaluation.mos.order import order_of_judge
from evaluation.mos.store import Store, read_answers
from evaluation.mos.study import load_study, new_study
from evaluation.system.chromium import Chromium, is_installed
from tests.system import ROOT, free_port

pytestmark = pytest.mark.e2e

CONDITIONS = ("good", "bad")
SENTENCES = ("one", "two")


def write_video(path: Path) -> None:
    """Write a quarter of a second of grey with silence."""
    with av.open(str(path), "w") as file:
        video = file.add_stream("libvpx", rate=Fraction(20))
        video.width, video.height, video.pix_fmt = 64, 48, "yuv420p"
        for _ in range(5):
            picture = av.VideoFrame.from_ndarray(np.full((48, 64, 3), 128, np.uint8), "rgb24")
            file.mux(video.encode(picture))
        file.mux(video.encode())


class Served:
    """``kouxing mos serve`` in a process of its own, which can be killed and come again."""

    def __init__(self, folder: Path, *options: str) -> None:
        self.folder = folder
        self._options = options
        self.port = free_port()
        self.start()

    def start(self) -> None:
        code = "from evaluation.mos.commands import app; app()"
        command = [sys.executable, "-c", code, "serve", str(self.folder), "--port", str(self.port)]
        self._process = subprocess.Popen(
            [*command, *self._options],
            cwd=ROOT,
            stderr=subprocess.PIPE,
            text=True,
        )
        assert self._process.stderr is not None
        self.line = self._process.stderr.readline()
        assert self.line.startswith("judges open http"), self.line

    def kill(self) -> None:
        """End it as a crash does."""
        self._process.kill()
        self._process.communicate()

    def stop(self) -> int:
        self._process.terminate()
        self._process.communicate(timeout=60)
        return self._process.returncode

    def ask(
        self, path: str, body: object = None, *, raw: bytes = b"", **headers: str
    ) -> tuple[int, bytes]:
        """Return the status and what is answered."""
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

    def hearing_judge(self) -> str:
        """Return the token of a judge who has passed the sound check."""
        token: str = self.state("/judges", {})["judge"]
        beeps = self.beeps(token)
        assert not self.state(f"/beeps?judge={token}", {"beeps": beeps - 1})["hears"]
        assert self.state(f"/beeps?judge={token}", {"beeps": self.beeps(token)})["hears"]
        return token

    def beeps(self, token: str) -> int:
        store = Store(self.folder)
        judge = store.find_judge(token)
        store.close()
        assert judge is not None
        return judge.beeps


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("video") / "video.webm"
    write_video(path)
    return path


@pytest.fixture
def folder(tmp_path: Path, video: Path) -> Path:
    folder = tmp_path / "study"
    for sentence, condition in product(SENTENCES, CONDITIONS):
        (folder / condition).mkdir(parents=True, exist_ok=True)
        shutil.copy(video, folder / condition / f"{sentence}.webm")
    new_study(folder, title="Faces", reference="good", anchor="bad", languages=("zh", "en"))
    return folder


@pytest.fixture
def served(folder: Path, request: pytest.FixtureRequest) -> Iterator[Served]:
    served = Served(folder, *getattr(request, "param", ()))
    yield served
    assert served.stop() == 0


def test_answers_survive_a_crash_and_count_once(served: Served, video: Path) -> None:
    token = served.hearing_judge()
    for place in range(2):
        assert served.ask(f"/stimulus/{place}?judge={token}") == (200, video.read_bytes())
        answer = {"place": place, "sync": 4, "realism": 2 + place}
        assert served.state(f"/answers?judge={token}", answer)["place"] == place + 1
        served.kill()
        served.start()
    assert served.state(f"/state?judge={token}")["place"] == 2
    again = {"place": 0, "sync": 1, "realism": 1}
    assert served.state(f"/answers?judge={token}", again)["place"] == 2
    scores = {
        (each.sentence, each.condition, each.scale): each.score
        for each in read_answers(served.folder)
    }
    study = load_study(served.folder)
    order = order_of_judge(0, study.sentences, study.conditions)
    expected = {(*order[place], "sync"): 4 for place in range(2)}
    expected |= {(*order[place], "realism"): 2 + place for place in range(2)}
    assert scores == expected


def test_nothing_but_the_next_video_is_given_and_no_nonsense_kept(served: Served) -> None:
    deaf = served.state("/judges", {})["judge"]
    good = {"place": 0, "sync": 3, "realism": 3}
    assert served.ask(f"/stimulus/0?judge={deaf}")[0] == 404
    assert served.ask(f"/answers?judge={deaf}", good)[0] == 409
    token = served.hearing_judge()
    for path in (
        f"/stimulus/1?judge={token}",
        f"/stimulus/..%2fstudy.json?judge={token}",
        "/stimulus/0?judge=nobody",
        "/study.json",
        "/answers.sqlite",
        "/..%2f..%2fserver.py",
        "/server.py",
        "/good/one.webm",
    ):
        assert served.ask(path)[0] in (403, 404), path
    answers = f"/answers?judge={token}"
    bodies: list[object] = [
        {**good, "sync": 6},
        {**good, "realism": 0},
        {**good, "sync": True},
        {**good, "sync": "3"},
        {**good, "place": 10**30},
        {"place": 0, "sync": 3},
        [],
        3,
    ]
    for body in bodies:
        assert served.ask(answers, body)[0] in (400, 409), body
    assert served.ask(answers, {**good, "place": 1})[0] == 409
    assert served.ask(answers, {**good, "place": -1})[0] == 409
    assert served.ask(answers, raw=b"[" * 1000)[0] == 400
    assert served.ask(answers, raw=b"x" * 5000)[0] == 413
    assert served.ask(answers, good, Origin="http://evil.example")[0] == 403
    assert served.ask(answers, good, Host="evil.example")[0] == 403
    assert read_answers(served.folder) == []


@pytest.mark.parametrize("served", [("--set", "gateway.token=secret")], indirect=True)
def test_the_gateways_token_guards_everything_but_the_page(served: Served) -> None:
    assert served.line.endswith("/#token=secret\n")
    assert served.ask("/")[0] == served.ask("/main.js")[0] == 200
    for path in ("/study", "/state", "/beeps", "/stimulus/0"):
        assert served.ask(path)[0] == 403
    for path in ("/judges", "/beeps", "/answers"):
        assert served.ask(path, {})[0] == 403
    assert served.ask("/judges?token=wrong", {})[0] == 403
    assert json.loads(served.ask("/study?token=secret")[1]) == {
        "title": "Faces",
        "languages": ["zh", "en"],
        "videos": 4,
    }
    assert served.ask("/judges?token=secret", {})[0] == 200


def test_a_scripted_judge_in_a_browser(served: Served, tmp_path: Path) -> None:
    if not is_installed():
        pytest.skip("no Chromium is installed")
    browser = Chromium(tmp_path / "profile", (390, 844), tmp_path / "none.wav")
    try:
        judge_everything(browser, served)
    finally:
        browser.close()
    study = load_study(served.folder)
    answers = read_answers(served.folder)
    assert {(each.sentence, each.condition) for each in answers} == set(study.files)
    assert {each.score for each in answers if each.scale == "sync"} == {4}
    assert {each.score for each in answers if each.scale == "realism"} == {2}
    assert len(answers) == 2 * len(study.files)
    assert {each.judge for each in answers} == {0}
    store = Store(served.folder)
    another = store.find_judge(store.add_judge() or "")
    store.close()
    assert another is not None
    assert another.number == 1


def judge_everything(browser: Chromium, served: Served) -> None:
    def press(name: str) -> None:
        found = f"document.getElementById('{name}')"
        browser.wait_for(f"{found}?.matches(':enabled') && {found}.checkVisibility()")
        browser.evaluate(f"{found}.scrollIntoView({{block: 'center'}})")
        browser.click(name)

    browser.resize(390, 844, mobile=True)
    page = f"http://127.0.0.1:{served.port}/"
    browser.command("Page.navigate", url=page)
    browser.wait_for("document.getElementById('welcome')?.checkVisibility()")
    browser.evaluate("for (let n = 0; n < 2; n++) document.getElementById('begin').click()")
    press("play-beeps")
    token = browser.evaluate("new URLSearchParams(location.hash.slice(1)).get('judge')")
    press(f"heard-{served.beeps(token)}")
    for place in range(4):
        browser.wait_for(f"document.getElementById('progress').value === {place}")
        assert not browser.evaluate("document.getElementById('sync-4').matches(':enabled')")
        if place < 3:
            press("play")
        if place == 2:  # the video is lost with the page, what was answered is not
            browser.command("Page.reload")
            browser.wait_for("document.getElementById('progress')?.value === 2")
            press("play")
        if place == 3:  # another browser has nothing but the address
            browser.command("Page.navigate", url=page)
            browser.wait_for("document.getElementById('welcome')?.checkVisibility()")
            browser.evaluate(f"location.hash = 'judge={token}'")
            browser.wait_for("document.getElementById('progress')?.value === 3")
            stop_when_it_plays(browser)
            press("play")
            browser.wait_for("document.getElementById('video').paused")
            assert not browser.evaluate("document.getElementById('sync-4').matches(':enabled')")
            press("play")
        press("sync-4")
        press("realism-2")
        press("send")
    browser.wait_for("!document.getElementById('end').hidden")
    assert browser.evaluate("document.documentElement.scrollWidth") <= 390
    assert urlsplit(browser.evaluate("location.href")).query == ""
    assert browser.complaints == []
    browser.command("Page.navigate", url="about:blank")
    browser.command("Page.navigate", url=f"{page}#judge=nobody")
    browser.wait_for("document.getElementById('begin')?.checkVisibility()")
    assert browser.evaluate("document.getElementById('notice').checkVisibility()")


def stop_when_it_plays(browser: Chromium) -> None:
    """Stop the video once, as a phone does when another app is opened."""
    video = "document.getElementById('video')"
    stop = f"() => {video}.pause()"
    browser.evaluate(f"void {video}.addEventListener('playing', {stop}, {{once: true}})")
