// Recognizes phones from the posteriors of the small ear; services/recognizer explains it in
// acoustic/light.py, search/output_rule.py and live_decoder.py.

import { Decoder } from "./decoder.js";
import { frameTimeS, wholeSamples } from "./math.js";

const [FIRST, INSIDE] = [0, 1]; // position of a phone between pauses

export class PhoneRecognizer {
  #model;
  #symbols;
  #silence;
  #logPrior;
  #durationsS;
  #decoder;
  #rule; // lastEmitted, candidate, numAgreeing
  #numEarly; // rows of frames before the speech
  #numMissing; // frames without scores
  #lastRow = null;
  #startFrame = 0;
  #done = 0; // frame of the speech up to which phones are final
  #confidence = []; // confidence of the frames from `done` on
  #numFinal = 0;
  #lastFinal;
  #open = []; // emitted, not yet final

  constructor(model) {
    const { phones, phoneArrays } = model;
    const values = (name) => phoneArrays[name].values;
    this.#model = model;
    this.#symbols = phones.symbols;
    this.#silence = phones.symbols.indexOf(phones.silence);
    this.#logPrior = values("log_prior");
    this.#durationsS = phoneArrays.duration_mean_s;
    const hmms = {
      silence: this.#silence,
      firstState: values("first_state"),
      logStay: values("log_stay"),
      logLeave: values("log_leave"),
      lmScale: Math.fround(phones.lmScale),
      penalty: Math.fround(phones.phonePenalty),
    };
    this.#decoder = new Decoder(model.phoneLm, hmms, model);
  }

  /** Start a stretch of speech at a feature frame. */
  start(frame) {
    this.#startFrame = frame;
    this.#numEarly = this.#model.constants.ear.PHONES_LAG_FRAMES;
    this.#numMissing = 0;
    this.#done = 0;
    this.#confidence = [];
    this.#lastFinal = this.#silence;
    this.#open = [];
    this.#decoder.reset();
    this.#rule = { lastEmitted: this.#silence, candidate: this.#silence, numAgreeing: 0 };
  }

  /** Take the ear's rows after the next frames; return new and changed phones. */
  accept(rows) {
    this.#numMissing += rows.length;
    this.#lastRow = rows.at(-1) ?? this.#lastRow;
    const numEarly = Math.min(rows.length, this.#numEarly);
    this.#numEarly -= numEarly;
    this.#numMissing -= rows.length - numEarly;
    return this.#search(rows.slice(numEarly));
  }

  /** End the speech; return the last phones. */
  finish() {
    const phones = this.#search(Array(this.#numMissing).fill(this.#lastRow));
    const rest = this.#decoder.finalPath().filter(({ start }) => start >= this.#done);
    if (this.#open.length && rest.length > 1 && rest.at(-1).phone === this.#silence) rest.pop();
    phones.push(...this.#revise(rest, 0));
    return phones;
  }

  #search(rows) {
    const phones = rows.flatMap((row) => {
      const scores = row.map((value, phone) => value - this.#logPrior[phone]);
      this.#confidence.push(this.#decoder.advance(scores));
      return this.#emit();
    });
    if (rows.length) {
      this.#decoder.forgetBefore(this.#done);
      this.#decoder.dropRecords();
    }
    return phones;
  }

  /** Return the last phone and corrections, if the output rule emits it at this frame. */
  #emit() {
    const { phone, start, confidence } = this.#decoder.lastPhone;
    if (!this.#isDue(phone, confidence)) return [];
    const revised = this.#revise(this.#decoder.pathSince(this.#done), 1);
    const before = this.#open.length ? this.#symbols.indexOf(this.#open.at(-1).symbol) : this.#lastFinal;
    const position = before === this.#silence ? FIRST : INSIDE;
    const emitted = {
      index: this.#numFinal + this.#open.length,
      symbol: this.#symbols[phone],
      onsetS: this.#timeS(Math.max(start, this.#done)),
      durationS: wholeSamples(this.#durationsS.values[position * this.#durationsS.shape[1] + phone], this.#model),
      confidence,
      isFinal: false,
    };
    this.#open.push(emitted);
    return [...revised, emitted];
  }

  #isDue(phone, confidence) {
    const { numStableFrames, minConfidence } = this.#model.phones.rule;
    const rule = this.#rule;
    if (confidence < minConfidence) rule.numAgreeing = 0;
    else rule.numAgreeing = phone === rule.candidate ? rule.numAgreeing + 1 : 1;
    rule.candidate = phone;
    if (rule.numAgreeing < numStableFrames || phone === rule.lastEmitted) return false;
    rule.lastEmitted = phone;
    return true;
  }

  /** Replace the open phones by the best string; return those that are new or changed. */
  #revise(segments, numFollowing) {
    let numBefore = this.#open.length - numFollowing;
    if (this.#done === 0 && segments.length > Math.max(0, numBefore) && segments[0].phone === this.#silence) segments = segments.slice(1);
    const emitted = [];
    for (; segments.length < numBefore; numBefore--) {
      // a surplus phone was emitted and is withdrawn
      emitted.push({ ...this.#open.shift(), symbol: this.#symbols[this.#silence], durationS: 0, isFinal: true });
      this.#numFinal++;
    }
    const finalUntil = numFollowing ? this.#decoder.sharedEnd : this.#decoder.numFrames;
    const known = this.#open;
    const [firstIndex, firstFrame] = [this.#numFinal, this.#done];
    this.#open = [];
    segments.forEach((segment, number) => {
      const phone = this.#phoneOf(segment, known[number], firstFrame, finalUntil);
      phone.index = firstIndex + number;
      if (!isSame(phone, known[number])) emitted.push(phone);
      if (!phone.isFinal) {
        this.#open.push(phone);
        return;
      }
      this.#numFinal++;
      this.#lastFinal = segment.phone;
      this.#done = segment.end;
    });
    this.#confidence.splice(0, this.#done - firstFrame);
    return emitted;
  }

  #phoneOf({ phone, start, end }, known, firstFrame, finalUntil) {
    const isFinal = end <= finalUntil;
    const span = this.#confidence.slice(start - firstFrame, end - firstFrame);
    const confidence = isFinal ? span.reduce((a, b) => a + b, 0) / span.length : (known?.confidence ?? this.#model.constants.liveDecoder.DEFAULT_CONFIDENCE);
    const onsetS = this.#timeS(start);
    return { symbol: this.#symbols[phone], onsetS, durationS: wholeSamples(this.#timeS(end) - onsetS, this.#model), confidence, isFinal };
  }

  #timeS(frame) {
    return frameTimeS(this.#startFrame + frame, this.#model);
  }
}

function isSame(one, other) {
  return other !== undefined && Object.keys(one).every((key) => one[key] === other[key]);
}
