// Writes the demo page with all its modules, models and heads to a folder: node build.mjs FOLDER.
// The folder works on any web server.

import { createHash } from "node:crypto";
import { cp, mkdir, readFile, readdir, rm, writeFile } from "node:fs/promises";
import { join, relative } from "node:path";
import { fileURLToPath } from "node:url";
import { profileOf } from "./wlipsync-profile.mjs";

const ROOT = fileURLToPath(new URL("../../../", import.meta.url));
const CLIENT = join(ROOT, "clients/javascript");
const PAGE = join(ROOT, "services/gateway/page");
const THREE = join(CLIENT, "node_modules/three");
const HEADS = ["woman", "man", "ada", "leo", "mika", "rosa", "child", "elder"];
// loaded when first used
const LAZY_FILES = /^modules\/kouxing-lips\/models\/blocks|^heads\/(?!woman)|^modules\/(three\/examples\/jsm\/libs\/draco|headaudio|wlipsync)|^(rivals|visemes|wlipsync)/;
const WAV_HEADER_BYTES = 44;

const [folder] = process.argv.slice(2);
await rm(folder, { recursive: true, force: true });
await mkdir(folder, { recursive: true });
const copy = (from, to) => cp(from, join(folder, to), { recursive: true });

for (const name of ["index.html", "demo.js", "demo.css", "rivals.js"]) await copy(fileURLToPath(new URL(name, import.meta.url)), name);
await copy(join(PAGE, "icon.svg"), "icon.svg");
for (const name of ["LICENSE", "NOTICE"]) await copy(join(ROOT, name), `modules/kouxing-lips/${name}`);
await copy(join(ROOT, "shared/demo/hello-female.wav"), "sample.wav");
for (const head of HEADS) {
  await copy(join(PAGE, head === "woman" ? "head.glb" : `head-${head}.glb`), `heads/${head}.glb`);
  await copy(join(PAGE, `head-${head}.webp`), `heads/${head}.webp`);
}
const lips = fileURLToPath(new URL("../", import.meta.url));
for (const name of ["index.js", "worker.js", "worklet.js", "frame-track.js", "engine", "models"]) {
  await copy(join(lips, name), `modules/kouxing-lips/${name}`);
}
const rivals = { headaudio: "@met4citizen/headaudio", wlipsync: "wlipsync" };
for (const [to, name] of Object.entries(rivals)) {
  for (const part of ["dist", "LICENSE"]) await copy(join(lips, "node_modules", name, part), `modules/${to}/${part}`);
}
await copy(join(ROOT, "shared/face/high_level.tsv"), "visemes.tsv");
const recordings = ["hello-female", "hello-male"].map((name) => readWav(join(ROOT, `shared/demo/${name}.wav`)));
await writeFile(join(folder, "wlipsync-profile.json"), JSON.stringify(await profileOf(await Promise.all(recordings))));
const modules = (await readdir(CLIENT)).filter((name) => name.endsWith(".js"));
for (const name of [...modules, "page"]) await copy(join(CLIENT, name), `modules/kouxing-client/${name}`);
await copy(join(CLIENT, "node_modules/@pixiv/three-vrm/lib/three-vrm.module.min.js"), "modules/three-vrm.js");
for (const name of ["build/three.module.js", "build/three.core.js"]) await copy(join(THREE, name), `modules/three/${name}`);
for (const name of ["libs/meshopt_decoder.module.js", "libs/draco", "loaders/DRACOLoader.js", "loaders/GLTFLoader.js"]) {
  await copy(join(THREE, "examples/jsm", name), `modules/three/examples/jsm/${name}`);
}
for (const name of ["BufferGeometryUtils.js", "SkeletonUtils.js"]) {
  await copy(join(THREE, "examples/jsm/utils", name), `modules/three/examples/jsm/utils/${name}`);
}

const files = (await readdir(folder, { recursive: true, withFileTypes: true }))
  .filter((entry) => entry.isFile())
  .map((entry) => relative(folder, join(entry.parentPath, entry.name)).replaceAll("\\", "/"))
  .filter((name) => !LAZY_FILES.test(name))
  .sort();
const hash = createHash("sha256");
for (const name of files) hash.update(name).update(await readFile(join(folder, name)));
const worker = await readFile(new URL("service-worker.js", import.meta.url), "utf8");
const constants = `const VERSION = "${hash.digest("hex").slice(0, 16)}";\nconst FILES = ${JSON.stringify(["./", ...files], null, 1)};\n`;
await writeFile(join(folder, "service-worker.js"), constants + worker);

/** Return the samples of a recording of this project: 16 bits, mono, 16 kHz. */
async function readWav(file) {
  const bytes = new Uint8Array(await readFile(file)).slice(WAV_HEADER_BYTES);
  return Float32Array.from(new Int16Array(bytes.buffer), (sample) => sample / 32768);
}
