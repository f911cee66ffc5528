import type { PhoneMessage, SessionMessage, ShapeSet } from "./index.js";

export interface KouxingFaceEventMap extends HTMLElementEventMap {
  session: CustomEvent<SessionMessage>;
  phone: CustomEvent<PhoneMessage>;
}

/**
 * `<kouxing-face>`. Attributes: `src` (a GLB or VRM), `gateway`, `session`, `token`, or `recording`.
 * Events: `load`, `error`, `session`, `phone`.
 */
export class KouxingFace extends HTMLElement {
  /** What moves the model; null until it is loaded. */
  readonly set: ShapeSet | "faps" | null;
  /** What is shown: weights by name, or 68 FAPs; null until there is something. */
  readonly shown: Record<string, number> | number[] | null;
  /** Let the session be heard; call it from a click. */
  turnSoundOn(): Promise<void>;
  turnSoundOff(): void;
  /** Play the recording to its end, or until another begins; an audio element may play its sound. */
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
