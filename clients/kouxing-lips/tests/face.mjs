// Prints the FAPs of each frame for events of the sound, a JSON list on stdin: node face.mjs MODELS DELAY_S.

import { readFileSync } from "node:fs";
import { pathToFileURL } from "node:url";
import { Face } from "../engine/face.js";
import { loadModel } from "../engine/model.js";

const [models, delayS] = process.argv.slice(2);
const model = await loadModel(pathToFileURL(`${models}/`));
const face = new Face(model, { delayS: Number(delayS), expressiveness: 1, feeling: 0 });
const frames = JSON.parse(readFileSync(0, "utf8")).flatMap((event) => face.process(event));
process.stdout.write(JSON.stringify(frames.map(({ faps }) => [...faps])));
