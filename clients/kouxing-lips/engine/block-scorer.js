// Scores of the block network, for final phones; services/recognizer/acoustic/blocks.py explains them.
//
// The network holds the state of one session at a time.

export class BlockScorer {
  /** Scores of the frames after the settled ones; each change creates a new array. */
  #provisional = [];
  #constants;
  #network;
  #logPrior;
  #scale;
  #sizes; // block, length, past: encoder frames
  #rings; // keys and values of each layer
  #table; // encodings of the positions
  #frames; // feature frames from the next block's first on
  #numFrames; // number of frames of the speech
  #numSettled;
  #settled; // scores not yet returned
  #highestBand; // highest band of the speech so far, which sets the floor
  #hasEnded;
  #row; // row of the table for the next block
  #numNeeded; // encoder frames that the next run needs
  #numCached;

  constructor({ blocks, phoneArrays, phones, constants }) {
    this.#constants = { ...constants.blocks, ...constants.network, floorBands: constants.mel.FLOOR_BANDS };
    this.#network = blocks;
    this.#logPrior = phoneArrays.block_log_prior.values;
    this.#scale = Math.fround(phones.acousticScale);
    const [, length, width] = blocks.shape("positions");
    const [, numRings, , block] = blocks.shape("new");
    const names = ["keys", "values"].flatMap((kind) => Array.from({ length: numRings / 2 }, (_, layer) => `${kind}_${layer}`));
    this.#rings = names.map((name) => blocks.values(name));
    this.#sizes = { block, length, past: blocks.shape(names[0])[2] };
    this.#table = positionTable(width, length, constants.network);
    this.start();
  }

  /** Start a stretch of speech. */
  start() {
    this.#provisional = [];
    this.#settled = [];
    this.#numFrames = this.#numSettled = 0;
    this.#highestBand = -Infinity;
    this.#frames = Array.from({ length: this.#constants.PADDING }, () => new Float32Array(this.#numMels));
    this.#hasEnded = false;
    this.#startTable();
  }

  /** Process the last feature frames of some encoder frames; return the new settled and the provisional scores. */
  accept(encoderFrames, numFrames) {
    const size = this.#numMels;
    const frames = encoderFrames.flatMap(({ features }) => [features.slice(0, size), features.slice(size, 2 * size)]);
    for (const frame of frames.slice(-numFrames)) {
      this.#numFrames++;
      this.#highestBand = frame.reduce((highest, band) => Math.max(highest, band), this.#highestBand);
      const floor = Math.fround(this.#highestBand - this.#constants.floorBands);
      this.#frames.push(frame.map((band) => Math.max(band, floor)));
    }
    while (this.#numEncoderFrames >= this.#numNeeded) this.#run();
    return { settled: this.#takeSettled(), provisional: this.#provisional };
  }

  /** End the speech; return the scores of the remaining frames. */
  finish() {
    const { RIGHT_CONTEXT_FRAMES, FRAMES_PER_ENCODER_FRAME } = this.#constants;
    const numMore = this.#numFrames ? RIGHT_CONTEXT_FRAMES - ((this.#numFrames - 1) % FRAMES_PER_ENCODER_FRAME) : 0;
    this.#frames.push(...Array(numMore).fill(this.#frames.at(-1)));
    this.#hasEnded = true;
    while (this.#numEncoderFrames > 0) this.#run();
    const numLeft = this.#numFrames - this.#numSettled;
    return this.#takeSettled().slice(0, numLeft);
  }

  get #numMels() {
    return this.#network.shape("frames")[2];
  }

  /** Number of complete encoder frames, from the next block's first on. */
  get #numEncoderFrames() {
    const { RIGHT_CONTEXT_FRAMES, FRAMES_PER_ENCODER_FRAME } = this.#constants;
    return Math.max(0, Math.floor((this.#frames.length - 1 - RIGHT_CONTEXT_FRAMES) / FRAMES_PER_ENCODER_FRAME));
  }

  #startTable() {
    const { length, block } = this.#sizes;
    this.#row = this.#numCached = 0;
    this.#numNeeded = length % block || block;
    this.#network.values("state").fill(0);
    for (const ring of this.#rings) ring.fill(0);
  }

  #takeSettled() {
    const rows = this.#settled;
    this.#settled = [];
    this.#numSettled += rows.length;
    return rows;
  }

  /** Compute the next block and its right context. */
  #run() {
    const { FRAMES_PER_ENCODER_FRAME, PADDING, MAX_POSITIONS } = this.#constants;
    const { block, length } = this.#sizes;
    const numComplete = this.#numEncoderFrames;
    let numEncoderFrames = Math.min(numComplete, this.#numNeeded);
    const maxPositions = Math.min(length, MAX_POSITIONS - this.#row);
    if (numEncoderFrames < maxPositions) {
      // one run replaces several runs that settle nothing
      const numMore = Math.min(numComplete, maxPositions) - numEncoderFrames;
      numEncoderFrames += Math.floor(numMore / block) * block;
    }
    const isLast = this.#row + numEncoderFrames === MAX_POSITIONS || (this.#hasEnded && numEncoderFrames === numComplete);
    const numKept = isLast ? 0 : Math.max(0, numEncoderFrames + block - length);
    const numSettled = FRAMES_PER_ENCODER_FRAME * (isLast ? numEncoderFrames : numKept);
    const rows = this.#scores(this.#frames.slice(0, FRAMES_PER_ENCODER_FRAME * numEncoderFrames + PADDING + 1), numEncoderFrames);
    this.#settled.push(...rows.slice(0, numSettled));
    this.#provisional = rows.slice(numSettled);
    this.#frames.splice(0, numSettled);
    if (isLast) {
      this.#startTable();
      return;
    }
    if (numKept) this.#storeContext(numKept);
    this.#numNeeded = Math.min(numEncoderFrames - numKept + block, MAX_POSITIONS - this.#row);
  }

  /** Run the network; return the scores of the states, a row for each frame. */
  #scores(frames, numEncoderFrames) {
    const network = this.#network;
    const [input, positions] = ["frames", "positions"].map((name) => network.values(name));
    const [size, width] = [this.#numMels, network.shape("positions")[2]];
    input.fill(0);
    frames.forEach((frame, i) => input.set(frame, i * size));
    positions.set(this.#table.subarray(this.#row * width, this.#row * width + positions.length));
    network.values("num_positions")[0] = numEncoderFrames;
    network.values("num_cached")[0] = this.#numCached;
    network.run();
    const logPosteriors = network.values("log_posteriors");
    const numStates = this.#logPrior.length;
    return Array.from({ length: this.#constants.FRAMES_PER_ENCODER_FRAME * numEncoderFrames }, (_, row) => {
      const scores = logPosteriors.slice(row * numStates, (row + 1) * numStates);
      for (let i = 0; i < numStates; i++) scores[i] = this.#scale * Math.fround(scores[i] - this.#logPrior[i]);
      return scores;
    });
  }

  /** Store the state, and the keys and values, after the first encoder frames of the block. */
  #storeContext(numKept) {
    const { past } = this.#sizes;
    const [, , numHeads, numNew, size] = this.#network.shape("new");
    const values = this.#network.values("new");
    this.#rings.forEach((ring, number) => {
      for (let head = 0; head < numHeads; head++) {
        for (let position = 0; position < numKept; position++) {
          const from = ((number * numHeads + head) * numNew + position) * size;
          ring.set(values.subarray(from, from + size), (head * past + ((this.#row + position) % past)) * size);
        }
      }
    });
    this.#numCached = Math.min(this.#numCached + numKept, past);
    this.#network.values("state").set(this.#network.values("new_state"));
    this.#row += numKept;
  }
}

/** Return Whisper's table of positions, with unused rows at the end. */
function positionTable(width, numMore, { MAX_POSITIONS, LONGEST_WAVE }) {
  const half = width / 2;
  const step = Math.log(LONGEST_WAVE) / (half - 1);
  const table = new Float32Array((MAX_POSITIONS + numMore) * width);
  for (let row = 0; row < MAX_POSITIONS; row++) {
    for (let i = 0; i < half; i++) {
      const phase = row * Math.exp(-step * i);
      table[row * width + i] = Math.sin(phase);
      table[row * width + half + i] = Math.cos(phase);
    }
  }
  return table;
}
