"""Checks a wheel: installs it in an empty environment, and runs it outside the source tree.

usage: check_wheel.py WHEEL

It renders a sample sentence, starts ``kouxing run``, and loads the page with its heads and all of
its JavaScript modules. Its packages come from requirements.lock.
"""

import os
import re
import signal
import subprocess
import sys
import tempfile
import urllib.request
import venv
from pathlib import Path
from urllib.parse import urljoin

LOCK = Path(__file__).parents[1] / "requirements.lock"
MAX_WHEEL_MB = 60.0
IMPORT = re.compile(r"""(?:\bfrom|\bimport)\s*["']([^"']+)["']""")
ADDONS = "three/addons/"
FACE_MESH = "modules/face_mesh/face_mesh"
ASSETS = (
    "head.glb",
    "head-man.glb",
    "style.css",
    f"{FACE_MESH}.js",
    f"{FACE_MESH}_solution_simd_wasm_bin.wasm",
    f"{FACE_MESH}_solution_packed_assets.data",
)


def main(wheel: Path) -> None:
    """Check a wheel. Raises an exception at the first failed check."""
    size_mb = wheel.stat().st_size / 1e6
    print(f"{wheel.name}: {size_mb:.1f} MB")
    assert size_mb <= MAX_WHEEL_MB, f"the wheel is larger than {MAX_WHEEL_MB:g} MB"
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        venv.create(folder / "venv", with_pip=True)
        python = folder / "venv" / "bin" / "python"
        install = [python, "-m", "pip", "install", "--quiet"]
        subprocess.run([*install, "--require-hashes", "--requirement", LOCK], check=True)
        subprocess.run([*install, "--no-deps", wheel], check=True)
        environment = {
            key: value for key, value in os.environ.items() if not key.startswith("PYTHON")
        }
        environment |= dict.fromkeys(("HOME", "XDG_CACHE_HOME", "XDG_STATE_HOME"), name)
        environment["PATH"] = f"{python.parent}{os.pathsep}/usr/bin{os.pathsep}/bin"  # no npm
        subprocess.run(
            ["kouxing", "--help"], env=environment, stdout=subprocess.DEVNULL, check=True
        )
        check_render(folder, environment)
        check_page(folder, environment)
    print("the wheel works")


def check_render(folder: Path, environment: dict[str, str]) -> None:
    """Render curves and a picture of a sample sentence."""
    (sample,) = folder.glob("venv/lib/*/site-packages/kouxing/shared/demo/hello-female.wav")
    for output in ("face.csv", "face.png"):
        subprocess.run(
            ["kouxing", "render", sample, output], cwd=folder, env=environment, check=True
        )
        assert (folder / output).stat().st_size > 10_000, f"{output} is too small"


def check_page(folder: Path, environment: dict[str, str]) -> None:
    """Run the services, and load everything that the page needs."""
    command = ["kouxing", "run", "--no-browser", "--port", "0", "--set", "driver.view=none"]
    with subprocess.Popen(
        command, cwd=folder, env=environment, stderr=subprocess.PIPE, text=True
    ) as running:
        try:
            assert running.stderr is not None
            log = ""
            while "ready:" not in log:
                line = running.stderr.readline()
                assert line, f"kouxing run ended: {log}"
                log += line
            page = re.findall(r"the face is at (\S+)", log)[0] + "/"
            num_modules = load_modules(page)
            for asset in ASSETS:
                assert load(urljoin(page, asset)), f"{asset} is empty"
            print(f"loaded the page, {num_modules} modules and {len(ASSETS)} other files")
        finally:
            running.send_signal(signal.SIGINT)
            _, rest = running.communicate(timeout=60)
    assert running.returncode == 0, rest


def load_modules(page: str) -> int:
    """Load the page's script and every module that it imports; return their number."""
    html = load(page).decode()
    names = dict(re.findall(r'"(three[^"]*)": "([^"]+)"', html))  # the import map
    pending = [urljoin(page, "main.js")]
    loaded: set[str] = set()
    while pending:
        module = pending.pop()
        if module in loaded:
            continue
        loaded.add(module)
        for name in IMPORT.findall(load(module).decode()):
            if name.startswith(ADDONS):
                pending.append(urljoin(page, names[ADDONS] + name.removeprefix(ADDONS)))
            elif name in names:
                pending.append(urljoin(page, names[name]))
            elif name.startswith("."):
                pending.append(urljoin(module, name))
    assert any("GLTFLoader" in module for module in loaded), "the page does not import three.js"
    return len(loaded)


def load(address: str) -> bytes:
    """Return the content of an address."""
    with urllib.request.urlopen(address, timeout=30) as answer:  # noqa: S310 - our own page
        content: bytes = answer.read()
        return content


if __name__ == "__main__":
    main(Path(sys.argv[1]).absolute())
