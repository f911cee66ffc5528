// The phone language model; services/recognizer/search/phone_lm.py explains it. A context is the
// node of its last phone.

import { floats } from "./math.js";

export class PhoneLm {
  /** Node whose n-grams continue a node's. */
  contextOf;
  /** Context to which a node backs off. */
  backoff;
  /** Log weight of that. */
  logBackoff;
  /** Last phone of a node. */
  phone;
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
    const shorter = new Int32Array(children.length); // node of the longest known ending
    for (let node = 0; node < children.length; node++) {
      const isContext = children[node] > 0 || node <= children[0];
      this.contextOf[node] = isContext ? node : this.contextOf[shorter[node]];
      if (node === 0) continue;
      for (let child = this.#firstChild[node]; child < this.#firstChild[node + 1]; child++) {
        shorter[child] = this.#ending(shorter[node], phone[child], shorter);
      }
    }
    this.backoff = shorter.map((node) => this.contextOf[node]);
  }

  /** Return the node of a phone after a context, or after the longest ending of it that has one. */
  #ending(context, phone, shorter) {
    for (;;) {
      let child = this.#firstChild[context];
      const end = this.#firstChild[context + 1];
      while (child < end && this.phone[child] < phone) child++;
      if (child < end && this.phone[child] === phone) return child;
      context = shorter[context];
    }
  }

  /** Fill in the log-probability of each phone after a context, and the context it leads to. */
  lookUp(context, logProbs, nextContexts) {
    if (context !== 0) {
      this.lookUp(this.backoff[context], logProbs, nextContexts);
      for (let phone = 0; phone < logProbs.length; phone++) logProbs[phone] += this.logBackoff[context];
    }
    for (let child = this.#firstChild[context]; child < this.#firstChild[context + 1]; child++) {
      logProbs[this.phone[child]] = this.#logProb[child];
      nextContexts[this.phone[child]] = this.contextOf[child];
    }
  }
}
