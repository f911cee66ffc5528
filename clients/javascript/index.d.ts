/** Set of blend shapes. */
export type ShapeSet = "arkit" | "oculus" | "vrm";
/** Number of FAPs. */
export const NUM_FAPS: 68;

/** Media time: samples at 16 kHz since the session's first sample. */
export type MediaTime = number;

export interface SessionMessage {
  /** the one that is shown from here on; null: none */
  session: string | null;
  chosen: string;
  epoch: number;
  lips: string;
  sample: boolean;
}

/** A phone, or with Pinyin's letters a syllable; the same index again revises it. */
export interface PhoneMessage {
  index: number;
  symbol: string;
  media_time: MediaTime;
  /** samples at 16 kHz */
  duration: number;
  confidence: number;
  final: boolean;
}

/** What a viewer calls. All may be left out. */
export interface ViewerHandlers {
  connected?(isConnected: boolean): void;
  /** 68 values in FAP units, FAP 1 first */
  frame?(mediaTime: MediaTime, values: Float32Array): void;
  /** weights of the shapes that were asked for, 0 to 1, and their names */
  weights?(mediaTime: MediaTime, weights: Float32Array, names: string[]): void;
  /** 16 kHz, mono */
  sound?(mediaTime: MediaTime, samples: Int16Array): void;
  /** FAPs of a face while nobody speaks */
  rest?(values: Float32Array): void;
  /** weights of a face while nobody speaks, and their names */
  restWeights?(weights: Float32Array, names: string[]): void;
  session?(message: SessionMessage): void;
  phone?(message: PhoneMessage): void;
  syllable?(message: Omit<PhoneMessage, "confidence">): void;
  speech?(message: { active: boolean; media_time: MediaTime }): void;
  /** no more frames of this session */
  end?(message: { media_time: MediaTime }): void;
  error?(message: { code: string; text: string }): void;
  status?(message: { missing: string[] }): void;
  lips?(message: { lips: string }): void;
}

/** Follows a session, or always the newest; connects again by itself until it is closed. */
export class Viewer {
  constructor(
    gateway: string,
    handlers: ViewerHandlers,
    options?: { session?: string; shapes?: ShapeSet | ""; token?: string },
  );
  /** Fulfilled when a session is shown: nothing that is said from then on is missed. */
  readonly ready: Promise<void>;
  /** Look at another session; "" for the newest. */
  follow(session: string): void;
  /** Send a command of GATEWAY.md, such as { express: { joy: 0.5 } }. */
  send(command: object): void;
  close(): void;
}

export interface SpeakerOptions {
  /** 8000 to 48000; 16000 if not given */
  sampleRateHz?: number;
  numChannels?: 1 | 2;
  /** of bytes that are pushed, and what goes over the wire */
  encoding?: "s16le" | "f32le";
  /** audio may come before its time, as that of a file or of text-to-speech: it goes on in real time */
  ahead?: boolean;
  /** profile of the speaker's voice, base64 */
  voice?: string;
  token?: string;
  /** the session is over; null: as it should be */
  closed?(error: Error | null): void;
}

/** A session of its own: audio goes in. */
export class Speaker {
  private constructor();
  static open(gateway: string, options?: SpeakerOptions): Promise<Speaker>;
  readonly session: string;
  /** Send audio, interleaved; await it where more comes than is spoken. */
  push(audio: Int16Array | Float32Array | Uint8Array | ArrayBuffer): Promise<void>;
  /** Interrupt: audio not yet shown is dropped, and the face returns to rest. */
  flush(): void;
  /** Say that no more audio comes; fulfilled when all is spoken and the session closed. */
  finish(): Promise<void>;
  /** Close the session at once. */
  close(): void;
}

/** Frames of a `.csv` or `.jsonl` of `kouxing listen -o` or `kouxing render -o`. */
export function readRecording(text: string): {
  /** of the shapes; null: the values are the 68 FAPs */
  names: string[] | null;
  frames: [MediaTime, Float32Array][];
};

/** Read one of the gateway's binary messages; null for what a later gateway may send. */
export function readMessage(
  data: ArrayBuffer,
):
  | { mediaTime: MediaTime; faps: Float32Array }
  | { mediaTime: MediaTime; weights: Float32Array }
  | { mediaTime: MediaTime; samples: Int16Array }
  | { restWeights: Float32Array }
  | { rest: Float32Array }
  | null;

/** Frames, or weights, in order of media time, and the face between two of them. */
export class FapTrack {
  reset(): void;
  /** Add a frame; return whether it advances media time. */
  push(mediaTime: MediaTime, values: Float32Array): boolean;
  /** Write the face at a media time; return the media time it belongs to, null without any. */
  sample(mediaTime: MediaTime, out: Float32Array): MediaTime | null;
}

/** Says which media time is due: sound waits for the frames that belong to it. */
export class Playout {
  isHeard: boolean;
  outputLatencyMs: number;
  pictureMs: number;
  readonly offsetMs: number | null;
  readonly delayMs: number | null;
  reset(): void;
  mediaAt(nowMs: number): MediaTime | null;
  frameArrived(nowMs: number, mediaTime: MediaTime): void;
  soundArrived(nowMs: number, mediaTime: MediaTime, numSamples: number): void;
  /** Move towards what was measured; to be called for every picture. */
  adjust(nowMs: number): void;
}
