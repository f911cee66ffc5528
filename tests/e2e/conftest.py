"""A client of the running system, commands, a witness, and the page in a browser."""

import subprocess
import sys
from collections.abc import Iterator

import pytest
from kouxing_client import Client, Session

from kouxing.services.cli.main import main
from kouxing.shared.network.bus import Bus
from kouxing.shared.settings.keys import load_user_key
from tests.browser import Browser
from tests.e2e.page_actions import write_tone
from tests.e2e.page_control import PageControl
from tests.system import DEMO, LIMIT_S, ROOT, Gateway, System, samples_of_file, wait_until

PAGE = ROOT / "services" / "gateway" / "page"
HEADS = {"woman": PAGE / "head.glb", "man": PAGE / "head-man.glb"}


@pytest.fixture(autouse=True)
def _wait_for_last_phones(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let clients wait longer for the last phones on a busy machine."""
    monkeypatch.setattr("kouxing_client.session_core.END_TIMEOUT_S", LIMIT_S)


class CommandRunner:
    """Runs commands in this process."""

    def __init__(self, patch: pytest.MonkeyPatch, capture: pytest.CaptureFixture[str]) -> None:
        patch.setenv("COLUMNS", "200")
        self._patch, self._capture = patch, capture

    def __call__(self, *arguments: object) -> tuple[int | str | None, str, str]:
        """Return the exit status and what the command prints on stdout and stderr."""
        self._patch.setattr(sys, "argv", ["kouxing", *map(str, arguments)])
        with pytest.raises(SystemExit) as exit_info:
            main()
        return exit_info.value.code, *self._capture.readouterr()


@pytest.fixture
def command(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> CommandRunner:
    return CommandRunner(monkeypatch, capsys)


@pytest.fixture
def client(system: System) -> Iterator[Client]:
    with Client(system.control) as client:
        yield client


@pytest.fixture
def bus() -> Iterator[Bus]:
    """Sockets with the client's key, for messages that no client sends."""
    with Bus(load_user_key()) as client_bus:
        yield client_bus


@pytest.fixture
def witness(system: System, client: Client) -> Iterator[Session]:
    """Another session, which must continue after the test."""
    with client.open_session(encoding="f32le", paced=False) as session:
        output = session.frames()
        yield session
        session.push(samples_of_file(DEMO / "hello-female.wav")[:16000])
        wait_until(lambda: any(frame.media_time > 12000 for frame in output.available(0.1)))
    system.assert_all_alive()


@pytest.fixture(scope="module")
def control() -> Iterator[PageControl]:
    with PageControl() as control:
        yield control


@pytest.fixture(scope="module")
def gateway(control: PageControl) -> Iterator[Gateway]:
    for name, file in HEADS.items():
        if not file.is_file():
            command = [sys.executable, "-m", "kouxing", "head", "export", "--head", name]
            subprocess.run([*command, str(file)], cwd=ROOT, check=True)
    gateway = Gateway(control.address)
    wait_until(lambda: control.heartbeats)
    yield gateway
    assert gateway.stop() == 0


@pytest.fixture(scope="module")
def browser(gateway: Gateway, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    folder = tmp_path_factory.mktemp("browser")
    write_tone(folder / "tone.wav")
    browser = Browser(folder, folder / "tone.wav")
    yield browser
    browser.close()


@pytest.fixture(scope="module")
def page(browser: Browser, gateway: Gateway) -> Browser:
    """The browser with the loaded page."""
    browser.open(gateway.page)
    return browser


@pytest.fixture
def infrequent_drawing(page: Browser) -> Iterator[None]:
    """Save processor time in a test that looks at no image."""
    with page.infrequent_drawing():
        yield


@pytest.fixture(scope="module")
def session(control: PageControl, gateway: Gateway) -> Iterator[Session]:
    with Client(control.address, insecure=True) as client:
        yield client.open_session("seen")
