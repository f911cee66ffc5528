"""The client libraries, installed from what is built of them, against a running system."""

import json
import os
import re
import shutil
import subprocess
import sys
import sysconfig
import venv
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import soundfile
from kouxing_client import Session

from kouxing.evaluation.system.chromium import serve_folder
from kouxing.shared.face.shapes import SHAPE_SETS
from tests.browser import Browser
from tests.documents import code_blocks
from tests.e2e.page_actions import A_FACE
from tests.e2e.page_control import PageControl
from tests.glb_writer import BONES, Mesh, add_vrm, read_chunks, write_chunks, write_glb
from tests.system import CHAIN, DEMO, NODE, ROOT, Gateway, System, samples_of_file

SPEECH = DEMO / "hello-female.wav"
JAVASCRIPT_CLIENT = ROOT / "clients" / "javascript"
PYTHON_CLIENT = ROOT / "clients" / "python"


@pytest.fixture(scope="module")
def services() -> Collection[str]:
    return (*CHAIN, "gateway")


def run_program(*command: object, cwd: Path | None = None, **environment: str) -> list[str]:
    """Run a program that must succeed; return the lines that it prints."""
    result = subprocess.run(
        list(map(str, command)),
        cwd=cwd,
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        timeout=250,
        check=False,
    )
    assert result.returncode == 0, result.stdout + result.stderr
    return result.stdout.splitlines()


@pytest.fixture(scope="module")
def python(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a Python that has only the built package and its dependencies."""
    folder = tmp_path_factory.mktemp("python")
    source = shutil.copytree(PYTHON_CLIENT, folder / "source")  # the build writes next to it
    pip("wheel", "--no-build-isolation", "--no-deps", "--wheel-dir", folder, source)
    (wheel,) = folder.glob("kouxing_client-*.whl")
    venv.create(folder / "venv")
    python = folder / "venv" / "bin" / "python"
    pip("--python", python, "install", "--no-index", "--no-deps", wheel)
    installed = Path(sysconfig.get_path("purelib"))
    for pattern in ("msgspec*", "pyzmq*", "zmq"):  # instead of a download
        for path in installed.glob(pattern):
            (site_packages(python) / path.name).symlink_to(path)
    pip("--python", python, "check")
    return python


def site_packages(python: Path) -> Path:
    (folder,) = (python.parent.parent / "lib").glob("python*/site-packages")
    return folder


@pytest.fixture(scope="module")
def speech(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A second of speech: the gateway drops what a busy viewer does not read in time."""
    path = tmp_path_factory.mktemp("speech") / "speech.wav"
    soundfile.write(path, samples_of_file(SPEECH)[:16000], 16000)
    return path


def test_the_python_package_speaks_a_file(
    system: System, python: Path, speech: Path, tmp_path: Path
) -> None:
    control = system.control.partition(" ")[0]
    outputs = []
    for number, example in enumerate(code_blocks(PYTHON_CLIENT / "README.md", "python")):
        program = tmp_path / f"example{number}.py"
        program.write_text(example, encoding="utf-8")
        outputs.append(run_program(python, "-I", program, speech, KOUXING_CONTROL=control))
    jaw, phones = outputs
    assert max(float(line.split()[-1]) for line in jaw) > 200
    assert [line.split()[-1] for line in phones[:4]] == ["n", "i", "h", "ao"]
    assert (site_packages(python) / "kouxing_client" / "py.typed").is_file()
    (packed,) = site_packages(python).glob("kouxing_client-*/licenses/LICENSE")
    assert packed.read_bytes() == (ROOT / "LICENSE").read_bytes()


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a project that has installed the packed package."""
    folder = tmp_path_factory.mktemp("javascript")
    source = folder / "source" / "clients" / "javascript"
    shutil.copytree(JAVASCRIPT_CLIENT, source, ignore=shutil.ignore_patterns("node_modules"))
    (folder / "source" / "services" / "gateway").mkdir(parents=True)
    for name in ("services/gateway/page", "LICENSE", "NOTICE"):
        (folder / "source" / name).symlink_to(ROOT / name)
    project = folder / "project"
    project.mkdir()
    (project / "package.json").write_text("{}", encoding="utf-8")
    npm(source, "pack", "--pack-destination", project)
    (package,) = project.glob("kouxing-client-*.tgz")
    shutil.rmtree(source / "page")
    npm(project, "install", "--offline", "--omit=peer", source)  # a link to the folder
    assert {path.name for path in (source / "page").iterdir()} >= {"playout.js", "player.js"}
    npm(project, "install", "--offline", "--omit=peer", package)
    for module in ("three", "@pixiv"):
        (project / "node_modules" / module).symlink_to(JAVASCRIPT_CLIENT / "node_modules" / module)
    return project


def pip(*arguments: object) -> None:
    run_program(sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check", *arguments)


def npm(folder: Path, *arguments: object) -> None:
    quietly = ("--no-audit", "--no-fund", "--loglevel=error")
    path = f"{NODE.parent}:{os.environ['PATH']}"
    run_program(NODE.with_name("npm"), *quietly, *arguments, cwd=folder, PATH=path)


@pytest.fixture(scope="module")
def site(project: Path) -> Iterator[str]:
    """Serve the project to a browser; yields the origin."""
    with serve_folder(project) as origin:
        yield origin


@pytest.fixture(scope="module")
def gateway(control: PageControl, site: str) -> Iterator[Gateway]:
    """The gateway of the web components."""
    gateway = Gateway(control.address, trusted_origins=site)
    yield gateway
    gateway.stop()


def test_the_javascript_package_contains_its_license(project: Path) -> None:
    for name in ("LICENSE", "NOTICE"):
        packed = project / "node_modules" / "kouxing-client" / name
        assert packed.read_bytes() == (ROOT / name).read_bytes()


def test_the_javascript_package_works_in_node(system: System, project: Path, speech: Path) -> None:
    shutil.copy(JAVASCRIPT_CLIENT / "tests" / "client.test.js", project / "client.test.mjs")
    (example,) = code_blocks(JAVASCRIPT_CLIENT / "README.md", "js")
    (project / "example.mjs").write_text(example, encoding="utf-8")
    test = (NODE, "--test", project / "client.test.mjs")
    run_program(*test, GATEWAY=system.page, SPEECH=str(speech))
    lines = run_program(NODE, project / "example.mjs", speech, GATEWAY=system.page)
    assert max(float(line.split()[-1]) for line in lines if "jaw" in line) > 200
    assert [line.split()[-1] for line in lines if "phone" in line][:4] == ["n", "i", "h", "ao"]


def test_the_javascript_package_has_the_types_of_its_api(project: Path) -> None:
    shutil.copy(JAVASCRIPT_CLIENT / "tests" / "types.ts", project / "types.mts")
    compiler = JAVASCRIPT_CLIENT / "node_modules" / "typescript" / "bin" / "tsc"
    options = "--noEmit --strict --module nodenext --target es2023 --lib es2023,dom".split()
    options.append("--skipDefaultLibCheck")
    run_program(NODE, compiler, *options, "types.mts", cwd=project)


LIP_VERTICES = np.array([[-0.1, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.1, 0.0]])
DOWN = np.array([[0.0, -0.1, 0.0], [0.0, -0.1, 0.0], [0.0, 0.0, 0.0]])
FORWARD = np.array([[0.0, 0.0, 1.0]] * 3)
TURN_AROUND = np.array([-1.0, 1.0, -1.0])  # VRM 0 looks along -z
TRIANGLE = np.array([[0, 1, 2]])


def write_face(path: Path, shapes: list[str], *nodes: dict[str, Any], turned: bool = False) -> None:
    """Write a mouth of one triangle that each shape opens; it comes behind other nodes."""
    turn = TURN_AROUND if turned else 1.0
    targets = dict.fromkeys(shapes, DOWN * turn)
    mouth = Mesh("mouth", LIP_VERTICES * turn, TRIANGLE, targets, normals=FORWARD * turn)
    scenes = [{"nodes": list(range(len(nodes) + 1))}]
    write_glb(path, [mouth], nodes=list(nodes), scenes=scenes)


def write_faces(folder: Path) -> None:
    """Write a head as ``kouxing head export`` does, and what other programs make."""
    faps = [{"name": "open_jaw", "number": 3, "unitsPerWeight": 500.0}]
    camera = {"target": [0, 0, 0], "position": [0, 0, 1], "fovYDegrees": 20}
    about = {"name": "kouxing", "extras": {"kouxing": {"faps": faps, "camera": camera}}}
    write_face(folder / "own.glb", ["open_jaw"], about)
    write_face(folder / "arkit.glb", ["Face.jawOpen"])
    write_face(folder / "none.glb", [])
    bones = {bone: node for node, bone in enumerate(BONES)}
    for version in (0, 1):
        path = folder / f"vrm-{version}.vrm"
        write_face(path, ["a"], *({"name": bone} for bone in BONES), turned=version == 0)
        document, binary = read_chunks(path)
        add_vrm(document, version, {"aa": [(0, 0)]}, bones)
        write_chunks(path, document, binary)


def write_recording(path: Path, shapes: str, name: str) -> None:
    """Write a face that takes on a shape, and at its end has no other."""
    rest = dict.fromkeys(SHAPE_SETS[shapes].names, 0.0)
    lines = [
        {"time_s": n / 50, "sequence": n, shapes: rest | ({name: n / 10} if name else {})}
        for n in range(11)
    ]
    path.write_text("\n".join(map(json.dumps, lines)), encoding="utf-8")


@pytest.fixture(scope="module")
def faces(
    project: Path, site: str, gateway: Gateway, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Browser]:
    """A browser with the page of the README, with many faces next to each other."""
    write_faces(project)
    (page,) = code_blocks(JAVASCRIPT_CLIENT / "README.md", "html")
    live = f'gateway="{gateway.page}" session="seen"'
    attributes = {
        "arkit": 'src="arkit.glb" recording',
        "vrm": 'src="vrm-1.vrm" recording',
        "old": 'src="vrm-0.vrm" recording',
        "own": f'src="own.glb" onclick="this.turnSoundOn()" data-{live} {live}',
        "none": 'src="none.glb"',
    }
    elements = "".join(
        f"<kouxing-face id={name} onerror='this.failure = event.message'"
        f" style='width: 40px' {values}></kouxing-face>"
        for name, values in attributes.items()
    )
    page = re.sub(r"<kouxing-face.*</kouxing-face>", elements, page)
    (project / "index.html").write_text(
        "<!doctype html><link rel=icon href='data:,'>"
        f"<body style='margin: 0; display: flex'>{page}",
        encoding="utf-8",
    )
    browser = Browser(tmp_path_factory.mktemp("browser"), SPEECH, size_px=(320, 240))
    browser.command("Page.navigate", url=f"{site}/index.html")
    names = [name for name in attributes if name != "none"]
    browser.wait_for(f"{names}.every((name) => window[name]?.set)")
    yield browser
    browser.close()


def test_the_web_component_detects_the_shapes_of_a_model(faces: Browser) -> None:
    sets = faces.evaluate("[arkit, vrm, old, own].map((face) => face.set)")
    assert sets == ["arkit", "vrm", "vrm", "faps"]
    faces.wait_for("none.failure?.includes('cannot speak')")


def test_the_web_component_plays_recordings_on_models_of_all_kinds(
    faces: Browser, project: Path
) -> None:
    closed = faces.steady_image()
    for face, shape in (("arkit", "jawOpen"), ("vrm", "aa"), ("old", "aa")):
        name = f"{face}.jsonl"
        write_recording(project / name, faces.evaluate(f"{face}.set"), shape)
        faces.evaluate(f"{face}.setAttribute('recording', '{name}')")
        faces.evaluate(f"Promise.all([{face}.play(), {face}.play()])")  # the second ends the first
        assert faces.evaluate(f"{face}.shown.{shape}") == 1
        left, width = faces.evaluate(f"[{face}.offsetLeft, {face}.offsetWidth]")
        region = slice(width), slice(left, left + width)
        while not (faces.image()[region] != closed[region]).any():
            pass


def test_the_web_component_plays_no_recording_after_it_was_removed(
    faces: Browser, project: Path
) -> None:
    write_recording(project / "late.jsonl", "arkit", "jawOpen")
    result = faces.evaluate(
        "arkit.setAttribute('recording', 'late.jsonl');"
        "{ const face = arkit, { parentElement, nextSibling } = face;"
        " window.playing = face.play().catch(({ name }) => name); face.remove();"
        " parentElement.insertBefore(face, nextSibling); } window.playing"
    )
    assert result == "AbortError"
    faces.wait_for("arkit.set === 'arkit'")
    result = faces.evaluate(
        "window.audio = { play() { const face = arkit, { parentElement, nextSibling } = face;"
        " face.remove(); parentElement.insertBefore(face, nextSibling); },"
        " pause() { audio.isPaused = true; } };"
        "arkit.play(audio).catch(({ name }) => `${name} ${audio.isPaused}`)"
    )
    assert result == "AbortError true"
    faces.wait_for("arkit.set === 'arkit'")


def test_the_web_component_rejects_values_that_it_cannot_show(faces: Browser) -> None:
    for call in ("own.show([1])", "own.show(Array(68).fill(NaN))", "vrm.show([1, 1], ['aa'])"):
        error = faces.evaluate(f"(() => {{ try {{ {call} }} catch (e) {{ return `${{e}}`; }} }})()")
        assert error.startswith("RangeError: show() needs ")


def test_the_web_component_plays_the_recording_that_was_chosen_last(
    faces: Browser, project: Path
) -> None:
    for name, shape in (("slow.jsonl", "jawOpen"), ("fast.jsonl", "mouthClose")):
        write_recording(project / name, "arkit", shape)
    faces.evaluate(
        "const load = fetch; window.fetch = (url) => url.endsWith('slow.jsonl')"
        " ? new Promise((done) => (window.goOn = () => done(load(url)))) : load(url);"
        "arkit.setAttribute('recording', 'slow.jsonl'); window.first = arkit.play();"
        "arkit.setAttribute('recording', 'fast.jsonl');"
        "arkit.play().then(() => { goOn(); window.fetch = load; return window.first; })"
    )
    assert faces.evaluate("arkit.shown.mouthClose") == 1


def test_a_web_component_outside_the_page_starts_no_lip_sync(faces: Browser) -> None:
    make = "const face = document.createElement('kouxing-face'); face.setAttribute('local', '')"
    error = faces.evaluate(
        f"(() => {{ {make}; try {{ face.lips; }} catch (e) {{ return `${{e}}`; }} }})()"
    )
    assert "add it to the page first" in error


def test_the_web_component_reports_that_it_is_no_longer_drawn(faces: Browser) -> None:
    faces.evaluate(
        "none.failure = ''; window.context = none.shadowRoot.querySelector('canvas')"
        ".getContext('webgl2').getExtension('WEBGL_lose_context'); context.loseContext()"
    )
    faces.wait_for("none.failure.includes('show fewer faces')")
    faces.evaluate("context.restoreContext()")
    faces.wait_for("none.shadowRoot.querySelector('p').textContent === ''")
    faces.page_errors.clear()


def test_the_web_component_reports_wrong_addresses(faces: Browser) -> None:
    play = "arkit.play().catch(({ message }) => message)"
    faces.evaluate("arkit.setAttribute('recording', 'absent.jsonl')")
    assert "absent.jsonl: cannot be loaded (404" in faces.evaluate(play)
    faces.evaluate("arkit.setAttribute('recording', 'index.html')")
    assert "index.html: the recording has no times" in faces.evaluate(play)
    faces.evaluate("arkit.setAttribute('recording', '')")
    assert "add" in faces.evaluate(play)
    for address, text in (
        ("localhost:8080", "localhost:8080 is not the address of a gateway"),
        (f"{faces.evaluate('location.origin')}/absent", "cannot connect to the gateway at http://"),
    ):
        faces.evaluate(f"own.failure = ''; own.setAttribute('gateway', '{address}')")
        faces.wait_for(f"own.failure.includes('{text}')")
        assert text in faces.evaluate("own.shadowRoot.querySelector('p').textContent")
    faces.evaluate("own.removeAttribute('gateway')")
    faces.wait_for("own.failure.includes('set the attribute gateway to its address')")
    faces.evaluate("own.setAttribute('gateway', own.dataset.gateway)")
    faces.wait_for("own.shadowRoot.querySelector('p').textContent === ''")
    faces.page_errors.clear()


def test_the_web_component_reports_that_the_gateway_has_ended(faces: Browser) -> None:
    faces.evaluate(
        "own.failure = ''; window.RealSocket = WebSocket; window.sockets = [];"
        "window.WebSocket = class { constructor() { sockets.push(this); } close() {} };"
        "own.setAttribute('gateway', 'http://ended'); sockets[0].onopen(); sockets[0].onclose()"
    )
    faces.wait_for("sockets.length === 2")
    assert faces.evaluate("own.failure") == ""
    faces.evaluate("sockets[1].onclose()")
    assert "cannot connect to the gateway at http://ended" in faces.evaluate("own.failure")
    restore = "own.setAttribute('gateway', own.dataset.gateway)"
    faces.evaluate(f"window.WebSocket = RealSocket; {restore}")
    faces.wait_for("own.shadowRoot.querySelector('p').textContent === ''")
    faces.page_errors.clear()


def test_the_web_component_releases_its_webgl_context_when_it_is_removed(faces: Browser) -> None:
    context = "own.shadowRoot.querySelector('canvas').getContext('webgl2')"
    faces.evaluate(
        f"own.failure = ''; window.removed = {context};"
        "{ const face = own, { parentElement, nextSibling } = face; face.remove();"
        " parentElement.insertBefore(face, nextSibling); }"
    )
    faces.wait_for("removed.isContextLost() && own.set === 'faps'")
    assert not faces.evaluate(f"{context}.isContextLost()")
    assert faces.evaluate("own.failure") == ""


def test_a_page_may_load_the_web_component_twice(faces: Browser) -> None:
    before = "customElements.get('kouxing-face') === own.constructor"
    load = "import('/node_modules/kouxing-client/face.js?second')"
    assert faces.evaluate(f"{load}.then(() => {before})")


def test_the_web_component_turns_the_eyes_of_a_vrm_with_eye_bones(faces: Browser) -> None:
    script = """
        import('/node_modules/kouxing-client/puppet.js').then(async ({ loadPuppet }) => {
          const puppet = await loadPuppet('vrm-1.vrm');
          const eye = puppet.scene.getObjectByName('rightEye');
          const turn = (names, weights) => {
            puppet.pose(weights, names);
            puppet.update(0.02);
            const [x, y] = eye.rotation.clone().reorder('YXZ');
            return [x, y].map((angle) => angle * 180 / Math.PI);
          };
          return [
            turn(['lookLeft', 'lookUp'], [1, 0.5]),
            turn(['eyeLookInLeft', 'eyeLookOutRight'], [1, 0]),
          ];
        })
    """
    up_left, right = faces.evaluate(script)
    assert up_left == pytest.approx([-6.0, 24.6], abs=0.01)
    assert right == pytest.approx([0.0, -12.3], abs=0.01)


def test_the_web_component_frees_the_memory_of_a_model_that_it_no_longer_shows(
    faces: Browser,
) -> None:
    faces.steady_image()  # the models are in the graphics card's memory
    faces.evaluate(
        "window.numFreed = 0; const { deleteBuffer } = WebGL2RenderingContext.prototype;"
        "WebGL2RenderingContext.prototype.deleteBuffer = function (buffer) {"
        " window.numFreed++; return deleteBuffer.call(this, buffer); }; 1"
    )
    assert faces.evaluate("arkit.setAttribute('src', 'own.glb'); numFreed") > 0
    assert faces.evaluate("window.numFreed = 0; vrm.remove(); numFreed") > 0


def test_the_web_component_shows_and_plays_a_session(
    faces: Browser, control: PageControl, session: Session
) -> None:
    control.talk(session.name, A_FACE, "a")
    faces.evaluate(
        "import('/node_modules/kouxing-client/page/playout.js').then(({ Playout }) => {"
        " const { adjust } = Playout.prototype;"
        " Playout.prototype.adjust = function (nowMs) {"
        "   window.isHeard ||= this.isAudible && this.imageDelayMs > 0;"
        "   adjust.call(this, nowMs); }; })"
    )
    faces.evaluate(
        "window.sessions = [];"
        "own.addEventListener('session', ({ detail }) => sessions.push(detail.session))"
    )
    faces.click("own")  # sound starts with a gesture
    module = "/node_modules/kouxing-client/page/draw-rate.js"
    with faces.infrequent_drawing(module):
        faces.wait_for("own.shown?.[2] > 100 && window.isHeard")
        faces.evaluate("sessions.length = 0; own.setAttribute('token', 'another')")
        faces.wait_for("sessions.includes('seen')")  # it has reconnected
        faces.evaluate("own.setAttribute('src', 'arkit.glb')")
        faces.wait_for("own.set === 'arkit' && own.shown?.jawOpen > 0.1")
        faces.evaluate("own.setAttribute('manual', '')")
        assert faces.evaluate("own.shown") is None
        faces.evaluate("own.removeAttribute('manual')")
        faces.wait_for("own.shown?.jawOpen > 0.1")
        faces.evaluate(
            "const { close } = AudioContext.prototype; AudioContext.prototype.close = function () {"
            " window.isHeard = false; return close.call(this); };"
            "const face = own; const { parentElement, nextSibling } = face; face.remove();"
            "window.wasClosed = !window.isHeard; parentElement.insertBefore(face, nextSibling)"
        )
        assert faces.evaluate("window.wasClosed")
        faces.wait_for("window.isHeard")  # sound continues after the face was moved
    driver = "GL Driver Message"  # the processor draws
    assert [text for text in faces.page_errors if driver not in text] == []
