// The API in TypeScript. Only the types are checked.

import { LipSync } from "kouxing-lips";
import { LipEngine } from "kouxing-lips/engine";
import type { LipFrame } from "kouxing-lips";
import { HeadAudio } from "kouxing-lips/headaudio";
import { createWLipSyncNode } from "kouxing-lips/wlipsync";

const lips: LipSync = await LipSync.create({ shapes: ["vrm"], delayMs: 160, feeling: 0 });
lips.addEventListener("voice", ({ detail }) => console.log(detail.isLaughing));
lips.addEventListener("phone", ({ detail: { symbol, isFinal } }) => isFinal && console.log(symbol.length));
await lips.listenToMicrophone({ noiseSuppression: false });
await lips.listenTo(document.querySelector("audio")!);
await lips.open(24000);
lips.push(new Float32Array(480));
await lips.finish();
lips.express({ joy: 0.5 });
const face: LipFrame | null = lips.current;
if (face?.vrm) console.log(face.vrm[lips.names.vrm!.indexOf("aa")]);
lips.close();

const engine = await LipEngine.load({ sampleRateHz: 48000, shapes: ["oculus"], phones: false });
await LipEngine.load({ phones: "final" });
const symbols: string[] = engine.newPhones.map(({ symbol }) => symbol);
console.log(symbols);
for (const { timeS, oculus } of engine.push(new Float32Array(480))) console.log(timeS, oculus?.[0]);

const headAudio = new HeadAudio(lips.context);
headAudio.onvalue = (name, weight) => console.log(name.length, weight.toFixed());
await headAudio.loadModel();
headAudio.update(16);
const { volume, weights } = await createWLipSyncNode(lips.context);
console.log(volume * weights.A!);

// @ts-expect-error: unknown kind of phones
await LipEngine.load({ phones: "first" });
// @ts-expect-error: unknown shapes
await LipEngine.load({ shapes: ["apple"] });
// @ts-expect-error: unknown expression
lips.express({ happy: 1 });
// @ts-expect-error: samples are not text
lips.push("sound");
