// node run.js PROGRAM SOUNDS TABLES [PROFILE]: writes the curves of a program for each recording in the folder SOUNDS
// (CLIP.f32: float samples, 48 kHz, mono) to TABLES/CLIP.csv. PROFILE is the profile of wLipSync (JSON).

import { readFile, readdir, writeFile } from "node:fs/promises";
import { join, parse } from "node:path";
import { argv } from "node:process";

const OCULUS = { viseme_I: "ih", viseme_O: "oh", viseme_U: "ou" }; // from the names of Ready Player Me

const [program, sounds, tables, profile] = argv.slice(2);
const { computeCurves } = await import(`./${program}.js`);
const settings = profile ? JSON.parse(await readFile(profile, "utf8")) : null;
for (const file of await readdir(sounds)) {
  const sound = await readFile(join(sounds, file));
  const samples = new Float32Array(sound.buffer, sound.byteOffset, sound.length / 4);
  const { names, rows } = await computeCurves(samples, settings);
  const header = ["t", ...names.map((name) => OCULUS[name] ?? name.replace(/^viseme_/, ""))].join(",");
  const lines = rows.map((row) => row.map((value) => Number(value.toFixed(4))).join(","));
  await writeFile(join(tables, `${parse(file).name}.csv`), [header, ...lines, ""].join("\n"));
}
