// Names that avatars give to their shapes. The table is shared/face/shape_names.txt, and
// shared/face/shape_names.py explains it.

const TABLE = `arkit *jawOpen=mouthOpen jawForward jawLeft jawRight mouthClose mouthLeft mouthRight tongueOut
 *mouthPucker=Mouth_Pucker_Up_L+Mouth_Pucker_Up_R+Mouth_Pucker_Down_L+Mouth_Pucker_Down_R
 mouthFunnel=Mouth_Funnel_Up_L+Mouth_Funnel_Up_R+Mouth_Funnel_Down_L+Mouth_Funnel_Down_R
 mouthRollLower=Mouth_Roll_In_Lower_L+Mouth_Roll_In_Lower_R mouthShrugLower mouthShrugUpper
 mouthRollUpper=Mouth_Roll_In_Upper_L+Mouth_Roll_In_Upper_R mouthPressLeft mouthPressRight
 mouthLowerDownLeft=Mouth_Down_Lower_L mouthLowerDownRight=Mouth_Down_Lower_R
 mouthUpperUpLeft=Mouth_Up_Upper_L mouthUpperUpRight=Mouth_Up_Upper_R
 mouthSmileLeft mouthSmileRight mouthFrownLeft mouthFrownRight mouthDimpleLeft
 mouthDimpleRight mouthStretchLeft mouthStretchRight noseSneerLeft noseSneerRight
 browInnerUp=Brow_Raise_Inner_L+Brow_Raise_Inner_R cheekPuff=Cheek_Puff_L+Cheek_Puff_R
 browOuterUpLeft=Brow_Raise_Outer_L browOuterUpRight=Brow_Raise_Outer_R
 browDownLeft=Brow_Drop_L browDownRight=Brow_Drop_R
 cheekSquintLeft=Cheek_Raise_L cheekSquintRight=Cheek_Raise_R
 eyeBlinkLeft=Eyes_Closed_L eyeBlinkRight=Eyes_Closed_R
 eyeSquintLeft eyeSquintRight eyeWideLeft eyeWideRight
 eyeLookUpLeft=Eye_L_Look_Up eyeLookUpRight=Eye_R_Look_Up
 eyeLookDownLeft=Eye_L_Look_Down eyeLookDownRight=Eye_R_Look_Down
 eyeLookInLeft=Eye_L_Look_R eyeLookInRight=Eye_R_Look_L
 eyeLookOutLeft=Eye_L_Look_L eyeLookOutRight=Eye_R_Look_R
oculus *aa=V_Open=vAA *PP=V_Explosive=vM FF=V_Dental_Lip=vF TH=vTH DD=V_Tongue_Up=vT kk=vK
 CH=V_Affricate=vSH SS=vS nn=vL RR=vER sil E=viseme_E=v_E=vEH
 *ih=viseme_I=V_Wide=vIH *oh=viseme_O=V_Tight_O=vOW *ou=viseme_U=V_Tight=vUW
vrm *aa=A=MTH_A=Mouth_A=Vowel_A=Lip_A=Ah=あ=ア=ｱ *ih=I=MTH_I=Mouth_I=Vowel_I=Lip_I=い=イ=ｲ
 *ou=U=MTH_U=Mouth_U=Vowel_U=Lip_U=Oo=う=ウ=ｳ *ee=E=MTH_E=Mouth_E=Vowel_E=Lip_E=Eh=え=エ=ｴ
 *oh=O=MTH_O=Mouth_O=Vowel_O=Lip_O=お=オ=ｵ blink=EYE_Close=EYE_DEF_C=Eyes_Closed=まばたき=瞬き
 blinkLeft=EYE_Close_L=Wink_L=ウィンク２=ウィンク2=ｳｨﾝｸ２=ｳｨﾝｸ2=ウィンク=ウインク=ｳｨﾝｸ
 blinkRight=EYE_Close_R=Wink_R=ウィンク２右=ウィンク2右=ｳｨﾝｸ２右=ｳｨﾝｸ2右=ウィンク右=ウインク右=ｳｨﾝｸ右
 lookUp lookDown lookLeft lookRight
`;
const TITLES = { arkit: "ARKit", oculus: "Oculus", vrm: "VRM" };
const SEPARATOR = /[._:|/\- ]|eCTRL|(?<=[a-z])(?=[A-Z])/g;

/** Return the shape of each recognized name of a mesh, by name. */
export function findShapes(set, names) {
  const keys = new Set(SETS[set].flatMap(({ choices }) => choices.flat()));
  const byKey = new Map();
  for (const name of names) {
    const key = candidates(name).find((candidate) => keys.has(candidate));
    if (key !== undefined && !byKey.has(key)) byKey.set(key, name);
  }
  const shapes = new Map();
  for (const { shape, choices } of SETS[set]) {
    const parts = choices.find((choice) => choice.some((key) => byKey.has(key))) ?? [];
    for (const key of parts) if (byKey.has(key)) shapes.set(byKey.get(key), shape);
  }
  return shapes;
}

/**
 * Return the set that moves an avatar with these names: the first that is complete, or the nearest
 * to that. Throw an error if the avatar cannot speak.
 */
export function chooseSet(names) {
  const options = Object.keys(SETS).map((set) => {
    const found = new Set(findShapes(set, names).values());
    const needed = SETS[set].filter(({ isNeeded }) => isNeeded).map(({ shape }) => shape);
    const missing = needed.filter((shape) => !found.has(shape));
    const penalty = missing.length / needed.length - found.size / 1000; // between equals, known shapes decide
    return { set, missing, canSpeak: found.has(needed[0]), penalty };
  });
  const speaking = options.filter(({ canSpeak }) => canSpeak);
  const complete = speaking.find(({ missing }) => missing.length === 0);
  const nearest = (list) => list.reduce((best, other) => (other.penalty < best.penalty ? other : best));
  if (speaking.length > 0) return (complete ?? nearest(speaking.reverse())).set;
  const { set, missing } = nearest(options);
  throw new Error(
    `the avatar cannot speak: it has no shape ${missing.join(", ")} of ${TITLES[set]}; ` +
      "use an avatar with the shapes of ARKit, Oculus or VRM",
  );
}

/** Remove a number at the end of a name, and write the side before it as a word. */
function spellOutSide(name) {
  return name
    .replace(/[._ ](div)?\d+$/, "") // Blender appends .001, Daz _div2
    .replace(/(?:[._\- ][Ll]|(?<=[a-z])L)$/, "Left")
    .replace(/(?:[._\- ][Rr]|(?<=[a-z])R)$/, "Right");
}

function toKey(name) {
  return name.replaceAll(SEPARATOR, "").toLowerCase();
}

/** Return a name's keys: one for all its words, and one for those after each separator. */
function candidates(name) {
  const text = spellOutSide(name);
  const keys = [toKey(text)];
  for (const { 0: separator, index } of text.matchAll(SEPARATOR)) {
    const key = toKey(text.slice(index + separator.length));
    if (key.length > (separator ? 1 : 6) || [...".:|/"].includes(separator)) keys.push(key);
  }
  return keys;
}

function readTable() {
  const sets = {};
  let set = "";
  for (const line of TABLE.trimEnd().split("\n")) {
    const words = line.trim().split(" ");
    if (!line.startsWith(" ")) sets[(set = words.shift())] = [];
    for (const word of words) {
      const [shape, ...others] = word.replace("*", "").split("=");
      const choices = [shape, ...others].map((choice) => choice.split("+").map((part) => toKey(spellOutSide(part))));
      sets[set].push({ shape, choices, isNeeded: word.startsWith("*") });
    }
  }
  return sets;
}

const SETS = readTable();
