// The phone language model; services/recognizer/search/phone_lm.py explains it. A context is the
// node of its last phone.

import { floats } from "./math.js";

const NUM_ROWS = 512; // cached rows
const NO_CONTEXT = -1;

export class PhoneLm {
  /** Context of each node: its longest suffix with n-grams. */
  contextOf;
  /** Context to which each node backs off. */
  backoff;
  /** Log weight of this step. */
  logBackoff;
  /** Last phone of each node. */
  phone;
  /** Rows of log-probabilities of the phones after a context. */
  logProbs;
  /** Rows of the contexts that these phones lead to. */
  nextContexts;
  #contexts = new Int32Array(NUM_ROWS).fill(NO_CONTEXT); // by row
  #numPhones;
  #firstChild;
  #logProb;

  constructor(phoneArrays, constants) {
    const [children, phone, probs, backoffs] = ["children", "phone", "log_prob", "log_backoff"].map(
      (name) => phoneArrays[`lm_${name}`].values,
    );
    const step = Math.fround(constants.modelFile.LOG_STEP);
    this.phone = phone;
    this.#logProb = floats(probs, (value) => -step * value);
    this.logBackoff = floats(backoffs, (value) => step * value);
    this.#firstChild = new Int32Array(children.length + 1);
    this.#firstChild[0] = 1;
    for (let node = 0; node < children.length; node++) this.#firstChild[node + 1] = this.#firstChild[node] + children[node];
    this.contextOf = new Int32Array(children.length);
    const suffixOf = new Int32Array(children.length); // node of the longest known suffix
    for (let node = 0; node < children.length; node++) {
      const isContext = children[node] > 0 || node <= children[0];
      this.contextOf[node] = isContext ? node : this.contextOf[suffixOf[node]];
      if (node === 0) continue;
      for (let child = this.#firstChild[node]; child < this.#firstChild[node + 1]; child++) {
        suffixOf[child] = this.#longestSuffix(suffixOf[node], phone[child], suffixOf);
      }
    }
    this.backoff = suffixOf.map((node) => this.contextOf[node]);
    this.#numPhones = phoneArrays.first_state.values.length - 1;
    this.logProbs = new Float32Array(NUM_ROWS * this.#numPhones);
    this.nextContexts = new Int32Array(this.logProbs.length);
  }

  /** Return the node of a phone after a context, or after the longest suffix of it that has one. */
  #longestSuffix(context, phone, suffixOf) {
    for (;;) {
      let child = this.#firstChild[context];
      const end = this.#firstChild[context + 1];
      while (child < end && this.phone[child] < phone) child++;
      if (child < end && this.phone[child] === phone) return child;
      context = suffixOf[context];
    }
  }

  /**
   * Return the place of a context's row in logProbs and nextContexts. The row is valid until the next call.
   */
  rowOf(context) {
    const row = context % NUM_ROWS;
    const at = row * this.#numPhones;
    if (this.#contexts[row] === context) return at;
    const end = at + this.#numPhones;
    if (context !== 0) {
      const backoffRow = this.rowOf(this.backoff[context]);
      for (let i = at, from = backoffRow; i < end; i++, from++) {
        this.logProbs[i] = this.logProbs[from] + this.logBackoff[context];
        this.nextContexts[i] = this.nextContexts[from];
      }
    }
    for (let child = this.#firstChild[context]; child < this.#firstChild[context + 1]; child++) {
      this.logProbs[at + this.phone[child]] = this.#logProb[child];
      this.nextContexts[at + this.phone[child]] = this.contextOf[child];
    }
    this.#contexts[row] = context;
    return at;
  }
}
