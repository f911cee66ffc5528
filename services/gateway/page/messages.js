// Binary messages of the gateway; see proto/GATEWAY.md.

export const NUM_FAPS = 68;
const FAP_TYPE = 1;
const SOUND_TYPE = 2;
const REST_TYPE = 3;
const SHAPES_TYPE = 4;
const REST_SHAPES_TYPE = 5;
const HEADER_BYTES = 16;

/**
 * Read a message.
 *
 * @param {ArrayBuffer} data
 * @returns { mediaTime, faps: Float32Array } for a FAP frame, { mediaTime, samples: Int16Array } for
 *   sound, { rest: Float32Array } for the face at rest, { mediaTime, weights: Float32Array } for a
 *   frame's shapes, { restWeights: Float32Array } for shapes at rest, null for an unknown type
 */
export function readMessage(data) {
  const header = new DataView(data);
  const mediaTime = header.getFloat64(8, true);
  switch (header.getUint8(0)) {
    case FAP_TYPE:
      return { mediaTime, faps: new Float32Array(data, HEADER_BYTES, NUM_FAPS) };
    case SOUND_TYPE:
      return { mediaTime, samples: new Int16Array(data, HEADER_BYTES) };
    case REST_TYPE:
      return { rest: new Float32Array(data, HEADER_BYTES, NUM_FAPS) };
    case SHAPES_TYPE:
      return { mediaTime, weights: new Float32Array(data, HEADER_BYTES) };
    case REST_SHAPES_TYPE:
      return { restWeights: new Float32Array(data, HEADER_BYTES) };
    default:
      return null;
  }
}
