"""kouxing-lips with other packages: three-vrm, TalkingHead, and in place of HeadAudio and wLipSync.

The pages run the recipes of docs/clients/local.md.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from kouxing.evaluation.system.chromium import serve_folder
from kouxing.services.driver.head.glb_export import export_glb
from kouxing.shared.face.shapes import SHAPE_SETS
from tests import heads
from tests.browser import Browser
from tests.documents import code_blocks
from tests.e2e.lips_page import PACKAGE
from tests.glb_writer import Mesh, write_glb
from tests.system import DEMO, ROOT

PACKAGES = PACKAGE / "node_modules"
CLIENT_PACKAGES = ROOT / "clients" / "javascript" / "node_modules"
SIZE_PX = (320, 240)

PAGE = """<!doctype html><link rel="icon" href="data:,"><button id="start">Start</button>
<div id="node" style="width: 100px; height: 100px"></div>
<script type="importmap">{ "imports": {
  "kouxing-lips": "./kouxing-lips/index.js",
  "kouxing-lips/": "./kouxing-lips/",
  "kouxing-lips/headaudio": "./kouxing-lips/headaudio.js",
  "wlipsync": "./kouxing-lips/wlipsync.js",
  "@met4citizen/talkinghead": "./packages/@met4citizen/talkinghead/modules/talkinghead.mjs",
  "@met4citizen/headaudio": "./packages/@met4citizen/headaudio/modules/headaudio.mjs",
  "@pixiv/three-vrm": "./client-packages/@pixiv/three-vrm/lib/three-vrm.module.min.js",
  "three": "./packages/three/build/three.module.js",
  "three/addons/": "./packages/three/examples/jsm/"
} }</script>
<script type="module">
const [button, node] = ["start", "node"].map((id) => document.getElementById(id));
window.largest = {};
const note = (name, value) => {
  window.largest[name] = Math.max(value, window.largest[name] ?? 0);
};
const sample = async (context) =>
  context.decodeAudioData(await (await fetch("sample.wav")).arrayBuffer());
BODY
window.isReady = true;
</script>"""


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    browser = Browser(
        tmp_path_factory.mktemp("profile"), DEMO / "hello-female.wav", size_px=SIZE_PX
    )
    yield browser
    browser.close()


@pytest.fixture
def site(tmp_path: Path) -> Path:
    folder = tmp_path / "site"
    folder.mkdir()
    (folder / "kouxing-lips").symlink_to(PACKAGE)
    (folder / "packages").symlink_to(PACKAGES)
    (folder / "client-packages").symlink_to(CLIENT_PACKAGES)
    (folder / "sample.wav").symlink_to(DEMO / "hello-female.wav")
    return folder


def find_recipe(word: str) -> str:
    """Return the recipe with a word."""
    document = ROOT / "docs" / "clients" / "local.md"
    (block,) = [block for block in code_blocks(document, "js") if word in block]
    return block


def run(browser: Browser, site: Path, body: str, done: str) -> None:
    (site / "index.html").write_text(PAGE.replace("BODY", body), encoding="utf-8")
    with serve_folder(site) as origin:
        browser.restart(f"{origin}/")
        browser.wait_for("window.isReady")
        browser.click("start")
        browser.wait_for(done)
    assert not [text for text in browser.page_errors if '"level": "warning"' not in text]


def test_five_lines_move_a_three_vrm_avatar(browser: Browser, site: Path) -> None:
    export_glb(heads.load("woman", "coarse"), site / "avatar.vrm")
    before, loop = find_recipe("expressionManager").split("// in your render loop")
    body = f"""
import {{ VRMLoaderPlugin }} from "@pixiv/three-vrm";
import {{ GLTFLoader }} from "three/addons/loaders/GLTFLoader.js";
const loader = new GLTFLoader().register((parser) => new VRMLoaderPlugin(parser));
const {{ vrm }} = (await loader.loadAsync("avatar.vrm")).userData;
{before}
setInterval(() => {{
  // in your render loop{loop}
  vrm.update(0.03);
  for (const name of ["aa", "oh", "ou"]) note(name, vrm.expressionManager.getValue(name));
}}, 30);"""
    run(browser, site, body, "window.largest.aa > 0.2 && window.largest.oh > 0.05")


def talking_head_avatar(path: Path) -> Path:
    """Write a triangle with the bones and shapes of an avatar of Ready Player Me."""
    fingers = [f"Hand{finger}{k}" for finger in FINGERS for k in (1, 2, 3)]
    bones = [
        *("Hips", "Spine", "Spine1", "Spine2", "Neck", "Head"),
        *(f"{side}{bone}" for side in ("Left", "Right") for bone in [*LIMBS, *fingers]),
    ]
    visemes = [f"viseme_{name}" for name in ("E", "I", "O", "U", *VISEMES)]
    names = [*SHAPE_SETS["arkit"].names, *visemes]
    corners = np.eye(3)
    face = Mesh("Wolf3D_Head", corners, np.array([[0, 1, 2]]), dict.fromkeys(names, corners))
    nodes = [{"name": name} for name in bones]
    armature = {"name": "Armature", "children": [*range(len(bones)), len(bones) + 1]}
    scenes = [{"nodes": [len(bones)]}]
    return write_glb(path, [face], nodes=[*nodes, armature], scenes=scenes)


LIMBS = "Eye Shoulder Arm ForeArm Hand UpLeg Leg Foot ToeBase".split()
FINGERS = "Thumb Index Middle Ring Pinky".split()
VISEMES = "aa PP SS TH DD FF kk nn RR CH sil".split()


def test_talking_head_moves_its_mouth(browser: Browser, site: Path) -> None:
    talking_head_avatar(site / "avatar.glb")
    imported, *lines = find_recipe("mtAvatar").splitlines()
    body = """
import { TalkingHead } from "@met4citizen/talkinghead";
const head = new TalkingHead(node, { lipsyncModules: [] });
await head.showAvatar({ url: "avatar.glb" });
button.onclick = async () => {
  await head.audioCtx.resume();
  RECIPE
  head.speakAudio({ audio: await sample(head.audioCtx), words: [], wtimes: [], wdurations: [] });
};
setInterval(() => {
  for (const name of ["viseme_aa", "viseme_PP"]) note(name, head.mtAvatar[name].applied);
}, 30);"""
    body = f"{imported}{body}".replace("RECIPE", "\n".join(lines))
    run(browser, site, body, "window.largest.viseme_aa > 0.2 && window.largest.viseme_PP > 0.2")


def test_the_node_replaces_head_audio(browser: Browser, site: Path) -> None:
    """Both nodes run in the same way, and report the same names."""
    body = """
import { HeadAudio as Original } from "@met4citizen/headaudio";
import { HeadAudio } from "kouxing-lips/headaudio";
button.onclick = async () => {
  const context = new AudioContext();
  await context.audioWorklet.addModule("packages/@met4citizen/headaudio/modules/headworklet.mjs");
  const source = new AudioBufferSourceNode(context, { buffer: await sample(context), loop: true });
  window.names = [new Set(), new Set()];
  window.numStarted = [0, 0];
  window.numEnded = [0, 0];
  await Promise.all([Original, HeadAudio].map(async (Kind, i) => {
    const node = new Kind(context, { parameterData: { vadGateActiveDb: -40 } });
    await node.loadModel("packages/@met4citizen/headaudio/dist/model-en-mixed.bin");
    source.connect(node);
    node.onvalue = (name, value) => {
      window.names[i].add(name);
      if (i === 1) note(name, value);
    };
    node.onstarted = () => window.numStarted[i]++;
    node.onended = () => window.numEnded[i]++;
    setInterval(() => node.update(20), 20);
  }));
  source.start();
};"""
    done = "window.largest.viseme_aa > 0.2 && window.numStarted?.[1] && window.numEnded[1]"
    run(browser, site, body, done)
    original, ours = browser.evaluate("window.names.map((names) => [...names])")
    assert set(original) <= set(ours)


def test_the_node_replaces_wlipsync(browser: Browser, site: Path) -> None:
    """Both nodes have the same interface: airi reads ``volume`` and ``weights`` by vowel."""
    body = """
import * as original from "./packages/wlipsync/dist/wlipsync-single.js";
import * as ours from "wlipsync";
const values = { array: Array.from({ length: 12 }, (_, i) => i) };
const mfccs = [..."AEIOUS"].map((name) => ({ name, mfccCalibrationDataList: [values] }));
const profile = { targetSampleRate: 16000, sampleCount: 1024, melFilterBankChannels: 30,
  compareMethod: 1, mfccNum: 12, mfccDataCount: 1, useStandardization: false, mfccs };
button.onclick = async () => {
  const context = new AudioContext();
  const source = new AudioBufferSourceNode(context, { buffer: await sample(context), loop: true });
  const nodes = [];
  for (const { createWLipSyncNode } of [original, ours]) {
    const node = await createWLipSyncNode(context, profile);
    source.connect(node);
    nodes.push(node);
  }
  source.start();
  window.names = nodes.map(({ weights }) => Object.keys(weights));
  setInterval(() => {
    const { volume, weights } = nodes[1];
    note("silence", 1 - volume);
    for (const [name, weight] of Object.entries(weights)) note(name, volume * weight);
  }, 20);
};
window.exported = [original, ours].map((module) => Object.keys(module));"""
    done = "window.largest.A > 0.2 && window.largest.O > 0.05 && window.largest.silence > 0.9"
    run(browser, site, body, done)
    original, ours = browser.evaluate("window.names")
    assert original == ours
    original, ours = browser.evaluate("window.exported")
    assert set(original) <= set(ours)
