// node outputs.js headaudio|wlipsync [PROFILE] < SOUND > ROWS: what a package makes of a sound of
// 48 kHz, a row for 0 s and every 10 ms. Sound and rows are float32 without a header; the profile
// (JSON) is wLipSync's.

import { Buffer } from "node:buffer";
import { argv, stdin, stdout } from "node:process";
import { buffer } from "node:stream/consumers";

const [name, profile = "null"] = argv.slice(2);
const { rowsOf } = await import(`./${name}.js`);
const sound = await buffer(stdin);
const samples = new Float32Array(sound.buffer, sound.byteOffset, sound.length / 4);
const rows = await rowsOf(samples, JSON.parse(profile));
stdout.write(Buffer.from(new Float32Array(rows.flat()).buffer));
