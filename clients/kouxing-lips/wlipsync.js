// The interface of wLipSync (npm wlipsync) with the mouths of this package.

import { LipSync } from "./index.js";

const VOWELS = { A: "aa", I: "ih", U: "ou", E: "ee", O: "oh" }; // VRM's names

/** An audio node with a volume and weights of vowels. Its face is for the sound of 0.1 s ago. */
export class WLipSyncAudioNode extends GainNode {
  #lips;
  #names;

  /** Use createWLipSyncNode instead. */
  constructor(context, lips, names) {
    super(context);
    this.#lips = lips;
    this.#names = names;
  }

  /** How far the mouth moves, 0 to 1: the sum of the vowels' VRM weights. */
  get volume() {
    return Math.min(1, sumOf(this.#vowels()));
  }

  /** Shares of the vowels by the names of the profile; their product with the volume is the VRM weight. */
  get weights() {
    const vowels = this.#vowels();
    const sum = sumOf(vowels);
    return Object.fromEntries(this.#names.map((name) => [name, sum > 0 ? (vowels[name] ?? 0) / sum : 0]));
  }

  /** Return the VRM weights by vowel. */
  #vowels() {
    const weights = this.#lips.current?.vrm ?? [];
    const shapes = this.#lips.names.vrm;
    return Object.fromEntries(Object.entries(VOWELS).map(([vowel, shape]) => [vowel, weights[shapes.indexOf(shape)] ?? 0]));
  }
}

function sumOf(vowels) {
  return Object.values(vowels).reduce((sum, weight) => sum + weight, 0);
}

/** Create a node. The profile only names the weights, because the models suit all voices. */
export async function createWLipSyncNode(context, profile = null) {
  const lips = await LipSync.create({ context, shapes: ["vrm"] });
  const names = profile?.mfccs?.map(({ name }) => name) ?? Object.keys(VOWELS);
  const node = new WLipSyncAudioNode(context, lips, [...new Set(names)]);
  try {
    await lips.listenTo(node);
  } catch (error) {
    lips.close();
    throw error;
  }
  return node;
}

/** Profiles are not needed; a binary one is ignored. */
export function parseBinaryProfile() {
  return null;
}
