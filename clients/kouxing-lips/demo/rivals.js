// Other lip-sync packages from npm, with their default settings. Each function returns a promise of { node: input for the
// sound, faps(): the current face }. Weights of visemes become FAPs by the table that kouxing's visemes have.

const NUM_FAPS = 68;
const OCULUS = "sil PP FF TH DD kk CH SS nn RR aa E ih oh ou".split(" "); // the rows of the table
const VOWELS = { A: "aa", E: "E", I: "ih", O: "oh", U: "ou" };

export async function headAudio(context) {
  const { HeadAudio } = await import("@met4citizen/headaudio");
  const file = (name) => new URL(name, import.meta.resolve("@met4citizen/headaudio"));
  await context.audioWorklet.addModule(file("headworklet.min.mjs"));
  const node = new HeadAudio(context);
  await node.loadModel(file("model-en-mixed.bin"));
  const weights = {};
  node.onvalue = (name, weight) => (weights[visemeOf(name)] = weight);
  const mix = await mixer();
  let lastMs = performance.now();
  return {
    node,
    faps() {
      const nowMs = performance.now();
      node.update(nowMs - lastMs);
      lastMs = nowMs;
      return mix(weights);
    },
  };
}

export async function wLipSync(context) {
  const { createWLipSyncNode } = await import("wlipsync");
  const profile = await (await fetch("wlipsync-profile.json")).json();
  const node = await createWLipSyncNode(context, profile);
  const mix = await mixer();
  return {
    node,
    faps() {
      const entries = Object.entries(VOWELS).map(([vowel, shape]) => [shape, node.volume * node.weights[vowel]]);
      return mix(Object.fromEntries(entries));
    },
  };
}

export async function wawa(context) {
  const { Lipsync } = await import("wawa-lipsync");
  const lips = new Lipsync();
  const node = new AnalyserNode(context, { fftSize: lips.analyser.fftSize });
  lips.audioContext.close(); // it accepts only an audio element or the microphone
  lips.analyser = node;
  const mix = await mixer();
  return {
    node,
    faps() {
      lips.processAudio();
      return mix({ [visemeOf(lips.viseme)]: 1 });
    },
  };
}

/** Return the Oculus viseme of a name such as viseme_I. */
function visemeOf(name) {
  const viseme = name.replace("viseme_", "");
  return VOWELS[viseme] ?? viseme;
}

/** Return a function from weights by name to FAPs. */
async function mixer() {
  const [header, ...rows] = (await (await fetch("visemes.tsv")).text()).trim().split("\n").map((line) => line.split("\t"));
  const visemes = {};
  rows
    .filter(([kind]) => kind === "viseme")
    .forEach((row, number) => {
      const faps = (visemes[OCULUS[number]] = new Float32Array(NUM_FAPS));
      header.forEach((column, i) => column.startsWith("fap") && (faps[column.slice(3) - 1] = row[i]));
    });
  return (weights) => {
    const sum = new Float32Array(NUM_FAPS);
    for (const [name, weight] of Object.entries(weights)) visemes[name].forEach((x, i) => (sum[i] += weight * x));
    return sum;
  };
}
