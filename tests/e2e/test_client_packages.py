"""The client libraries, installed from what is built of them, against a running system."""

from __future__ import annotations

import functools
import http.server
import json
import os
import re
import shutil
import subprocess
import sys
import threading
import time
import venv
import wave
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from shared.client import Client
from tests.browser import Browser
from tests.e2e.following import samples_of_file
from tests.glb_writer import Mesh, write_glb
from tests.scripted_system import Gateway
from tests.system import DEMO, ROOT, System, free_port

pytestmark = pytest.mark.e2e
SPEECH = DEMO / "hello-female.wav"
NODE = Path(sys.executable).with_name("node")
JAVASCRIPT_CLIENT = ROOT / "clients" / "javascript"
PYTHON_CLIENT = ROOT / "clients" / "python"


def pip(*arguments: object) -> None:
    command = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check"]
    subprocess.run([*command, *map(str, arguments)], check=True)


def examples(document: Path, language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", document.read_text("utf-8"), re.DOTALL)


def run_example(command: list[object], **environment: str) -> list[str]:
    """Run an example of a README on a sentence; return the lines that it prints."""
    result = subprocess.run(
        list(map(str, command)),
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert result.returncode == 0, result.stderr
    return result.stdout.splitlines()


@pytest.fixture(scope="module")
def python(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a Python that has the built package and what it needs, and nothing else."""
    folder = tmp_path_factory.mktemp("python")
    source = shutil.copytree(PYTHON_CLIENT, folder / "source")  # building writes beside it
    pip("wheel", "--no-build-isolation", "--no-deps", "--wheel-dir", folder, source)
    (wheel,) = folder.glob("kouxing_client-*.whl")
    venv.create(folder / "venv")
    python = folder / "venv" / "bin" / "python"
    pip("--python", python, "install", wheel)
    return python


def test_the_python_package_speaks_a_file(system: System, python: Path, tmp_path: Path) -> None:
    plain, awaited = examples(PYTHON_CLIENT / "README.md", "python")
    (tmp_path / "plain.py").write_text(plain, encoding="utf-8")
    (tmp_path / "awaited.py").write_text(awaited, encoding="utf-8")
    control = system.control.partition(" ")[0]
    jaw = run_example([python, "-I", tmp_path / "plain.py", SPEECH], KOUXING_CONTROL=control)
    assert len(jaw) > 100
    assert max(float(line.split()[-1]) for line in jaw) > 200
    phones = run_example([python, "-I", tmp_path / "awaited.py", SPEECH], KOUXING_CONTROL=control)
    assert [line.split()[-1] for line in phones[:4]] == ["n", "i", "h", "ao"]


def test_the_python_package_brings_its_types_and_needs_two_packages(python: Path) -> None:
    site = python.parent.parent / "lib" / f"python3.{sys.version_info.minor}" / "site-packages"
    assert (site / "kouxing_client" / "py.typed").is_file()
    installed = {path.name.partition("-")[0] for path in site.glob("*.dist-info")}
    assert installed == {"kouxing_client", "msgpack", "pyzmq"}


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a project that has installed the packed package."""
    folder = tmp_path_factory.mktemp("javascript")
    source = folder / "source" / "clients" / "javascript"
    shutil.copytree(JAVASCRIPT_CLIENT, source, ignore=shutil.ignore_patterns("node_modules"))
    page = "services/gateway/page"
    (folder / "source" / page).parent.mkdir(parents=True)
    (folder / "source" / page).symlink_to(ROOT / page)
    project = folder / "project"
    project.mkdir()
    (project / "package.json").write_text("{}", encoding="utf-8")
    npm(source, "pack", "--pack-destination", project)
    (package,) = project.glob("kouxing-client-*.tgz")
    npm(project, "install", "--offline", "--omit=peer", package)
    for module in ("three", "@pixiv"):
        (project / "node_modules" / module).symlink_to(JAVASCRIPT_CLIENT / "node_modules" / module)
    return project


def npm(folder: Path, *arguments: object) -> None:
    quietly = ("--no-audit", "--no-fund", "--loglevel=error")
    subprocess.run(
        [NODE.with_name("npm"), *quietly, *map(str, arguments)],
        cwd=folder,
        env={**os.environ, "PATH": f"{NODE.parent}:{os.environ['PATH']}"},
        check=True,
    )


@pytest.fixture(scope="module")
def site(project: Path) -> Iterator[str]:
    """Serve the project to a browser; yields the origin."""

    class Quiet(http.server.SimpleHTTPRequestHandler):
        def log_message(self, *_: object) -> None:
            pass

    handler = functools.partial(Quiet, directory=str(project))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()
        thread.join()


@pytest.fixture(scope="module")
def gateway(system: System, site: str) -> Iterator[Gateway]:
    gateway = Gateway(system.control, free_port(), allowed_origins=site)
    system.wait_until(lambda report: "gateway" in {each.service for each in report.services})
    yield gateway
    gateway.stop()


def test_the_javascript_package_works_in_node(project: Path, gateway: Gateway) -> None:
    shutil.copy(JAVASCRIPT_CLIENT / "tests" / "client.test.js", project / "client.test.mjs")
    result = subprocess.run(
        [NODE, "--test", project / "client.test.mjs"],
        env={**os.environ, "GATEWAY": gateway.page, "SPEECH": str(SPEECH)},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert result.returncode == 0, result.stdout
    (example,) = examples(JAVASCRIPT_CLIENT / "README.md", "js")
    (project / "example.mjs").write_text(example, encoding="utf-8")
    wav = project / "two-seconds.wav"  # it is spoken in real time
    with wave.open(str(SPEECH)) as whole, wave.open(str(wav), "wb") as part:
        part.setparams(whole.getparams())
        part.writeframes(whole.readframes(2 * whole.getframerate()))
    lines = run_example([NODE, project / "example.mjs", wav], GATEWAY=gateway.page)
    assert max(float(line.split()[-1]) for line in lines if "jaw" in line) > 200
    assert [line.split()[-1] for line in lines if "phone" in line][:4] == ["n", "i", "h", "ao"]


LIPS = np.array([[-0.1, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.1, 0.0]])
DOWN = np.array([[0.0, -0.1, 0.0], [0.0, -0.1, 0.0], [0.0, 0.0, 0.0]])
TOWARDS = np.array([[0.0, 0.0, 1.0]] * 3)
TRIANGLE = np.array([[0, 1, 2]])
BONES = (
    *("hips", "spine", "head"),
    *(side + limb for side in ("left", "right") for limb in ("UpperArm", "LowerArm", "Hand")),
    *(side + limb for side in ("left", "right") for limb in ("UpperLeg", "LowerLeg", "Foot")),
)


def write_face(path: Path, shape: str, *nodes: dict[str, Any], **rest: Any) -> None:
    """Write a mouth of one triangle that a shape opens; it comes behind other nodes."""
    targets = {shape: DOWN} if shape else {}
    mouth = Mesh("mouth", LIPS, TRIANGLE, targets, normals=TOWARDS)
    scenes = [{"nodes": list(range(len(nodes) + 1))}]
    write_glb(path, [mouth], nodes=list(nodes), scenes=scenes, **rest)


def write_faces(folder: Path) -> None:
    """Write a head as ``kouxing head export`` does, one with ARKit's shape, a VRM and no face."""
    faps = [{"name": "open_jaw", "number": 3, "unitsPerWeight": 500.0}]
    camera = {"target": [0, 0, 0], "position": [0, 0, 1], "fovYDegrees": 20}
    about = {"name": "kouxing", "extras": {"kouxing": {"faps": faps, "camera": camera}}}
    write_face(folder / "own.glb", "open_jaw", about)
    write_face(folder / "arkit.glb", "Face.jawOpen")
    vrm = {
        "specVersion": "1.0",
        "meta": {"name": "x", "authors": ["x"], "licenseUrl": "https://vrm.dev/licenses/1.0/"},
        "humanoid": {"humanBones": {name: {"node": node} for node, name in enumerate(BONES)}},
        "expressions": {
            "preset": {
                "aa": {"morphTargetBinds": [{"node": len(BONES), "index": 0, "weight": 1.0}]}
            }
        },
    }
    bones = [{"name": name} for name in BONES]
    extension = {"extensionsUsed": ["VRMC_vrm"], "extensions": {"VRMC_vrm": vrm}}
    write_face(folder / "avatar.vrm", "a", *bones, **extension)
    write_face(folder / "none.glb", "")


def write_recording(path: Path, shapes: str, name: str) -> None:
    lines = [
        {"time_s": number / 50, "sequence": number, shapes: {name: number / 10}}
        for number in range(11)
    ]
    path.write_text("\n".join(map(json.dumps, lines)), encoding="utf-8")


def test_the_web_component_lets_models_speak(
    project: Path, site: str, gateway: Gateway, system: System, tmp_path: Path
) -> None:
    write_faces(project)
    write_recording(project / "arkit.jsonl", "arkit", "jawOpen")
    write_recording(project / "vrm.jsonl", "vrm", "aa")
    (page,) = examples(JAVASCRIPT_CLIENT / "README.md", "html")
    faces = {
        "own": f'src="own.glb" gateway="{gateway.page}" session="seen"',
        "arkit": 'src="arkit.glb" recording="arkit.jsonl"',
        "vrm": 'src="avatar.vrm" recording="vrm.jsonl"',
        "live": f'src="arkit.glb" gateway="{gateway.page}" session="seen"',
        "none": 'src="none.glb"',
    }
    listen = "onerror='this.failure = event.message'"
    elements = [
        f"<kouxing-face id={name} {listen} style='width: 100px'{attributes}></kouxing-face>"
        for name, attributes in faces.items()
    ]
    page = re.sub(r"<kouxing-face.*</kouxing-face>", "".join(elements), page)
    (project / "index.html").write_text(
        f"<!doctype html><link rel=icon href='data:,'><body style='margin: 0'>{page}",
        encoding="utf-8",
    )
    browser = Browser(tmp_path, SPEECH)
    try:
        browser.command("Page.navigate", url=f"{site}/index.html")
        browser.wait_for("['own', 'arkit', 'vrm', 'live'].every((name) => window[name]?.set)")
        sets = browser.evaluate("['own', 'arkit', 'vrm'].map((name) => window[name].set)")
        assert sets == ["faps", "arkit", "vrm"]
        browser.wait_for("none.failure?.includes('no morph targets')")
        before = browser.steady_image()
        browser.evaluate("Promise.all([arkit.play(), vrm.play()])")
        assert browser.evaluate("[arkit.shown.jawOpen, vrm.shown.aa]") == [1, 1]
        after = browser.steady_image()
        for row in (1, 2):
            part = np.s_[100 * row : 100 * (row + 1), :100]
            assert not np.array_equal(before[part], after[part])
        browser.evaluate(
            "window.most = window.widest = 0; setInterval(() => {"
            " most = Math.max(most, own.shown?.[2] ?? 0);"
            " widest = Math.max(widest, live.shown?.jawOpen ?? 0); }, 10)"
        )
        samples = samples_of_file(SPEECH)[:24000]
        with Client(system.control) as client:
            session = client.open_session(session="seen", encoding="f32le")
            for begin in range(0, len(samples), 1600):
                session.send(samples[begin : begin + 1600])
                time.sleep(0.1)
            browser.wait_for("most > 200 && widest > 0.1")
            session.close()
        driver = "GL Driver Message"  # the processor draws
        assert [each for each in browser.complaints if driver not in each] == []
    finally:
        browser.close()
