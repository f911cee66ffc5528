// Finds the speech in the audio, and predicts the lips during it; services/recognizer has the
// formulas in front_end/vad.py and speech_segmenter.py.

import { LipPredictor } from "./lip-predictor.js";
import { LogMel } from "./log-mel.js";
import { frameTimeS, join, wholeSamples } from "./math.js";
import { VoiceTraits } from "./voice-traits.js";

class VoiceActivityDetector {
  isSpeech = false;
  #constants;
  #evidence = 0;
  #numUnlikely = 0;

  constructor({ constants }) {
    this.#constants = constants.vad;
  }

  update(probability) {
    this.#numUnlikely = probability >= this.#constants.IMPROBABLE ? 0 : this.#numUnlikely + 1;
    if (this.isSpeech) {
      this.isSpeech = this.#numUnlikely < this.#constants.STOP_ENCODER_FRAMES;
      return;
    }
    this.#evidence = Math.max(0, this.#evidence + probability - this.#constants.NO_EVIDENCE);
    this.isSpeech = this.#evidence >= this.#constants.ENOUGH;
    if (this.isSpeech) this.#evidence = 0;
  }
}

export class SpeechSegmenter {
  #model;
  #mel;
  #lips;
  #state; // state of the encoder
  #detector;
  #traits;
  #phones; // a PhoneRecognizer, or null
  #frames = []; // feature frames of the next encoder frame
  #recent = []; // encoder frames before speech: { features, row: log posteriors of the phones }
  #numFrames = 0;
  #isSpeaking = false;

  constructor(model, delayS, phones) {
    this.#model = model;
    this.#phones = phones;
    this.#mel = new LogMel(model);
    this.#lips = new LipPredictor(model, delayS);
    this.#state = new Float32Array(model.stateWidth);
    this.#detector = new VoiceActivityDetector(model);
    this.#traits = new VoiceTraits(model);
  }

  /** Traits of the voice at the end of the audio: { arousal, valence, isLaughter, isBreath }. */
  get traits() {
    return this.#traits.newest;
  }

  /** Accept samples at 16 kHz; return speech changes, phones and lip positions, in order. */
  accept(samples) {
    this.#frames.push(...this.#mel.accept(samples));
    const { FRAMES_PER_ENCODER_FRAME } = this.#model.constants.segmenter;
    const events = [];
    while (this.#frames.length >= FRAMES_PER_ENCODER_FRAME) {
      const frames = join(this.#frames.splice(0, FRAMES_PER_ENCODER_FRAME));
      this.#numFrames += FRAMES_PER_ENCODER_FRAME;
      const { encoder } = this.#model;
      encoder.values("frames").set(frames);
      encoder.values("state").set(this.#state);
      encoder.run();
      this.#state.set(encoder.values("new_state"));
      const row = this.#phones ? encoder.values("phones").slice() : null;
      events.push(...this.#process({ features: join([frames, encoder.values("features")]), row }, encoder.values("voice")));
    }
    return events;
  }

  /** End the audio; return the end of the speech. */
  finish() {
    return this.#isSpeaking ? this.#endSpeech() : [];
  }

  #process(encoderFrame, voice) {
    const { SPEECH, SUNG } = this.#model.voices;
    const phones = this.#isSpeaking ? this.#recognize([encoderFrame], this.#framesPerEncoderFrame) : [];
    if (!this.#isSpeaking) {
      this.#recent.push(encoderFrame);
      if (this.#recent.length > this.#model.constants.segmenter.MAX_RECENT) this.#recent.shift();
    }
    this.#detector.update(Math.fround(voice[SPEECH] + voice[SUNG]));
    this.#traits.accept(this.#state, voice);
    if (this.#isSpeaking && !this.#detector.isSpeech) return [...phones, ...this.#endSpeech()];
    if (this.#isSpeaking) return [...phones, ...this.#predict(encoderFrame, this.#numFrames - 1)];
    return this.#detector.isSpeech ? this.#startSpeech() : [];
  }

  #startSpeech() {
    const { FRAMES_PER_ENCODER_FRAME, PRE_ROLL_FRAMES, FIRST_FRAME_PARITY, RIGHT_CONTEXT_FRAMES } = this.#model.constants.segmenter;
    const oldest = this.#numFrames - FRAMES_PER_ENCODER_FRAME * this.#recent.length;
    let first = Math.max(oldest, this.#numFrames - PRE_ROLL_FRAMES);
    while (first % FRAMES_PER_ENCODER_FRAME !== FIRST_FRAME_PARITY) first++;
    if (this.#numFrames - first < FRAMES_PER_ENCODER_FRAME) return [];
    this.#isSpeaking = true;
    this.#phones?.start(first);
    const events = [this.#speechChange(true, first), ...this.#recognize(this.#recent, this.#numFrames - first)];
    this.#lips.reset();
    let newest = this.#numFrames - 1 - FRAMES_PER_ENCODER_FRAME * (this.#recent.length - 1);
    for (const encoderFrame of this.#recent) {
      if (newest >= first + RIGHT_CONTEXT_FRAMES) events.push(...this.#predict(encoderFrame, newest));
      newest += FRAMES_PER_ENCODER_FRAME;
    }
    this.#recent = [];
    return events;
  }

  #endSpeech() {
    this.#isSpeaking = false;
    const phones = this.#phones?.finish() ?? [];
    return [...phones.map(eventOf), this.#speechChange(false, this.#numFrames)];
  }

  get #framesPerEncoderFrame() {
    return this.#model.constants.segmenter.FRAMES_PER_ENCODER_FRAME;
  }

  /** Return the phones that follow from the last feature frames of some encoder frames. */
  #recognize(encoderFrames, numFrames) {
    return (this.#phones?.accept(encoderFrames, numFrames) ?? []).map(eventOf);
  }

  #speechChange(active, frame) {
    return { type: "speech", active, timeS: frameTimeS(frame, this.#model) };
  }

  #predict({ features }, newestFrame) {
    const { HOP_S, WINDOW_S } = this.#model.constants.segmenter;
    const frame = this.#lips.processPosition(newestFrame * HOP_S + WINDOW_S, features);
    if (frame.timeS < 0) return [];
    const [timeS, delayS] = [frame.timeS, frame.delayS].map((time) => wholeSamples(time, this.#model));
    return [{ ...frame, type: "lips", timeS, delayS }];
  }
}

function eventOf(phone) {
  return { type: "phone", phone };
}
