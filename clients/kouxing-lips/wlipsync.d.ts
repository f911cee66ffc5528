/** The names of the weights; this package needs nothing else of a profile. */
export interface Profile {
  mfccs: { name: string }[];
}

/** The interface of wLipSync (npm wlipsync) with the mouths of this package. */
export class WLipSyncAudioNode extends GainNode {
  private constructor();
  /** How far the mouth moves, 0 to 1. */
  readonly volume: number;
  /** Shares of the vowels by the names of the profile; default: A, I, U, E, O. */
  readonly weights: Record<string, number>;
}

export function createWLipSyncNode(context: AudioContext, profile?: Profile | null): Promise<WLipSyncAudioNode>;
/** Binary profiles are ignored. */
export function parseBinaryProfile(buffer: ArrayBuffer): null;
