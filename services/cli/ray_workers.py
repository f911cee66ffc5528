"""Recognizers and synthesizers as actors of a Ray cluster.

Ray places the workers where there is a core for each, starts one again elsewhere when it or its
host is lost, and counts what they take. Each actor holds one worker process, which finds control
and speaks ZeroMQ as any other does: no sound and no frame passes through Ray.
"""

from __future__ import annotations

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

from kouxing.services.cli.service_process import LOOK_S, WORKED_S, ServiceProcess
from kouxing.services.cli.supervisor import ONE_THREAD
from kouxing.services.kinds import KINDS, ServiceKind
from kouxing.shared.config import Bound, Settings, bound_keys, variable
from kouxing.shared.errors import UserError
from kouxing.shared.keys import key_text, own_key
from kouxing.shared.service import DRAIN_LIMIT_S

NAMESPACE = "kouxing"  # of the actors' names
PLACED_WITHIN_S = 5.0  # otherwise there is no room


class Worker:
    """Holds one worker process; ends with it, so that Ray starts both again.

    One that hangs it ends.

    Parameters
    ----------
    kind
        One of ``kouxing.services.kinds.KINDS``.
    environment
        The worker's settings.
    key
        Content of its key file; empty where all is plain.
    """

    def __init__(self, kind: str, environment: Mapping[str, str], key: str) -> None:
        self._folder = Path(tempfile.mkdtemp(prefix="kouxing-"))
        if key:
            path = self._folder / f"{kind}.key"
            path.touch(mode=0o600)
            path.write_text(key, encoding="ascii")
        own = {
            "CREDENTIALS_DIRECTORY": str(self._folder),
            "XDG_STATE_HOME": str(self._folder),
        }
        self._draining = False
        self._process = ServiceProcess(
            kind,
            environment={**os.environ, **ONE_THREAD, **environment, **own},
            stdin=subprocess.DEVNULL,
        )
        threading.Thread(target=self._end_with_process, daemon=True).start()

    def process_number(self) -> int:
        """Return the process number of the worker."""
        return self._process.pid

    def host(self) -> str:
        """Return the address of the host that Ray chose."""
        return str(ray.util.get_node_ip_address())

    def drain(self) -> None:
        """Let the worker finish, then end for good."""
        self._draining = True
        self._process.terminate()
        self._process.wait()
        ray.actor.exit_actor()

    def _end_with_process(self) -> None:
        while (status := self._process.poll()) is None:
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(LOOK_S)
            if not self._draining and self._process.hangs(WORKED_S):
                self._process.kill()
        shutil.rmtree(self._folder)
        if not self._draining:
            os._exit(status or 1)


class RayWorkers:
    """The workers of one Ray cluster; they go on when this process ends.

    Parameters
    ----------
    address
        Of the cluster, as ``ray.init`` takes it.

    Raises
    ------
    UserError
        If no cluster is there.
    """

    def __init__(self, address: str) -> None:
        try:
            ray.init(address, namespace=NAMESPACE, log_to_driver=False, logging_level="error")
        except (ConnectionError, RuntimeError, ValueError) as error:
            raise UserError(
                f"no Ray cluster at {address!r}; 'ray start --head' begins one"
                f" ({str(error).partition('.')[0]})"
            ) from None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        ray.shutdown()

    def scale(self, kind: ServiceKind, number: int, settings: Settings) -> None:
        """Start workers of a kind that are missing; drain those with the highest numbers.

        Raises
        ------
        UserError
            If a setting is wrong, or the workers' key is missing.
        """
        is_plain = settings.load(kind.config_type).insecure
        key = "" if is_plain else key_text(own_key(kind.name, (f"service:{kind.name}",)))
        running = set(_names(kind.name))
        wanted = {f"{kind.name}-{index}" for index in range(number)}
        for name in sorted(wanted - running):
            ray.remote(Worker).options(
                name=name,
                lifetime="detached",
                num_cpus=1,  # a worker keeps one core busy at most
                max_restarts=-1,
                scheduling_strategy="SPREAD",
            ).remote(kind.name, _environment(kind, settings), key)
        surplus = [ray.get_actor(name) for name in running - wanted]
        drained = [each.drain.remote() for each in surplus]
        if drained:
            ray.wait(drained, num_returns=len(drained), timeout=DRAIN_LIMIT_S + 1.0)
        for each in surplus:
            ray.kill(each)  # one that waits for room, or did not finish

    def hosts(self) -> dict[str, str]:
        """Return where each worker runs, by its name; empty where there is no room for it yet."""
        names = [name for kind in KINDS for name in _names(kind)]
        answers = {ray.get_actor(name).host.remote(): name for name in names}
        if not answers:
            return {}
        placed, _ = ray.wait([*answers], num_returns=len(answers), timeout=PLACED_WITHIN_S)
        return dict.fromkeys(names, "") | {answers[each]: ray.get(each) for each in placed}


def _environment(kind: ServiceKind, settings: Settings) -> dict[str, str]:
    """Return what was set of a worker, and free ports for what was not."""
    environment = {}
    bound = bound_keys(kind.config_type)
    for each in settings.describe(kind.config_type):
        if each.origin != "default":
            environment[variable(kind.name, each.key)] = str(each.value)
        elif bound.get(each.key) is Bound.ENDPOINT:
            environment[variable(kind.name, each.key)] = "tcp://0.0.0.0:*"
    return environment


def _names(kind: str) -> list[str]:
    return sorted(name for name in ray.util.list_named_actors() if name.startswith(f"{kind}-"))
