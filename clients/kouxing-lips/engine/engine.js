// Lip sync of one voice, from PCM to faces. It needs no browser, worker or thread.

import { Face } from "./face.js";
import { BlockScorer } from "./block-scorer.js";
import { LightScorer } from "./light-scorer.js";
import { loadModel } from "./model.js";
import { checkOptions, inRange } from "./options.js";
import { PhoneRecognizer } from "./phone-recognizer.js";
import { Resampler } from "./resampler.js";
import { ShapeSet } from "./shapes.js";
import { SpeechSegmenter } from "./speech-segmenter.js";

const MODELS = new URL("../models/", import.meta.url);
const DEFAULT_SHAPES = ["arkit"];
const DEFAULT_HOLD_S = 3;
const MAX_DELAY_MS = 300;
const MAX_PLAUSIBLE_SAMPLE = 100; // larger samples are integers; as in kouxing/shared/audio/audio_file.py
const OPTIONS = ["sampleRateHz", "shapes", "expressiveness", "feeling", "delayMs", "phones", "models"];

export class LipEngine {
  #model;
  #resampler;
  #segmenter;
  #face;
  #slice; // samples of the next 20 ms
  #numKnown = 0; // number of these
  #numSamples = 0; // at 16 kHz
  #numIn = 0; // samples, at the rate of the input
  #rateHz;
  #shapes;
  #isSpeaking = false;
  #isFinished = false;

  /** Use LipEngine.load instead. */
  constructor(model, { sampleRateHz = 16000, shapes = DEFAULT_SHAPES, expressiveness, feeling, delayMs, ...unknown } = {}) {
    checkOptions(unknown, OPTIONS);
    if (!Array.isArray(shapes)) throw new TypeError('shapes must be an array of names, such as ["arkit"]');
    const { defaults, constants } = model;
    const delayS = inRange("delayMs", delayMs ?? 1000 * defaults.delayS, 0, MAX_DELAY_MS) / 1000;
    const amount = inRange("expressiveness", expressiveness ?? defaults.expressiveness, ...defaults.expressivenessRange);
    const strength = inRange("feeling", feeling ?? defaults.feeling, 0, 1);
    this.#model = model;
    this.#rateHz = sampleRateHz;
    this.#slice = new Float32Array(constants.pcm.SLICE_SAMPLES);
    this.#resampler = new Resampler(sampleRateHz, model);
    this.#segmenter = new SpeechSegmenter(model, delayS, recognizerFor(model));
    this.#face = new Face(model, { delayS, expressiveness: amount, feeling: strength });
    this.#shapes = shapes.map((set) => [set, new ShapeSet(set, model)]);
    /** Names of the weights of each set. */
    this.names = Object.fromEntries(this.#shapes.map(([set, { names }]) => [set, names]));
  }

  /** Load the models and start a session; the options are in index.d.ts. */
  static async load({ models = MODELS, phones = true, ...options } = {}) {
    return new LipEngine(await loadModel(models, { phones }), options);
  }

  /** Phones that the last push() or finish() found or changed. */
  newPhones = [];

  /** Duration of the audio so far, seconds. */
  get inputS() {
    return this.#numIn / this.#rateHz;
  }

  /** Show expressions, strengths 0 to 1 by name, for a time. */
  express(strengths, holdS = DEFAULT_HOLD_S) {
    this.#face.express(strengths, holdS);
  }

  /** Accept samples, mono in [-1, 1]; return the frames that are due. */
  push(samples) {
    if (!(samples instanceof Float32Array)) throw new TypeError("samples must be a Float32Array");
    this.#checkUnfinished();
    const clipped = clip(samples);
    this.#numIn += samples.length;
    this.newPhones = [];
    return this.#process(this.#resampler.accept(clipped));
  }

  /** Process samples at 16 kHz. */
  #process(samples) {
    const frames = [];
    for (let begin = 0; begin < samples.length; ) {
      const chunk = samples.subarray(begin, begin + this.#slice.length - this.#numKnown);
      this.#slice.set(chunk, this.#numKnown);
      this.#numKnown += chunk.length;
      begin += chunk.length;
      if (this.#numKnown === this.#slice.length) {
        frames.push(...this.#processSlice());
        this.#numKnown = 0;
      }
    }
    return frames;
  }

  /** End the audio; return the remaining frames, until the face is at rest. */
  finish() {
    this.#checkUnfinished();
    this.#isFinished = true;
    this.newPhones = [];
    const frames = this.#process(this.#resampler.finish());
    const events = this.#segmenter.accept(this.#slice.subarray(0, this.#numKnown));
    this.#numSamples += this.#numKnown;
    const timeS = this.#mediaTimeS;
    const { SILENT_DB } = this.#model.constants.stream;
    events.push(...this.#segmenter.finish(), { type: "progress", timeS, levelDb: SILENT_DB }, { type: "end", timeS });
    return [...frames, ...this.#animate(events)];
  }

  #checkUnfinished() {
    if (this.#isFinished) throw new Error("finish() has ended the audio; load another engine");
  }

  get #mediaTimeS() {
    return this.#numSamples / this.#model.constants.clock.MEDIA_RATE_HZ;
  }

  #processSlice() {
    const events = this.#segmenter.accept(this.#slice);
    this.#numSamples += this.#slice.length;
    const level = levelDb(this.#slice, this.#model.constants.stream);
    events.push({ ...this.#segmenter.traits, type: "progress", timeS: this.#mediaTimeS, levelDb: level });
    return this.#animate(events);
  }

  #animate(events) {
    return events.flatMap((event) => {
      if (event.type === "speech") this.#isSpeaking = event.active;
      if (event.type === "phone") this.newPhones.push(event.phone);
      return this.#face.process(event).map(({ timeS, faps }) => ({
        timeS,
        faps,
        isSpeaking: this.#isSpeaking,
        isLaughing: this.#segmenter.traits.isLaughter,
        ...Object.fromEntries(this.#shapes.map(([set, shapes]) => [set, shapes.weights(faps)])),
      }));
    });
  }
}

/** Return the phone recognizer for the networks of a model; null without one. */
function recognizerFor(model) {
  if (!model.phoneLm) return null;
  const { light, blocks } = model.phones.rules;
  return model.blocks ? new PhoneRecognizer(model, new BlockScorer(model), blocks) : new PhoneRecognizer(model, new LightScorer(model), light);
}

/** Return samples in [-1, 1]; throws a RangeError if one is NaN or an integer. */
function clip(samples) {
  const clipped = new Float32Array(samples.length);
  for (let i = 0; i < samples.length; i++) {
    const sample = samples[i];
    if (!(Math.abs(sample) <= MAX_PLAUSIBLE_SAMPLE)) {
      throw new RangeError(`a sample is ${sample}; samples must be in [-1, 1]; divide integers by 32768`);
    }
    clipped[i] = sample > 1 ? 1 : sample < -1 ? -1 : sample;
  }
  return clipped;
}

/** Return the RMS level in decibels relative to full scale. */
function levelDb(samples, { SILENT_DB }) {
  let sum = 0;
  for (let i = 0; i < samples.length; i++) sum += samples[i] * samples[i];
  return Math.max(SILENT_DB, 10 * Math.log10(sum / samples.length + 1e-12));
}
