"""Running services for tests: real processes, real sockets, reserved ports."""

import atexit
import contextlib
import io
import os
import signal
import socket
import subprocess
import sys
import time
from collections import deque
from collections.abc import Callable, Collection, Mapping
from functools import cache
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
from kouxing_client import Client, KouxingError, Status
from numpy.typing import NDArray
from rich.console import Console

from kouxing.evaluation.system.systems import LocalSystem
from kouxing.services.cli.launch.service_process import ServiceProcess
from kouxing.services.service_kinds import KINDS, free_port_environment, kind_of
from kouxing.shared.audio.audio_file import read_audio
from kouxing.shared.settings.config import variable_name

ROOT = Path(__file__).parents[1]
DEMO = ROOT / "shared" / "demo"
VOWELS_FILE = ROOT / "tests" / "sounds" / "vowels-male.wav"  # a o e i u ü, with pauses between
CHAIN = ("control", "recognizer", "synthesizer")
SERVICE = ("-m", "kouxing.services.process")
NODE = Path(sys.executable).with_name("node")
CODE_PATH = os.pathsep.join([str(ROOT), str(ROOT / "clients" / "python")])  # for PYTHONPATH
LIMIT_S = 120.0  # for anything that takes seconds on an idle machine
SKIP_NO_AUDIO = {  # on a busy machine
    "KOUXING_MAX_LAG_S": "3600",
}
LONG_TIMEOUTS = {"KOUXING_CONTROL_LOST_AFTER_S": "60"}  # no service is lost on a busy machine
ADMIT_ANY_LOAD = {"KOUXING_CONTROL_MAX_LOAD": "1000"}  # and no session is rejected
LIGHT_MODEL = {"KOUXING_RECOGNIZER_ACOUSTIC": "light"}  # needs half of the processor time
BLOCK_NETWORK = {"KOUXING_RECOGNIZER_ACOUSTIC": "blocks"}
ONE_THREAD = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "LP_NUM_THREADS": "1"}
VIDEO_RATE_HZ = 10
MAX_RESERVATIONS = 50

_reservations: deque[contextlib.ExitStack] = deque()  # of ports
_udp_ports = iter(range(20_000 + os.getpid() % 10_000, 32_000))


def samples_of_file(path: Path) -> NDArray[np.float32]:
    """Return a mono recording at 16 kHz; each file is decoded only once."""
    return _decode_file(path).copy()


@cache
def _decode_file(path: Path) -> NDArray[np.float32]:
    samples, rate_hz = read_audio(path)
    assert rate_hz == 16_000
    return samples[:, 0]


HELLO = samples_of_file(DEMO / "hello-female.wav")[:24_000]  # 1.5 s
# Runs the command line. Programs that a shell starts in the background ignore Ctrl-C.
CTRL_C_COMMAND = """
import signal
signal.signal(signal.SIGINT, signal.default_int_handler)
from kouxing.__main__ import main
main()
"""


def free_port() -> int:
    """Return a port that no other program is given before a test binds it."""
    reservation = contextlib.ExitStack()
    reserved = reservation.enter_context(socket.socket())
    reserved.bind(("127.0.0.1", 0))
    # The socket does not listen, so a server, which also sets this option, can bind the port.
    reserved.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    _keep(reservation)
    return int(reserved.getsockname()[1])


def free_udp_port() -> int:
    """Return a UDP port, for a test that binds it later or needs one that nobody binds.

    The system gives programs only higher ports. The TCP port of this number is reserved, so other
    processes of the tests choose another one.
    """
    for port in _udp_ports:
        with contextlib.ExitStack() as reservation, contextlib.suppress(OSError):
            reservation.enter_context(socket.socket()).bind(("127.0.0.1", port))
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
                probe.bind(("127.0.0.1", port))
            _keep(reservation.pop_all())
            return port
    raise AssertionError("all ports are in use")


def own_addresses(
    names: Collection[str] = tuple(KINDS), hosts: Mapping[str, str] | None = None
) -> dict[str, str]:
    """Return an environment in which services bind ports that no other program is given."""
    reservations = contextlib.ExitStack()
    addresses = free_port_environment(names, hosts, reservations)
    _keep(reservations)
    return addresses


def _keep(reservation: contextlib.ExitStack) -> None:
    _reservations.append(reservation)
    if len(_reservations) > MAX_RESERVATIONS:
        _reservations.popleft().close()


@atexit.register
def _release_ports() -> None:
    while _reservations:
        _reservations.pop().close()


def child_environment() -> dict[str, str]:
    """Return an environment in which programs use the code of this checkout."""
    return {**os.environ, **ONE_THREAD, "PYTHONPATH": CODE_PATH}


def own_environment(folder: Path) -> dict[str, str]:
    """Return an environment in which ``kouxing run`` uses free ports and has no window."""
    own = {"XDG_RUNTIME_DIR": str(folder), **SKIP_NO_AUDIO}  # commands find the system there
    return {
        **child_environment(),
        **headless_settings(folder),
        **ADMIT_ANY_LOAD,
        **own_addresses(),
        **own,
    }


def headless_settings(folder: Path) -> dict[str, str]:
    """Return the settings of a driver that has no window and writes small, cheap videos."""
    return {
        "KOUXING_DRIVER_VIEW": "none",
        "KOUXING_DRIVER_OUT": str(folder),
        "KOUXING_DRIVER_SIZE": "160x120",
        "KOUXING_DRIVER_FRAME_RATE_HZ": str(VIDEO_RATE_HZ),
    }


def wait_until(
    condition: Callable[[], object],
    limit_s: float = LIMIT_S,
    *,
    step: Callable[[], object] = lambda: time.sleep(0.01),
) -> None:
    """Wait until a condition holds; call ``step`` before each check."""
    end_s = time.monotonic() + limit_s
    while not condition():
        if time.monotonic() > end_s:
            raise TimeoutError
        step()


def kouxing(
    *arguments: object,
    control: str = "",
    environment: dict[str, str] | None = None,
    stdin: bytes | None = None,
) -> subprocess.CompletedProcess[str]:
    """Run the command line to its end; no input may cause a traceback."""
    environment = {**child_environment(), "COLUMNS": "200", **(environment or {})}
    if control:
        environment["KOUXING_CONTROL"] = control.partition(" ")[0]
    result = subprocess.run(
        [sys.executable, "-m", "kouxing", *map(str, arguments)],
        env=environment,
        cwd=ROOT,
        capture_output=True,
        input=stdin,
        timeout=250,
        check=False,
    )
    texts = (result.stdout.decode(), result.stderr.decode())
    assert "Traceback" not in texts[1], texts[1]
    return subprocess.CompletedProcess(result.args, result.returncode, *texts)


def start_python(
    *arguments: object, control: str = "", **environment: str
) -> subprocess.Popen[str]:
    """Start Python with pipes; a service is ``*SERVICE, KIND``."""
    if control:
        environment["KOUXING_CONTROL"] = control.partition(" ")[0]
    return subprocess.Popen(
        [sys.executable, *map(str, arguments)],
        env={**child_environment(), **environment},
        cwd=ROOT,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


class System(LocalSystem):
    """Services in processes, with the light model unless ``settings`` name another.

    A service that ends restarts only if ``restarts`` is set.
    """

    def __init__(
        self,
        services: Collection[str],
        folder: Path,
        settings: Mapping[str, str] | None = None,
        *,
        hosts: Mapping[str, str] | None = None,
        restarts: bool = False,
    ) -> None:
        self.folder = folder
        addresses = own_addresses(services, hosts)
        named = [] if restarts else [name for name in services if name != "control"]
        self.ports = {int(address.rpartition(":")[2]) for address in addresses.values()}
        self.page = f"http://127.0.0.1:{addresses.get('KOUXING_GATEWAY_PORT')}/"
        self.console = io.StringIO()
        self.running = {*services}  # services that must not end
        super().__init__(
            folder,
            Console(file=self.console, width=200),
            services=services,
            settings={
                **headless_settings(folder),
                **LONG_TIMEOUTS,
                **SKIP_NO_AUDIO,
                **ADMIT_ANY_LOAD,
                **LIGHT_MODEL,
                **addresses,
                **{variable_name(name, "instance"): name for name in named},
                **(settings or {}),
            },
        )
        self._restarts = restarts

    def __exit__(self, *exc: object) -> None:
        for name in self.running:
            with contextlib.suppress(KeyError, ProcessLookupError):  # it did not start
                self.process(name).send_signal(signal.SIGCONT)
        super().__exit__(*exc)

    def process(self, name: str) -> ServiceProcess:
        return self.supervisor.process(name)

    def add(self, name: str, **settings: str) -> None:
        """Start a worker such as ``recognizer-2``, and wait until control has registered it."""
        kind = kind_of(name)
        instance = {variable_name(kind, "instance"): name}
        self.start(name, **own_addresses([kind]), **instance, **settings)
        self.wait_until(lambda report: name in {state.instance for state in report.services})

    def start(self, name: str, **settings: str) -> None:
        """Start a service, or start it again."""
        self.supervisor.start_service(name, settings)
        self.running.add(name)

    def lose(self, name: str, number: signal.Signals = signal.SIGKILL) -> ServiceProcess:
        """Signal a service that may end."""
        self.running.remove(name)
        process = self.process(name)
        process.send_signal(number)
        return process

    def log(self, name: str) -> str:
        return (self.folder / f"{name}.log").read_text(encoding="utf-8")

    def wait_until(self, condition: Callable[[Status], bool], deadline_s: float = 110.0) -> None:
        """Wait until control's report meets a condition; no service may end in the meantime."""
        end_s = time.monotonic() + deadline_s
        newest: object = "no status report"
        with Client(self.control, timeout_s=2.0) as client:
            while time.monotonic() < end_s:
                self.assert_all_alive()
                with contextlib.suppress(KouxingError):  # control is restarting
                    report = client.status()
                    if condition(report):
                        return
                    services = {state.instance: state.state for state in report.services}
                    newest = services, report.sessions
                time.sleep(0.05)
        raise AssertionError(f"the condition does not become true: {newest}")

    def status(self) -> Status:
        """Return the status report of control."""
        with Client(self.control, timeout_s=LIMIT_S, start_s=LIMIT_S) as client:
            return client.status()

    def endpoints(self) -> dict[str, str]:
        """Return the endpoint of every socket of the services, with its key, by name."""
        services = self.status().services
        return {name: endpoint for state in services for name, endpoint in state.endpoints.items()}

    def assert_all_alive(self) -> None:
        for name in self.running:
            assert self.process(name).poll() is None, f"{name} ended: {self.log(name)}"


class Gateway:
    """A gateway process with settings by key, without keys if control has none."""

    def __init__(self, control: str, *program: str, **settings: str) -> None:
        port = free_port()
        scheme = "https" if "https" in settings else "http"
        self.page = f"{scheme}://127.0.0.1:{port}/"
        settings = {
            "port": str(port),
            "insecure": str(" " not in control),
            "log_level": "error",
            **settings,
        }
        self._program = program or (*SERVICE, "gateway")
        self._control = control
        self._environment = {
            variable_name("gateway", key): value for key, value in settings.items()
        }
        self.start()

    def start(self) -> None:
        self.process = start_python(*self._program, control=self._control, **self._environment)
        wait_until(lambda: can_connect(port_of(self.page)))

    def stop(self) -> int:
        self.process.terminate()
        self.process.communicate(timeout=LIMIT_S)
        return self.process.returncode


def can_connect(port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0


def port_of(page: str) -> int:
    """Return the port of a page."""
    return urlsplit(page).port or 0
