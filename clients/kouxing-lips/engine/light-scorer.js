// Scores of the light model: the phones of the audio encoder; services/recognizer/acoustic/light.py explains them.

export class LightScorer {
  #lagFrames;
  #logPrior;
  #firstState;
  #numEarly; // rows of frames before the speech
  #numMissing; // frames without scores
  #last; // scores of the last row

  constructor({ constants, phoneArrays }) {
    this.#lagFrames = constants.encoder.PHONES_LAG_FRAMES;
    this.#logPrior = phoneArrays.log_prior.values;
    this.#firstState = phoneArrays.first_state.values;
    this.start();
  }

  /** Start a stretch of speech. */
  start() {
    this.#numEarly = this.#lagFrames;
    this.#numMissing = 0;
    this.#last = null;
  }

  /** Process the last feature frames of some encoder frames; return the new { settled, provisional } scores, a row for each frame. */
  accept(encoderFrames, numFrames) {
    const scores = encoderFrames.map(({ row }) => this.#scoresOf(row));
    const rows = scores.flatMap((row) => [row, row]).slice(-numFrames);
    this.#last = rows.at(-1) ?? this.#last;
    const numEarly = Math.min(rows.length, this.#numEarly);
    this.#numEarly -= numEarly;
    this.#numMissing += numEarly;
    return { settled: rows.slice(numEarly), provisional: [] };
  }

  /** End the speech; return the scores of the remaining frames. */
  finish() {
    return Array(this.#numMissing).fill(this.#last);
  }

  /** Return the scores of the states. All states of a phone have the same score. */
  #scoresOf(row) {
    const scores = new Float32Array(this.#firstState.at(-1));
    for (let phone = 0; phone < row.length; phone++) {
      scores.fill(row[phone] - this.#logPrior[phone], this.#firstState[phone], this.#firstState[phone + 1]);
    }
    return scores;
  }
}
