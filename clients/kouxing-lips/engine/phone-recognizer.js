// Recognizes phones from scores; services/recognizer explains it in live_decoder.py and
// search/output_rule.py.

import { Decoder } from "./decoder.js";
import { frameTimeS, wholeSamples } from "./math.js";

const [FIRST, INSIDE] = [0, 1]; // position of a phone between pauses

export class PhoneRecognizer {
  #model;
  #scorer;
  #ruleConfig;
  #symbols;
  #silence;
  #durationsS;
  #settled; // search over settled scores
  #lookahead; // continues this search over provisional scores
  #decoder; // the search in use: one of these two
  #provisional; // the scores last searched
  #numRuleFrames; // frames that the output rule has seen
  #rule; // lastEmitted, candidate, numAgreeing
  #startFrame = 0;
  #finalFrame = 0; // up to this frame of the speech, phones are final
  #confidence = []; // confidence of the settled frames from #finalFrame on
  #numFinal = 0;
  #lastFinal;
  #openPhones = []; // emitted, but not final yet

  /** @param rule parameters of the output rule */
  constructor(model, scorer, rule) {
    const { phones, phoneArrays, phoneLm } = model;
    const values = (name) => phoneArrays[name].values;
    this.#model = model;
    this.#scorer = scorer;
    this.#ruleConfig = rule;
    this.#symbols = phones.symbols;
    this.#silence = phones.symbols.indexOf(phones.silence);
    this.#durationsS = phoneArrays.duration_mean_s;
    const hmms = {
      silence: this.#silence,
      firstState: values("first_state"),
      logStay: values("log_stay"),
      logLeave: values("log_leave"),
      lmScale: Math.fround(phones.lmScale),
      penalty: Math.fround(phones.phonePenalty),
      rateWeight: phones.rateWeight,
    };
    this.#settled = new Decoder(phoneLm, hmms, model);
    this.#lookahead = new Decoder(phoneLm, hmms, model);
  }

  /** Start a stretch of speech at a feature frame. */
  start(frame) {
    this.#scorer.start();
    this.#startFrame = frame;
    this.#finalFrame = this.#numRuleFrames = 0;
    this.#confidence = [];
    this.#provisional = [];
    this.#lastFinal = this.#silence;
    this.#openPhones = [];
    this.#settled.reset();
    this.#decoder = this.#settled;
    this.#rule = { lastEmitted: this.#silence, candidate: this.#silence, numAgreeing: 0 };
  }

  /** Process the last feature frames of some encoder frames; return new and changed phones. */
  accept(encoderFrames, numFrames) {
    const { settled, provisional } = this.#scorer.accept(encoderFrames, numFrames);
    return this.#decode(settled, provisional);
  }

  /** End the speech; return the last phones. */
  finish() {
    const phones = this.#decode(this.#scorer.finish(), []);
    const rest = this.#settled.finalPath().filter(({ start }) => start >= this.#finalFrame);
    if (this.#openPhones.length && rest.length > 1 && rest.at(-1).phone === this.#silence) rest.pop();
    phones.push(...this.#revise(rest, 0));
    return phones;
  }

  #decode(settled, provisional) {
    if (settled.length === 0 && provisional === this.#provisional) return [];
    const known = this.#provisional;
    const continues = settled.length === 0 && known.every((row, i) => areEqualRows(row, provisional[i]));
    const numKnown = continues ? known.length : 0; // otherwise the search over provisional scores restarts
    this.#provisional = provisional;
    this.#decoder = this.#settled;
    const phones = this.#search(settled);
    if (settled.length) {
      this.#settled.forgetBefore(this.#finalFrame);
      this.#settled.dropRecords();
    }
    if (provisional.length) {
      this.#decoder = this.#lookahead;
      if (numKnown === 0) this.#lookahead.copyState(this.#settled);
      phones.push(...this.#search(provisional.slice(numKnown)));
    }
    return phones;
  }

  /** Continue the search; the output rule sees each frame once. */
  #search(rows) {
    const numRuleFrames = Math.max(0, this.#numRuleFrames - this.#decoder.numFrames);
    return rows.flatMap((scores, i) => {
      const confidence = this.#decoder.advance(scores);
      if (this.#decoder === this.#settled) this.#confidence.push(confidence);
      return i < numRuleFrames ? [] : this.#emit();
    });
  }

  /** Return the last phone and corrections, if the output rule emits it at this frame. */
  #emit() {
    this.#numRuleFrames = this.#decoder.numFrames;
    const { phone, start, confidence } = this.#decoder.lastPhone;
    if (!this.#isEmitted(phone, confidence)) return [];
    const revised = this.#revise(this.#decoder.pathSince(this.#finalFrame), 1);
    const before = this.#openPhones.length ? this.#symbols.indexOf(this.#openPhones.at(-1).symbol) : this.#lastFinal;
    const position = before === this.#silence ? FIRST : INSIDE;
    const emitted = {
      index: this.#numFinal + this.#openPhones.length,
      symbol: this.#symbols[phone],
      onsetS: this.#timeS(Math.max(start, this.#finalFrame)),
      durationS: wholeSamples(this.#durationsS.values[position * this.#durationsS.shape[1] + phone], this.#model),
      confidence,
      isFinal: false,
    };
    this.#openPhones.push(emitted);
    return [...revised, emitted];
  }

  #isEmitted(phone, confidence) {
    const { numStableFrames, minConfidence } = this.#ruleConfig;
    const rule = this.#rule;
    if (confidence < minConfidence) rule.numAgreeing = 0;
    else rule.numAgreeing = phone === rule.candidate ? rule.numAgreeing + 1 : 1;
    rule.candidate = phone;
    if (rule.numAgreeing < numStableFrames || phone === rule.lastEmitted) return false;
    rule.lastEmitted = phone;
    return true;
  }

  /** Replace the open phones with the best string; return those that are new or changed. */
  #revise(segments, numFollowing) {
    let numBefore = this.#openPhones.length - numFollowing;
    if (this.#finalFrame === 0 && segments.length > Math.max(0, numBefore) && segments[0].phone === this.#silence) segments = segments.slice(1);
    const emitted = [];
    for (; segments.length < numBefore; numBefore--) {
      // a phone was emitted that the best string lacks: withdraw it
      emitted.push({ ...this.#openPhones.shift(), symbol: this.#symbols[this.#silence], durationS: 0, isFinal: true });
      this.#numFinal++;
    }
    const finalUntil = numFollowing ? this.#settled.sharedEnd : this.#settled.numFrames;
    const known = this.#openPhones;
    const [firstIndex, firstFrame] = [this.#numFinal, this.#finalFrame];
    this.#openPhones = [];
    segments.forEach((segment, number) => {
      const phone = this.#phoneOf(segment, known[number], firstFrame, finalUntil);
      phone.index = firstIndex + number;
      if (!isSame(phone, known[number])) emitted.push(phone);
      if (!phone.isFinal) {
        this.#openPhones.push(phone);
        return;
      }
      this.#numFinal++;
      this.#lastFinal = segment.phone;
      this.#finalFrame = segment.end;
    });
    this.#confidence.splice(0, this.#finalFrame - firstFrame);
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

function isSame(phone, other) {
  return other !== undefined && Object.keys(phone).every((key) => phone[key] === other[key]);
}

function areEqualRows(row, other) {
  return other !== undefined && row.every((value, i) => value === other[i]);
}
