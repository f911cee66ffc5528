import type { EngineOptions, ExpressionName, LipFrame, LipPhone, ShapeSetName } from "./engine.js";

export type { EngineOptions, ExpressionName, LipFrame, LipPhone, ShapeSetName };

export interface LipSyncEventMap {
  /** Speech or laughter starts or ends. */
  voice: CustomEvent<{ timeS: number; isSpeaking: boolean; isLaughing: boolean }>;
  /** A phone is found or changed. */
  phone: CustomEvent<LipPhone>;
  /** New frames; `startS` is the start of the session on the clock of `context`, null for push(). */
  frames: CustomEvent<{ frames: LipFrame[]; startS: number | null }>;
  /** A message for the user, for example that the page needs a click; empty when it no longer applies. */
  notice: CustomEvent<string>;
  /** An AudioBuffer has been played. */
  ended: Event;
}

/** Lip sync in a page. One voice at a time; a new source replaces the last one. */
export class LipSync extends EventTarget {
  /**
   * Load the models and the worker. `models` is the URL of their folder; default: the package's.
   * `context` is an audio context of the page; default: a new one.
   */
  static create(options?: EngineOptions & { models?: string | URL; context?: AudioContext }): Promise<LipSync>;
  /** Names of the weights of each set; available after the first source. */
  readonly names: Partial<Record<ShapeSetName, string[]>>;
  /** The audio context of this lip sync. */
  readonly context: AudioContext;
  /** The audio node of the current source, for example for a meter; null without one. */
  readonly node: AudioNode | null;
  /** The face to show now; null before the first frame. */
  readonly current: LipFrame | null;
  /**
   * Return the face at a time of the session, seconds, or the nearest face that is kept; null before the first frame.
   * The last hour of pushed audio is kept, and the last minute of a source of listenTo().
   */
  at(timeS: number): LipFrame | null;
  /**
   * Follow the microphone. Rejects with a message for the user if it cannot be opened, and with an AbortError in the same cases as
   * listenTo().
   */
  listenToMicrophone(constraints?: MediaTrackConstraints): Promise<void>;
  /**
   * Follow a source. AudioBuffers and media elements are also played, in sync with the face.
   * Rejects with an AbortError if another source is chosen, or stop() or close() is called, while it opens.
   */
  listenTo(source: MediaStream | MediaStreamTrack | AudioBuffer | HTMLMediaElement | AudioNode): Promise<void>;
  /** Start a session for push(). Rejects with an AbortError in the same cases as listenTo(). */
  open(sampleRateHz: number): Promise<void>;
  /** Accept PCM, mono in [-1, 1]. It may arrive faster than real time. Throws an error unless open() has opened a session. */
  push(samples: Float32Array): void;
  /** End pushed audio. Resolves when all its frames are known. */
  finish(): Promise<void>;
  /** Show expressions, strengths 0 to 1, for some seconds. */
  express(strengths: Partial<Record<ExpressionName, number>>, holdS?: number): void;
  /** Start suspended sound. Call it from a click handler. */
  resume(): Promise<void>;
  /** Stop following the sound, and end pushed audio. The face returns to rest. A media element is still heard. */
  stop(): void;
  /** Stop, and release all resources. */
  close(): void;
  addEventListener<K extends keyof LipSyncEventMap>(
    type: K,
    listener: (this: LipSync, event: LipSyncEventMap[K]) => void,
    options?: boolean | AddEventListenerOptions,
  ): void;
  addEventListener(type: string, listener: EventListenerOrEventListenerObject, options?: boolean | AddEventListenerOptions): void;
}
