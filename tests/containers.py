"""Containers without a container engine: processes with the isolation that a container would have.

Each has a network namespace and a file system that is read-only except for ``/tmp``. It gets the
environment, secrets and hosts of its description. Its user may only read this machine's Python.
"""

import contextlib
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest
from numba.core.caching import UserProvidedCacheLocator

from kouxing.evaluation.system.network import Network, NetworkLink
from kouxing.shared.errors import UserError
from tests.system import CODE_PATH, ROOT

USER_ID = 10001
READ_CAP = "+dac_read_search"
BECOME_USER = f"""
exec setpriv --reuid={USER_ID} --regid={USER_ID} --clear-groups --no-new-privs \
    --bounding-set=-all,{READ_CAP} --inh-caps=-all,{READ_CAP} --ambient-caps=-all,{READ_CAP} "$@"
"""
# Arguments: folder of numba's cache, folder of secrets, file of hosts, where the second folder is
# mounted if it is, the command.
ENTER_CONTAINER = f"""
mount --make-rprivate /
mount -t tmpfs tmpfs /run
mkdir /run/numba
mount --bind "$1" /run/numba
shift
cp "$2" /run/hosts
if test "$3"; then
    mkdir "$3"
    mount --bind "$1" "$3"
    mount -o remount,bind,ro "$3"
else
    mkdir /run/secrets
    cp "$1"/* /run/secrets
    chown {USER_ID} /run/secrets/*
    chmod 400 /run/secrets/*
fi
shift 3
mount --bind /run/hosts /etc/hosts
mount -t tmpfs -o noexec,nosuid,nodev tmpfs /tmp
cp -rT /run/numba "$NUMBA_CACHE_DIR"
chown -R {USER_ID} "$NUMBA_CACHE_DIR"
findmnt --raw --noheadings --output TARGET | grep -vE '^/(tmp|run|proc|sys|dev)(/|$)' |
    while read -r target; do mount -o remount,bind,ro "$target"; done
mount -o remount,bind,ro /run
{BECOME_USER}"""


@contextlib.contextmanager
def network_or_skip(hosts: Sequence[str], link: NetworkLink) -> Iterator[Network]:
    """Enter a network of virtual hosts; skip the test where namespaces are forbidden."""
    with contextlib.ExitStack() as stack:
        try:
            network = stack.enter_context(Network(hosts, link))
        except UserError as error:
            pytest.skip(str(error))
        yield network


def image_environment() -> dict[str, str]:
    """Return the variables that the image sets, without its paths of programs."""
    text = (ROOT / "deploy" / "Dockerfile").read_text("utf-8").replace("\\\n", " ")
    (line,) = re.findall(r"^ENV (.*)$", text, re.MULTILINE)
    variables = dict(item.split("=", 1) for item in line.split())
    return {name: value for name, value in variables.items() if name != "PATH"}


def write_numba_cache(folder: Path) -> None:
    """Copy the compiled functions of this checkout, as the image does: compiling takes long."""
    locator: Any = UserProvidedCacheLocator  # numba has no types
    for path in (ROOT / "services" / "recognizer").glob("*/__pycache__/*.nb[ic]"):
        module = ROOT / "kouxing" / path.relative_to(ROOT).parents[1] / "any.py"
        target = folder / locator.get_suitable_cache_subpath(str(module))
        target.mkdir(parents=True, exist_ok=True)
        shutil.copy(path, target)


class Containers:
    """Containers by name, on one network.

    Parameters
    ----------
    network
        Has a host for each container.
    names
        Host names that resolve inside the containers, and the hosts that they lead to.
    """

    def __init__(self, folder: Path, network: Network, names: Mapping[str, str]) -> None:
        self._folder = folder
        self._network = network
        self._numba = folder / "numba"
        write_numba_cache(self._numba)
        self._hosts = folder / "hosts"
        self._hosts.write_text(
            "127.0.0.1 localhost\n"
            + "".join(f"{network.address(host)} {name}\n" for name, host in names.items())
        )

    def start(
        self,
        host: str,
        arguments: Sequence[str],
        environment: Mapping[str, str],
        secrets: Mapping[str, Path],
        mounted: tuple[Path, str] | None = None,
    ) -> subprocess.Popen[bytes]:
        """Start ``kouxing`` with arguments in a container on a host; its output is in a log.

        ``mounted`` is a folder of keys and its path in the container; it replaces the secrets.
        """
        folder, target = mounted or (self._folder / f"{host}-secrets", "")
        if not mounted:
            folder.mkdir()
        for name, path in secrets.items():
            (folder / name).write_bytes(path.read_bytes())
        program = [sys.executable, "-m", "kouxing", *arguments]
        enter = ["unshare", "--mount", "sh", "-ec", ENTER_CONTAINER]
        enter += ["sh", str(self._numba), str(folder), str(self._hosts), target]
        own = {"PATH": "/usr/sbin:/usr/bin:/sbin:/bin", "PYTHONPATH": CODE_PATH}
        with self.log(host).open("ab") as log:
            return subprocess.Popen(
                self._network.command(host, *enter, *program),
                env={**own, **image_environment(), **environment},
                cwd=ROOT,
                stdout=log,
                stderr=log,
            )

    def log(self, host: str) -> Path:
        """Return the log of a container."""
        return self._folder / f"{host}.log"

    def is_healthy(self, host: str, check: Sequence[str]) -> bool:
        """Return whether a health check that starts Python succeeds in a container."""
        assert check[0] == "python"
        command = self._network.command(host, sys.executable, *check[1:])
        done = subprocess.run(command, check=False, stderr=subprocess.DEVNULL)
        return done.returncode == 0
