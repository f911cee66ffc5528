"""The voice assistant, an example that uses the gateway."""

from collections.abc import Iterator

import pytest

from kouxing.shared.wire.session import FlushSession
from tests.e2e.page_control import PageControl
from tests.system import ROOT, Gateway, start_python, wait_until

EXAMPLES = ROOT / "examples"


@pytest.fixture(scope="module")
def control() -> Iterator[PageControl]:
    with PageControl() as control:
        yield control


@pytest.fixture(scope="module")
def gateway(control: PageControl) -> Iterator[str]:
    """The gateway's address."""
    gateway = Gateway(control.address)
    wait_until(lambda: control.heartbeats)
    yield gateway.page.replace("http", "ws")
    assert gateway.stop() == 0


def test_the_assistant_can_be_interrupted(control: PageControl, gateway: str) -> None:
    program = EXAMPLES / "voice-assistant" / "assistant.py"
    with start_python(program, gateway) as assistant:
        assert assistant.stdin is not None
        assert assistant.stdout is not None

        def type_line(text: str) -> None:
            print(text, file=assistant.stdin, flush=True)

        session = assistant.stdout.readline().split()[-1]
        type_line("a very long question")
        wait_until(lambda: control.samples(session).any())
        assert not control.of(FlushSession)
        type_line("no")
        wait_until(lambda: control.sessions_of(FlushSession) == [session])
        output, log = assistant.communicate(timeout=60)
    assert assistant.returncode == 0, log
    assert output.split("\n")[:3] == ["answer 1", "interrupted", "answer 2"]
    assert control.has_ended(session)
    spoken_s = len(control.samples(session)) / 16000
    assert spoken_s < 0.2 * len("you said a very long question") + 0.2 * len("you said no")
