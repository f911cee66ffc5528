"""Runs recognizers and synthesizers as actors of a Ray cluster.

Ray places each worker on a host with a free core. If a worker or its host is lost, Ray restarts
the worker elsewhere. Each actor runs one worker process. That process finds control and uses ZeroMQ
as usual, so no audio and no frames pass through Ray.
"""

import contextlib
import os
import shutil
import subprocess
import tempfile
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Self

import ray

from kouxing.services.cli.launch.service_process import POLL_S, ServiceProcess
from kouxing.services.service_kinds import KINDS
from kouxing.shared.errors import UserError
from kouxing.shared.service.base import DRAIN_TIMEOUT_S
from kouxing.shared.service.service_kind import ServiceKind
from kouxing.shared.settings.config import BindAddress, Settings, bound_keys, variable_name
from kouxing.shared.settings.keys import format_key, load_key

NAMESPACE = "kouxing"  # namespace of the actors' names
PLACEMENT_TIMEOUT_S = 60.0  # maximum wait for Ray to start one actor per core


class Worker:
    """Runs one worker process. The actor ends with the process, so that Ray restarts both.

    ``key`` is the content of the key file, empty if the system is insecure.
    """

    def __init__(self, kind: str, environment: Mapping[str, str], key: str) -> None:
        self._folder = Path(tempfile.mkdtemp(prefix="kouxing-"))
        if key:
            path = self._folder / f"{kind}.key"
            path.touch(mode=0o600)
            path.write_text(key, encoding="ascii")
        folders = dict.fromkeys(("CREDENTIALS_DIRECTORY", "XDG_STATE_HOME"), str(self._folder))
        self._draining = False
        self._process = ServiceProcess(
            kind, environment={**os.environ, **environment, **folders}, stdin=subprocess.DEVNULL
        )
        threading.Thread(target=self._watch_process, daemon=True).start()

    def host(self) -> str:
        """Return the address of the host that Ray chose."""
        return str(ray.util.get_node_ip_address())

    def drain(self) -> None:
        """Wait until the worker has finished, then end the actor permanently."""
        self._draining = True
        self._process.terminate()
        self._process.wait()
        ray.actor.exit_actor()

    def _watch_process(self) -> None:
        while (status := self._process.poll()) is None:
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(POLL_S)
            self._process.read_heartbeats()
            if not self._draining and self._process.is_hung:
                self._process.kill()
        shutil.rmtree(self._folder)
        if not self._draining:
            os._exit(status or 1)


class RayWorkers:
    """The workers of a Ray cluster. They continue to run after this process has ended.

    Raises ``UserError`` if no cluster is found at ``$RAY_ADDRESS``, by default on this host.
    """

    def __init__(self) -> None:
        try:
            ray.init("auto", namespace=NAMESPACE, log_to_driver=False, logging_level="error")
        except (ConnectionError, RuntimeError, ValueError) as error:
            raise UserError(
                "no Ray cluster was found; start one with 'ray start --head', or set RAY_ADDRESS"
                f" ({str(error).partition('.')[0]})"
            ) from None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        ray.shutdown()

    def scale(self, kind: ServiceKind, number: int, settings: Settings) -> None:
        """Start or drain workers of a kind until ``number`` of them remain.

        Raises ``UserError`` if a setting is wrong, or the workers' key is missing.
        """
        insecure = settings.load(kind.config_type).insecure
        key = "" if insecure else format_key(load_key(kind.name, (f"service:{kind.name}",)))
        running = set(_worker_names(kind.name))
        wanted = {f"{kind.name}-{index}" for index in range(number)}
        for name in sorted(wanted - running):
            ray.remote(Worker).options(
                name=name,
                lifetime="detached",
                num_cpus=1,  # a worker uses at most one core
                max_restarts=-1,
                scheduling_strategy="SPREAD",
            ).remote(kind.name, _environment(kind, settings), key)
        surplus = [ray.get_actor(name) for name in running - wanted]
        drained = [actor.drain.remote() for actor in surplus]
        if drained:
            ray.wait(drained, num_returns=len(drained), timeout=DRAIN_TIMEOUT_S + 1.0)
        for actor in surplus:
            ray.kill(actor)  # the worker has no host yet, or did not finish

    def hosts(self) -> dict[str, str]:
        """Wait until the workers start; return each worker's host, or why it has no host."""
        names = [name for kind in KINDS for name in _worker_names(kind)]
        answers = {ray.get_actor(name).host.remote(): name for name in names}
        num_cores = int(ray.cluster_resources().get("CPU", 0))
        num_ready = min(len(answers), num_cores)
        placed = []
        if num_ready:
            placed, _ = ray.wait([*answers], num_returns=num_ready, timeout=PLACEMENT_TIMEOUT_S)
        if len(placed) == num_cores:
            reason = "waits for a free core"
        elif ray.available_resources().get("CPU", 0) >= 1:
            reason = "is starting"
        else:
            reason = "is starting, or waits for a core that another program uses"
        return dict.fromkeys(names, reason) | {answers[host]: _host(host) for host in placed}


def _host(answer: ray.ObjectRef) -> str:
    try:
        return str(ray.get(answer))
    except ray.exceptions.RayError:
        return "is restarting"


def _environment(kind: ServiceKind, settings: Settings) -> dict[str, str]:
    """Return a worker's settings that differ from the defaults, and free ports for the others."""
    environment = {}
    bound = bound_keys(kind.config_type)
    for setting in settings.describe(kind.config_type):
        if not setting.is_default:
            environment[variable_name(kind.name, setting.key)] = setting.text
        elif bound.get(setting.key) is BindAddress.ENDPOINT:
            environment[variable_name(kind.name, setting.key)] = "tcp://0.0.0.0:*"
    return environment


def _worker_names(kind: str) -> list[str]:
    return sorted(name for name in ray.util.list_named_actors() if name.startswith(f"{kind}-"))
