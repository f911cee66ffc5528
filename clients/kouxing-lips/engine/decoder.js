// Streaming Viterbi search over a loop of phones; services/recognizer/search/decoder.py explains it.

const NO_RECORD = -1;
const NO_TOKEN = -1;

export class Decoder {
  #constants;
  #lm;
  #hmms; // firstState, logStay, logLeave, lmScale, penalty, rateWeight, silence
  #changeRate; // how fast the probabilities of the phones change
  #rootProbabilities; // square roots of the phones' probabilities at the last frame
  #maxStates;
  #context;
  #top;
  #score; // (tokens, states)
  #link; // (tokens, states)
  #tokenOf; // by context
  #entry;
  #entryLink;
  #probabilities; // probabilities of the states, from the scores of one frame
  #numPhones;

  constructor(lm, hmms, { constants }) {
    this.#constants = constants.decoder;
    this.#lm = lm;
    this.#hmms = hmms;
    const maxTokens = this.#constants.MAX_TOKENS;
    const numPhones = hmms.firstState.length - 1;
    this.#maxStates = Math.max(...Array.from({ length: numPhones }, (_, phone) => this.#numStates(phone)));
    this.#context = new Int32Array(maxTokens);
    this.#top = new Float32Array(maxTokens);
    this.#score = new Float32Array(maxTokens * this.#maxStates);
    this.#link = new Int32Array(maxTokens * this.#maxStates);
    this.#tokenOf = new Int16Array(lm.phone.length).fill(NO_TOKEN);
    this.#entry = new Float32Array(maxTokens);
    this.#entryLink = new Int32Array(maxTokens);
    this.#rootProbabilities = new Float32Array(numPhones);
    this.#probabilities = new Float32Array(hmms.firstState[numPhones]);
    this.#numPhones = numPhones;
    this.reset();
  }

  /** Restart at frame 0 of a new stretch of speech. */
  reset() {
    for (let token = 0; token < (this.numTokens ?? 0); token++) this.#tokenOf[this.#context[token]] = NO_TOKEN;
    this.numFrames = 0;
    this.numTokens = 0;
    this.records = []; // { end, phone, before: index of the record of the phone before }
    this.shared = []; // segments that no later frame can change
    this.lastShared = NO_RECORD;
    this.best = [0, 0]; // token, and state of its phone
    this.confidence = 0;
    this.#changeRate = this.#constants.SLOW_RATE;
  }

  /** Continue from the state of another search. */
  copyState(other) {
    for (let token = 0; token < this.numTokens; token++) this.#tokenOf[this.#context[token]] = NO_TOKEN;
    const { numFrames, numTokens, lastShared, best, confidence } = other;
    Object.assign(this, { numFrames, numTokens, lastShared, best, confidence, records: other.records.slice(), shared: other.shared.slice() });
    this.#changeRate = other.#changeRate;
    this.#rootProbabilities.set(other.#rootProbabilities);
    const numStates = numTokens * this.#maxStates;
    this.#context.set(other.#context.subarray(0, numTokens));
    this.#top.set(other.#top.subarray(0, numTokens));
    this.#score.set(other.#score.subarray(0, numStates));
    this.#link.set(other.#link.subarray(0, numStates));
    for (let token = 0; token < numTokens; token++) this.#tokenOf[this.#context[token]] = token;
  }

  /** Search the next frame with the scores of its states; return the confidence in the last phone. */
  advance(scores) {
    this.#prune();
    this.#startPhones(this.#phonePenalty(scores));
    this.best = this.#advanceStates(scores);
    this.confidence = this.#normalize();
    this.numFrames++;
    return this.confidence;
  }

  /** The last phone of the best string so far: { phone, start, confidence }. */
  get lastPhone() {
    const phone = this.#lm.phone[this.#context[this.best[0]]];
    return { phone, start: this.#end(this.#linkAt(...this.best)), confidence: this.confidence };
  }

  /** Return the segments of the best string that start at a frame or later, without the last. */
  pathSince(frame) {
    return [...this.shared, ...this.#trace(this.#linkAt(...this.best))].filter(({ start }) => start >= frame);
  }

  /** Frame up to which all paths had the same phones when dropRecords was last called. */
  get sharedEnd() {
    return this.#end(this.lastShared);
  }

  /** Drop the shared segments that start before a frame. */
  forgetBefore(frame) {
    this.shared = this.shared.filter(({ start }) => start >= frame);
  }

  /** Return the best string at the end of the speech. */
  finalPath() {
    if (this.numFrames === 0) return [];
    let [best, state] = this.best;
    let highest = this.#constants.IMPOSSIBLE;
    for (let token = 0; token < this.numTokens; token++) {
      const phone = this.#phoneOf(token);
      const last = this.#numStates(phone) - 1;
      const finalScore = Math.fround(this.#score[token * this.#maxStates + last] + this.#hmms.logLeave[this.#hmms.firstState[phone + 1] - 1]);
      if (finalScore > highest) [highest, best, state] = [finalScore, token, last];
    }
    const link = this.#linkAt(best, state);
    const last = { phone: this.#phoneOf(best), start: this.#end(link), end: this.numFrames };
    return [...this.shared, ...this.#trace(link), last];
  }

  /** Store the phones that all paths share, and drop records that no path needs. */
  dropRecords() {
    const [records, link, score] = [this.records, this.#link, this.#score];
    const { IMPOSSIBLE } = this.#constants;
    const numStates = this.numTokens * this.#maxStates;
    const paths = new Int32Array(records.length);
    let numPaths = 0;
    for (let index = 0; index < numStates; index++) {
      if (score[index] <= IMPOSSIBLE) continue;
      numPaths++;
      if (link[index] !== NO_RECORD) paths[link[index]]++;
    }
    for (let number = paths.length - 1; number >= 0; number--) {
      const { before } = records[number];
      if (before !== NO_RECORD) paths[before] += paths[number];
    }
    const shared = paths.lastIndexOf(numPaths);
    this.shared.push(...this.#trace(shared));
    const numberOf = new Int32Array(records.length).fill(NO_RECORD);
    let numKept = 0;
    for (let number = Math.max(shared, 0); number < paths.length; number++) {
      if (!paths[number]) continue;
      const { end, phone, before } = records[number];
      numberOf[number] = numKept;
      records[numKept++] = { end, phone, before: before === NO_RECORD ? NO_RECORD : numberOf[before] };
    }
    records.length = numKept;
    for (let index = 0; index < numStates; index++) {
      if (score[index] > IMPOSSIBLE && link[index] !== NO_RECORD) link[index] = numberOf[link[index]];
    }
    this.lastShared = shared === NO_RECORD ? NO_RECORD : numberOf[shared];
  }

  #numStates(phone) {
    return this.#hmms.firstState[phone + 1] - this.#hmms.firstState[phone];
  }

  #phoneOf(token) {
    return this.#lm.phone[this.#context[token]];
  }

  #linkAt(token, state) {
    return this.#link[token * this.#maxStates + state];
  }

  /** Drop the tokens outside the beam. */
  #prune() {
    for (let token = 0; token < this.numTokens; ) {
      if (this.#top[token] >= -this.#constants.BEAM) {
        token++;
        continue;
      }
      this.#tokenOf[this.#context[token]] = NO_TOKEN;
      const last = --this.numTokens;
      if (token < last) {
        this.#context[token] = this.#context[last];
        this.#top[token] = this.#top[last];
        const from = last * this.#maxStates;
        const end = from + this.#maxStates;
        const to = token * this.#maxStates;
        this.#score.copyWithin(to, from, end);
        this.#link.copyWithin(to, from, end);
        this.#tokenOf[this.#context[token]] = token;
      }
    }
  }

  /** Update the rate of change with the scores of a frame; return the penalty of phones that start. */
  #phonePenalty(scores) {
    const { SLOW_RATE, RATE_FRAMES, MAX_PENALTY_CHANGE } = this.#constants;
    const { firstState, penalty, rateWeight } = this.#hmms;
    const [probabilities, roots] = [this.#probabilities, this.#rootProbabilities];
    let highest = -Infinity;
    for (let state = 0; state < scores.length; state++) if (scores[state] > highest) highest = scores[state];
    let total = 0;
    for (let state = 0; state < scores.length; state++) {
      probabilities[state] = Math.exp(scores[state] - highest);
      total += probabilities[state];
    }
    let overlap = 0;
    for (let phone = 0, state = 0; phone < roots.length; phone++) {
      let sum = 0;
      for (; state < firstState[phone + 1]; state++) sum += probabilities[state];
      const root = Math.sqrt(sum / total);
      overlap += root * roots[phone];
      roots[phone] = root;
    }
    if (this.numFrames) this.#changeRate += (1 - overlap - this.#changeRate) / RATE_FRAMES;
    const change = rateWeight * (this.#changeRate - SLOW_RATE);
    return Math.fround(penalty + Math.min(Math.max(change, -MAX_PENALTY_CHANGE), MAX_PENALTY_CHANGE));
  }

  /** Record the phones that may end before the frame, and start the phones that may follow. */
  #startPhones(penalty) {
    const { BEAM, IMPOSSIBLE } = this.#constants;
    this.#entry.fill(IMPOSSIBLE);
    if (this.numFrames === 0) {
      this.#enterPhones(this.#hmms.silence + 1, 0, NO_RECORD, penalty); // speech starts after a pause
      return;
    }
    const numTokens = this.numTokens;
    for (let token = 0; token < numTokens; token++) {
      const phone = this.#phoneOf(token);
      const last = this.#numStates(phone) - 1;
      const exitScore = Math.fround(this.#score[token * this.#maxStates + last] + this.#hmms.logLeave[this.#hmms.firstState[phone + 1] - 1]);
      if (exitScore < -BEAM) continue;
      this.records.push({ end: this.numFrames, phone, before: this.#linkAt(token, last) });
      this.#enterPhones(this.#context[token], exitScore, this.records.length - 1, penalty);
    }
  }

  /** Enter all phones that may follow a context. */
  #enterPhones(context, exitScore, record, penalty) {
    const { BEAM, IMPOSSIBLE, MAX_TOKENS } = this.#constants;
    const { lmScale, silence } = this.#hmms;
    const [lm, tokenOf, entry] = [this.#lm, this.#tokenOf, this.#entry];
    const { logProbs, nextContexts } = lm;
    const row = lm.rowOf(context);
    for (let phone = 0; phone < this.#numPhones; phone++) {
      const logProb = this.numFrames === 0 && phone === silence ? 0 : logProbs[row + phone];
      const candidate = Math.fround(Math.fround(exitScore + Math.fround(lmScale * logProb)) + penalty);
      if (candidate < -BEAM) continue;
      const next = nextContexts[row + phone];
      if (tokenOf[next] === NO_TOKEN) {
        if (this.numTokens === MAX_TOKENS) continue;
        const token = this.numTokens++;
        this.#context[token] = next;
        tokenOf[next] = token;
        const begin = token * this.#maxStates;
        this.#score.fill(IMPOSSIBLE, begin, begin + this.#maxStates);
        this.#link.fill(NO_RECORD, begin, begin + this.#maxStates);
      }
      const nextToken = tokenOf[next];
      if (candidate > entry[nextToken]) {
        entry[nextToken] = candidate;
        this.#entryLink[nextToken] = record;
      }
    }
  }

  /** Advance the paths within the phones by one frame; return the best token and its state. */
  #advanceStates(scores) {
    const { IMPOSSIBLE } = this.#constants;
    const { firstState, logStay, logLeave } = this.#hmms;
    const [scoreOf, linkOf, top, maxStates] = [this.#score, this.#link, this.#top, this.#maxStates];
    let highest = IMPOSSIBLE;
    let bestToken = 0;
    let bestState = 0;
    for (let token = 0; token < this.numTokens; token++) {
      const phone = this.#phoneOf(token);
      const first = firstState[phone];
      const begin = token * maxStates;
      let tokenScore = IMPOSSIBLE;
      for (let state = firstState[phone + 1] - first - 1; state >= 0; state--) {
        let value = Math.fround(scoreOf[begin + state] + logStay[first + state]);
        let link = linkOf[begin + state];
        const entered = state ? Math.fround(scoreOf[begin + state - 1] + logLeave[first + state - 1]) : this.#entry[token];
        if (entered > value) {
          value = entered;
          link = state ? linkOf[begin + state - 1] : this.#entryLink[token];
        }
        const sum = Math.fround(value + scores[first + state]);
        const score = sum > IMPOSSIBLE ? sum : IMPOSSIBLE;
        scoreOf[begin + state] = score;
        linkOf[begin + state] = link;
        if (score > tokenScore) {
          tokenScore = score;
          if (score > highest) {
            highest = score;
            bestToken = token;
            bestState = state;
          }
        }
      }
      top[token] = tokenScore;
    }
    return [bestToken, bestState];
  }

  /** Subtract the best score, so that numbers stay small; return the last phone's confidence. */
  #normalize() {
    const { BEAM, IMPOSSIBLE } = this.#constants;
    const [scoreOf, top, maxStates] = [this.#score, this.#top, this.#maxStates];
    const [bestToken, bestState] = this.best;
    const best = scoreOf[bestToken * maxStates + bestState];
    const bestPhone = this.#phoneOf(bestToken);
    let [agreeing, total] = [0, 0];
    for (let token = 0; token < this.numTokens; token++) {
      let before = NO_RECORD;
      const end = (token + 1) * maxStates;
      for (let index = token * maxStates; index < end; index++) {
        const score = scoreOf[index];
        if (score === top[token]) before = this.#link[index];
        if (score > IMPOSSIBLE) scoreOf[index] = score - best;
      }
      top[token] -= best;
      if (top[token] <= -BEAM) continue;
      const weight = Math.exp(top[token]);
      total += weight;
      if (this.#phoneOf(token) === bestPhone || this.records[before]?.phone === bestPhone) agreeing += weight;
    }
    return agreeing / total;
  }

  /** Return the segments after the shared segments, up to a record's segment. */
  #trace(record) {
    const segments = [];
    while (record !== NO_RECORD && record !== this.lastShared) {
      const { end, phone, before } = this.records[record];
      segments.unshift({ phone, start: this.#end(before), end });
      record = before;
    }
    return segments;
  }

  /** Return the first frame after the phone of a record. */
  #end(record) {
    return record === NO_RECORD ? 0 : this.records[record].end;
  }
}
