"""Crashed and hanging services are restarted; sessions, and the page, continue."""

import io
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest
from kouxing_client import Client
from rich.console import Console

from kouxing.services.cli.launch.supervisor import Supervisor
from kouxing.services.service_kinds import KINDS
from kouxing.shared.errors import UserError
from tests.browser import Browser
from tests.documents import code_blocks
from tests.e2e.streaming import StreamedSession, stream_audio
from tests.system import DEMO, ROOT, System, samples_of_file, wait_until


@pytest.fixture(scope="module")
def system(tmp_path_factory: pytest.TempPathFactory) -> Iterator[System]:
    with System(KINDS, tmp_path_factory.mktemp("logs"), restarts=True) as running:
        yield running


@pytest.mark.parametrize(
    ("service", "blow", "text"),
    [
        ("recognizer", signal.SIGSTOP, "recognizer is not responding"),
        ("synthesizer", signal.SIGKILL, "synthesizer ended with status -9"),
    ],
)
def test_a_session_continues_after_its_only_worker_hangs_or_crashes(
    system: System, service: str, blow: signal.Signals, text: str
) -> None:
    samples = samples_of_file(DEMO / "hello-female.wav")[:48000]
    undisturbed = stream_audio(system.control, samples)
    with Client(system.control) as client, client.open_session(encoding="f32le") as session:
        streamed = StreamedSession(session)
        streamed.send(samples[:24000], paced=True)
        failed = system.process(service)
        failed.send_signal(blow)
        streamed.send(samples[24000:], paced=True)
        streamed.finish()
        assert system.process(service) is not failed
    assert text in system.console.getvalue()
    wait_until(lambda: f"{service} is running again" in system.console.getvalue())
    assert {*undisturbed.times} <= {*streamed.times}


def test_a_wrong_configuration_ends_the_wait(tmp_path: Path) -> None:
    arguments = ["--config", str(tmp_path / "absent.toml")]
    supervisor = Supervisor(
        arguments, tmp_path, Console(file=io.StringIO()), services=("synthesizer",)
    )
    try:
        supervisor.start()
        supervisor.watch()
        with pytest.raises(UserError, match=r"synthesizer: .*absent\.toml"):
            supervisor.wait()
    finally:
        supervisor.stop()


STATUS = "document.getElementById('status').textContent"
WEBRTC_PAGE = ROOT / "docs" / "clients" / "webrtc.md"
# On a busy machine, the face may be behind.
IS_LIVE = f"/live|behind/.test({STATUS}) && window.kouxing.state.voiceToImageMs !== null"


@pytest.fixture(scope="module")
def browser(system: System, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    folder = tmp_path_factory.mktemp("browser")
    browser = Browser(folder, DEMO / "hello-female.wav", size_px=(320, 240))
    with browser.infrequent_drawing():
        browser.open(system.page)
        # Records all notices, including short ones.
        browser.evaluate(
            "window.notices = []; const notice = document.getElementById('notice');"
            "new MutationObserver(() => window.notices.push(notice.textContent))"
            ".observe(notice, { childList: true, characterData: true, subtree: true })"
        )
        yield browser
    browser.close()


@pytest.fixture
def live(browser: Browser) -> Browser:
    """The browser with a live microphone."""
    if browser.evaluate("document.getElementById('microphone').ariaPressed") == "false":
        browser.click("microphone")
    browser.wait_for(IS_LIVE)
    return browser


def test_shows_the_measured_delay(browser: Browser) -> None:
    assert browser.evaluate("window.kouxing.state.voiceToImageMs") is None
    assert "ms" not in browser.evaluate(STATUS)
    browser.click("microphone")
    browser.wait_for(IS_LIVE)
    browser.wait_for(rf"/(live \d+ m|behind.* \d+\.\d )s/.test({STATUS})")
    # Each frame comes 60 ms after its sound; the first number of the label is the delay.
    browser.wait_for("window.kouxing.state.voiceToImageMs > 60")
    assert browser.evaluate(rf"Number(({STATUS}.match(/live (\d+) ms/) ?? [0, 61])[1])") > 60


def test_reports_a_crash_and_the_microphone_continues(system: System, live: Browser) -> None:
    live.wait_for("document.getElementById('notice').textContent === ''")
    live.evaluate("window.notices = []")
    system.process("recognizer").kill()
    live.wait_for("window.notices.some((notice) => notice.includes('A service crashed'))")
    live.wait_for(f"window.kouxing.state.microphone && {IS_LIVE}")


def test_the_microphone_continues_in_a_new_session_after_the_gateway_crashed(
    system: System, live: Browser
) -> None:
    before = live.evaluate("window.kouxing.state.session")
    system.process("gateway").kill()
    is_new = f"window.kouxing.state.session !== '{before}'"
    live.wait_for(f"{is_new} && window.kouxing.state.microphone && {IS_LIVE}")


def test_the_script_in_the_documentation_speaks_over_webrtc(browser: Browser) -> None:
    (script,) = code_blocks(WEBRTC_PAGE, "js")
    browser.evaluate("window.logged = []; console.log = (value) => window.logged.push(value)")
    browser.evaluate("window.errors = []; onerror = (text) => void window.errors.push(text)")
    result = browser.command(
        "Runtime.evaluate", expression=script, replMode=True, awaitPromise=True
    )
    assert "exceptionDetails" not in result, result
    browser.wait_for("window.logged.some((value) => value > 0.1)")
    browser.wait_for("window.logged.filter((value) => typeof value === 'string').length > 5")
    assert browser.evaluate("window.errors") == []
    browser.evaluate("peer.close()")
