/** Set of blendshapes. */
export type ShapeSet = "arkit" | "oculus" | "vrm";

/** Media time: samples at 16 kHz since the session's first sample. */
export type MediaTime = number;

export interface SessionMessage {
  /** the session that is shown from now on; null: none */
  session: string | null;
  chosen: string;
  epoch: number;
  lip_model: string;
  /** settings of its face when it started or moved; null: unknown */
  expressiveness: number | null;
  feeling: number | null;
  /** code of the language of the phones, such as "zh"; "": unknown */
  language: string;
  acoustic: string;
  sample: boolean;
}

/** A phone, or a syllable in Pinyin. The same index again revises it. */
export interface PhoneMessage {
  index: number;
  symbol: string;
  media_time: MediaTime;
  /** samples at 16 kHz */
  duration: number;
  confidence: number;
  final: boolean;
}

/** Handlers of a viewer. All are optional. */
export interface ViewerHandlers {
  connected?(isConnected: boolean): void;
  /** 68 values in FAP units, FAP 1 first */
  frame?(mediaTime: MediaTime, values: Float32Array): void;
  /** weights of the requested shapes, 0 to 1, and their names */
  weights?(mediaTime: MediaTime, weights: Float32Array, names: string[]): void;
  /** 16 kHz, mono */
  sound?(mediaTime: MediaTime, samples: Int16Array): void;
  /** FAPs of the face at rest */
  rest?(values: Float32Array): void;
  /** weights of the face at rest, and their names */
  restWeights?(weights: Float32Array, names: string[]): void;
  session?(message: SessionMessage): void;
  phone?(message: PhoneMessage): void;
  syllable?(message: Omit<PhoneMessage, "confidence">): void;
  speech?(message: { active: boolean; media_time: MediaTime }): void;
  /** the session has no more frames */
  end?(message: { media_time: MediaTime }): void;
  error?(message: { code: string; text: string }): void;
  status?(message: { missing: string[] }): void;
  /** One of these settings of the session changed. */
  face?(message: { lip_model: string; expressiveness: number | null; feeling: number | null }): void;
  /** The acoustic model of the session changed: "full" or "light". */
  acoustic?(message: { acoustic: string }): void;
}

/** Follows one session, or always the newest. Reconnects by itself until it is closed. */
export class Viewer {
  constructor(
    gateway: string,
    handlers: ViewerHandlers,
    options?: { session?: string; shapes?: ShapeSet | ""; token?: string },
  );
  /** Resolved when a session is shown. The viewer misses nothing from then on. */
  readonly ready: Promise<void>;
  /** Show another session; "" for the newest. */
  follow(session: string): void;
  /**
   * Send a command of GATEWAY.md, such as { expressions: { joy: 0.5 } }. It waits while the viewer is
   * connecting. It is dropped if that fails, or between two attempts.
   */
  send(command: object): void;
  close(): void;
}

export interface SpeakerOptions {
  /** 8000 to 48000; default 16000 */
  sampleRateHz?: number;
  numChannels?: 1 | 2;
  /** of pushed bytes and of the messages; default "s16le" */
  encoding?: "s16le" | "f32le";
  /** audio may arrive faster than real time, such as text-to-speech; it is played in real time */
  ahead?: boolean;
  /** the speaker's mouth profile, base64 */
  mouthProfile?: string;
  /** language of the speech: "auto", or a code such as "zh" or "de"; default: the recognizer's language */
  language?: string;
  token?: string;
  /** called with each error, such as an unreadable mouth profile; the session may continue */
  error?(error: Error): void;
  /** called when the session has ended; null: without an error */
  closed?(error: Error | null): void;
}

/** A session that this program feeds with audio. */
export class Speaker {
  private constructor();
  static open(gateway: string, options?: SpeakerOptions): Promise<Speaker>;
  readonly session: string;
  /** Send interleaved audio. Await it if audio arrives faster than real time. */
  push(audio: Int16Array | Float32Array | Uint8Array | ArrayBuffer | DataView): Promise<void>;
  /** Interrupt: drop audio whose face is not shown yet. The face returns to rest. */
  flush(): void;
  /** End the audio. Resolved when all is spoken and the session is closed; rejected if an error ends it first. */
  finish(): Promise<void>;
  /** Close the session at once. */
  close(): void;
}

/**
 * Read a `.csv` or `.jsonl` file of `kouxing listen -o` or `kouxing render`, or a take (`.csv`) of the
 * Live Link Face app. Bytes are UTF-8, or UTF-16 with a byte order mark. Throws an error if the recording has no times or no frames, a value
 * is not a number, or a time is earlier than the previous one.
 */
export function readRecording(content: string | ArrayBuffer | Uint8Array): {
  /** names of the shapes; null: the values are the 68 FAPs */
  names: string[] | null;
  frames: [MediaTime, Float32Array][];
};

/** Frames or weights in order of media time, with interpolation. */
export class FapTrack {
  reset(): void;
  /** Add a frame; return whether it advances media time. */
  push(mediaTime: MediaTime, values: Float32Array): boolean;
  /** Write the face at a media time to `out`; return its media time, or null without frames. */
  sample(mediaTime: MediaTime, out: Float32Array): MediaTime | null;
}

/** The playout clock: computes which media time is due. Sound waits for its frames. */
export class Playout {
  isAudible: boolean;
  outputLatencyMs: number;
  imageDelayMs: number;
  readonly offsetMs: number | null;
  readonly delayMs: number | null;
  reset(): void;
  mediaAt(nowMs: number): MediaTime | null;
  frameArrived(nowMs: number, mediaTime: MediaTime): void;
  soundArrived(nowMs: number, mediaTime: MediaTime, numSamples: number): void;
  /** Move toward the measured delay. Call it for every image. */
  adjust(nowMs: number): void;
}
