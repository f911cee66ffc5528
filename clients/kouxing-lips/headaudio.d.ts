/** The interface of HeadAudio (npm @met4citizen/headaudio) with the visemes of this package. */
export class HeadAudio extends GainNode {
  constructor(context: AudioContext, options?: AudioWorkletNodeOptions);
  /** Called when the weight of a viseme changes, for example with ("viseme_aa", 0.4). */
  onvalue: ((name: string, weight: number) => void) | null;
  onstarted: ((event: { event: "started"; t: number }) => void) | null;
  onended: ((event: { event: "ended"; t: number }) => void) | null;
  /** Load the models of this package; HeadAudio's own model is ignored. */
  loadModel(url?: string, reset?: boolean): Promise<void>;
  /** Report the weights that have changed. Call it for each image. */
  update(elapsedMs?: number): void;
  start(): Promise<void>;
  stop(): void;
}
