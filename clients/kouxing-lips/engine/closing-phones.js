// Recognized phones that close the lips; services/synthesizer/lips/learned/closure_rule.py has the rules.

/** The recognized phones of one kind of closure: "b" (b p m) or "f". */
export class ClosingPhones {
  #constants;
  #rule;
  #symbols;
  #phones = new Map(); // by index

  constructor({ constants, closureRule, phones }, viseme) {
    this.#constants = constants.closures;
    this.#rule = closureRule;
    this.#symbols = new Set(phones.closing[viseme]);
  }

  /** Add a phone or a revision. */
  add(phone) {
    const known = this.#phones.get(phone.index);
    this.#phones.delete(phone.index);
    const newest = known?.isFinal && !phone.isFinal ? known : phone;
    if (!this.#symbols.has(newest.symbol)) return;
    this.#phones.set(phone.index, newest);
  }

  /** Forget phones that started before a time. */
  forgetBefore(timeS) {
    for (const [index, phone] of this.#phones) if (phone.onsetS < timeS) this.#phones.delete(index);
  }

  /** Return the log odds of a closure that the phones add at a time. */
  logOddsAt(timeS) {
    return [...this.#phones.values()].reduce((highest, phone) => Math.max(highest, this.#logOddsOf(phone, timeS)), 0);
  }

  #logOddsOf(phone, timeS) {
    const { HOLD_S, EDGE_S } = this.#constants;
    const highest = Math.min(logOddsOf(Math.max(phone.confidence, 0.5), this.#constants), this.#rule.phone);
    const endS = phone.onsetS + Math.min(phone.durationS, HOLD_S);
    const outsideS = Math.max(phone.onsetS - timeS, timeS - endS, 0);
    return highest * Math.max(0, 1 - outsideS / EDGE_S);
  }
}

/** Return the log odds of a probability clipped to the rule's range. */
export function logOddsOf(probability, { MIN_PROBABILITY, MAX_PROBABILITY }) {
  const clipped = Math.min(Math.max(probability, MIN_PROBABILITY), MAX_PROBABILITY);
  return Math.log(clipped / (1 - clipped));
}
