import type { PhoneMessage, SessionMessage, ShapeSet } from "./index.js";

/** The main methods of LipSync; the types of kouxing-lips have all. */
export interface LocalLips extends EventTarget {
  listenToMicrophone(constraints?: MediaTrackConstraints): Promise<void>;
  listenTo(source: MediaStream | MediaStreamTrack | AudioBuffer | HTMLMediaElement | AudioNode): Promise<void>;
  express(strengths: Record<string, number>, holdS?: number): void;
  resume(): Promise<void>;
  stop(): void;
  addEventListener(
    type: "notice",
    listener: (this: LocalLips, event: CustomEvent<string>) => void,
    options?: boolean | AddEventListenerOptions,
  ): void;
  addEventListener(
    type: string,
    listener: EventListenerOrEventListenerObject,
    options?: boolean | AddEventListenerOptions,
  ): void;
}

export interface KouxingFaceEventMap extends HTMLElementEventMap {
  notice: CustomEvent<string>;
  session: CustomEvent<SessionMessage>;
  phone: CustomEvent<PhoneMessage>;
}

/**
 * `<kouxing-face>`. Attributes: `src` (a GLB or VRM), `gateway`, `session`, `token`, or `recording`, or `local` and `phones`, or `manual`.
 * Events: `load`, `error`, `session`, `phone`, `notice`.
 */
export class KouxingFace extends HTMLElement {
  /** Set of values that moves the model; null before loading. */
  readonly set: ShapeSet | "faps" | null;
  /** The shown values: weights by name, or 68 FAPs; null before the first. */
  readonly shown: Record<string, number> | number[] | null;
  /** The local lip sync; throws an error without the attribute `local`, or if the element is not in the page. */
  readonly lips: Promise<LocalLips>;
  /** Turn the session's sound on. Call it from a click handler. */
  turnSoundOn(): Promise<void>;
  turnSoundOff(): void;
  /** Show values of the model's set: 68 FAPs, or weights with their names. Throws a RangeError for others, and for NaN. */
  show(values: Float32Array, names?: readonly string[]): void;
  /**
   * Play the recording, with the sound of an audio element. Resolves when it ends. Rejects with an AbortError if the
   * face is removed or gets another model before the recording starts.
   */
  play(audio?: HTMLAudioElement | null): Promise<void>;
  addEventListener<K extends keyof KouxingFaceEventMap>(
    type: K,
    listener: (this: KouxingFace, event: KouxingFaceEventMap[K]) => void,
    options?: boolean | AddEventListenerOptions,
  ): void;
  addEventListener(
    type: string,
    listener: EventListenerOrEventListenerObject,
    options?: boolean | AddEventListenerOptions,
  ): void;
}

declare global {
  interface HTMLElementTagNameMap {
    "kouxing-face": KouxingFace;
  }
}
