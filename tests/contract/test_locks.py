"""All locked packages have hashes, and the locks contain all dependencies."""

import re
import tomllib
from collections.abc import Iterable
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from tests.system import ROOT

LOCKS = sorted(
    [*ROOT.glob("requirements*.lock"), *ROOT.glob("e*/*/requirements.lock")]  # examples, evaluation
)
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))
HASH = r"--hash=sha256:[0-9a-f]{64}"


def locked(*names: str) -> dict[str, str]:
    """Return the versions of the packages in locks; each entry must have hashes."""
    versions: dict[str, str] = {}
    for name in names:
        text = re.sub(r"#.*\n", "", (ROOT / name).read_text("utf-8")).replace(" \\\n", " ")
        for line in text.splitlines():
            match = re.fullmatch(rf"(\S+)==(\S+)( ; .*?)?((?: +{HASH})+)", line)
            assert match, f"{name}: {line}"
            versions[canonicalize_name(match[1])] = match[2]
    return versions


def assert_contains(versions: dict[str, str], requirements: Iterable[str]) -> None:
    for requirement in map(Requirement, requirements):
        if requirement.name != "kouxing":
            assert versions[canonicalize_name(requirement.name)] in requirement.specifier


@pytest.mark.parametrize("lock", LOCKS, ids=lambda path: str(path.relative_to(ROOT)))
def test_each_locked_package_has_hashes(lock: Path) -> None:
    assert locked(str(lock.relative_to(ROOT)))


def test_locks_contain_all_dependencies() -> None:
    project, build = PROJECT["project"], PROJECT["build-system"]["requires"]
    extras = project["optional-dependencies"]
    product = locked("requirements.lock")
    assert_contains(product, [*build, *project["dependencies"], *extras["page"]])
    everything = locked("requirements-torch.lock", "requirements-dev.lock")
    assert_contains(everything, sum(extras.values(), [*build, *project["dependencies"]]))
    assert product.items() <= everything.items()
    assert locked("requirements-torch-cpu.lock")["torch"] == f"{everything['torch']}+cpu"


def test_image_and_build_are_pinned() -> None:
    assert all(re.fullmatch(r"\S+==[\w.]+", name) for name in PROJECT["build-system"]["requires"])
    dockerfile = (ROOT / "deploy" / "Dockerfile").read_text("utf-8")
    sources = re.findall(r"^FROM (\S+)(?: AS (\w+))?$", dockerfile, re.MULTILINE)
    stages = {stage for _, stage in sources}
    for image, _ in sources:
        assert image in stages or re.fullmatch(r"\S+@sha256:[0-9a-f]{64}", image)
