/** A set of blendshapes: ARKit's 52, Oculus' 15 visemes, or VRM 1's expressions. */
export type ShapeSetName = "arkit" | "oculus" | "vrm";

export type ExpressionName =
  | "joy"
  | "sadness"
  | "anger"
  | "fear"
  | "disgust"
  | "surprise"
  | "smile"
  | "brow_up"
  | "brow_down"
  | "squint";

export interface EngineOptions {
  /**
   * Whether to recognize phones, which also improve the closures of the lips; default: true. "final" loads the
   * server's block network, which makes fewer errors: 19 MB more, and about ten times the processor time.
   */
  phones?: boolean | "final";
  /** Sets of weights to compute; default: `["arkit"]`. */
  shapes?: ShapeSetName[];
  /** Size of the mouth movements, 0.5 to 2; default: the server's. */
  expressiveness?: number;
  /** How strongly the face shows the feeling in the voice, 0 to 1; default: the server's, 0.5. */
  feeling?: number;
  /** How much later than its sound a frame is made, ms; default: the server's, 60. */
  delayMs?: number;
}

/** The face at one time. It also has an array of weights for each requested set. */
export interface LipFrame extends Partial<Record<ShapeSetName, Float32Array>> {
  /** Seconds from the first sample. */
  timeS: number;
  /** The 68 FAPs of MPEG-4, FAP units. */
  faps: Float32Array;
  /** Whether someone speaks or sings at the end of the sound so far. */
  isSpeaking: boolean;
  /** Whether someone laughs. */
  isLaughing: boolean;
}

/**
 * A recognized phone of Mandarin. It is emitted at least twice: first with an estimated duration,
 * last with `isFinal`. A phone with `isFinal` and the duration 0 is withdrawn.
 */
export interface LipPhone {
  /** Counts the phones of a session from 0. */
  index: number;
  /** An initial, a final, or "sil". */
  symbol: string;
  /** Seconds from the first sample. */
  onsetS: number;
  durationS: number;
  /** 0 to 1. */
  confidence: number;
  isFinal: boolean;
}

/** Lip sync of one voice, without a browser. */
export class LipEngine {
  /** Load the models and start a session. `models` is the URL of their folder; default: the package's. */
  static load(options?: EngineOptions & { sampleRateHz?: number; models?: string | URL }): Promise<LipEngine>;
  /** Names of the weights of each set. */
  readonly names: Partial<Record<ShapeSetName, string[]>>;
  /** Duration of the audio so far, seconds. */
  readonly inputS: number;
  /** Accept samples, mono in [-1, 1]; return the frames that are due, 50 per second. */
  push(samples: Float32Array): LipFrame[];
  /** Phones that the last push() or finish() found or changed. */
  readonly newPhones: LipPhone[];
  /** End the audio; return the remaining frames, until the face is at rest. Further audio needs another engine. */
  finish(): LipFrame[];
  /** Show expressions, strengths 0 to 1, for some seconds. */
  express(strengths: Partial<Record<ExpressionName, number>>, holdS?: number): void;
}
