// A profile for wLipSync, which contains none: the mean cepstrum of each vowel in some recordings.
// node wlipsync-profile.mjs FOLDER > PROFILE: the folder has recordings as 32-bit samples at 16 kHz (*.f32).

import { readFile, readdir } from "node:fs/promises";
import { join } from "node:path";
import { fileURLToPath } from "node:url";
import { LipEngine } from "../engine/engine.js";
import { loadModel } from "../engine/model.js";

const MODELS = new URL("../models/", import.meta.url);
const RATE_HZ = 16000;
const NUM_CEPSTRA = 12;
const [WINDOW, NUM_BANDS, EUCLIDEAN] = [1024, 30, 1]; // as in uLipSync
const VOWELS = { a: "A", ei: "E", ie: "E", i: "I", o: "O", uo: "O", u: "U" }; // of wLipSync, by phone

/** Return a profile from recordings, samples at 16 kHz. */
export async function profileOf(recordings) {
  const cepstrumOf = await loadAnalysis();
  const model = await loadModel(MODELS, { phones: true });
  const cepstra = Object.fromEntries(Object.values(VOWELS).map((vowel) => [vowel, []]));
  for (const samples of recordings) {
    for (const { symbol, onsetS, durationS } of phonesOf(samples, model)) {
      if (!(symbol in VOWELS)) continue;
      const begin = Math.round((onsetS + durationS / 2) * RATE_HZ - WINDOW / 2); // the middle of the phone
      if (begin >= 0 && begin + WINDOW <= samples.length) {
        cepstra[VOWELS[symbol]].push(cepstrumOf(samples.subarray(begin, begin + WINDOW)));
      }
    }
  }
  const mfccs = Object.entries(cepstra).map(([name, found]) => {
    if (found.length === 0) throw new Error(`the recordings do not contain the vowel ${name}; add one that does`);
    const mean = found[0].map((_, i) => found.reduce((sum, cepstrum) => sum + cepstrum[i], 0) / found.length);
    return { name, mfccCalibrationDataList: [{ array: [...mean] }] };
  });
  return {
    targetSampleRate: RATE_HZ,
    sampleCount: WINDOW,
    melFilterBankChannels: NUM_BANDS,
    compareMethod: EUCLIDEAN,
    mfccNum: mfccs.length,
    mfccDataCount: 1,
    useStandardization: false,
    mfccs,
  };
}

/** Return the final phones of a recording. */
function phonesOf(samples, model) {
  const engine = new LipEngine(model, { shapes: [] });
  engine.push(samples);
  const phones = engine.newPhones;
  engine.finish();
  return [...phones, ...engine.newPhones].filter(({ isFinal, durationS }) => isFinal && durationS > 0);
}

/** Return a function from a window to wLipSync's own cepstrum. */
async function loadAnalysis() {
  const memory = new WebAssembly.Memory({ initial: 4 });
  const wasm = await readFile(new URL("wlipsync.wasm", import.meta.resolve("wlipsync")));
  const { exports } = (await WebAssembly.instantiate(wasm, { env: { memory } })).instance;
  exports.load_profile(RATE_HZ, WINDOW, NUM_BANDS, EUCLIDEAN, NUM_CEPSTRA, 1, 0);
  exports.set_input(RATE_HZ);
  const input = new Float32Array(memory.buffer, exports.get_input_buffer(), exports.get_input_buffer_size());
  const cepstrum = new Float32Array(memory.buffer, exports.mfccOut.value, NUM_CEPSTRA);
  return (samples) => {
    input.set(samples);
    exports.execute(samples.length); // the first place after the samples in a ring
    return cepstrum.slice();
  };
}

if (process.argv[1] === fileURLToPath(import.meta.url)) {
  const [folder] = process.argv.slice(2);
  const names = (await readdir(folder)).filter((name) => name.endsWith(".f32"));
  const recordings = names.map(async (name) => new Float32Array(new Uint8Array(await readFile(join(folder, name))).buffer));
  process.stdout.write(JSON.stringify(await profileOf(await Promise.all(recordings))));
}
