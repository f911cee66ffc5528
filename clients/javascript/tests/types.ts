// The API in TypeScript. Only the types are checked.

import { FapTrack, Playout, Speaker, Viewer, readRecording } from "kouxing-client";
import type { KouxingFace } from "kouxing-client/face";
import "kouxing-client/face.js"; // the name in an import map, for pages without a bundler

const gateway = "http://localhost:8080";
const speaker: Speaker = await Speaker.open(gateway, { sampleRateHz: 24000, encoding: "f32le", ahead: true });
await speaker.push(new Float32Array(480));
speaker.flush();
await speaker.finish();

const [track, playout] = [new FapTrack(), new Playout()];
const viewer = new Viewer(
  gateway,
  {
    weights: (mediaTime, weights, names) => {
      const opening: number = weights[names.indexOf("jawOpen")];
      if (track.push(mediaTime, weights)) playout.frameArrived(performance.now(), mediaTime + opening);
    },
    phone: ({ symbol, final }) => console.log(symbol.length, final),
    session: ({ session }) => console.log(session?.length),
  },
  { session: speaker.session, shapes: "arkit" },
);
await viewer.ready;
viewer.send({ expressions: { joy: 0.5 } });
viewer.close();

const [[time, values]] = readRecording("").frames;
console.log(time, values.length, readRecording(new ArrayBuffer(0)).names);

const face: KouxingFace = document.createElement("kouxing-face");
face.addEventListener("session", ({ detail }) => console.log(detail.epoch));
await face.turnSoundOn();
const lips = await face.lips;
lips.addEventListener("notice", ({ detail }) => console.log(detail.length));
lips.addEventListener("ended", ({ type }) => console.log(type));
await lips.listenToMicrophone();
if (face.set !== "faps" && face.shown !== null && !Array.isArray(face.shown)) console.log(face.shown.jawOpen);

// @ts-expect-error: unknown shapes
new Viewer(gateway, {}, { shapes: "apple" });
// @ts-expect-error: use Speaker.open
new Speaker();
// @ts-expect-error: audio is not text
await speaker.push("sound");
