// What the panel offers to choose from, in both languages.

export const HEADS = [
  ["", { en: "as started", zh: "启动时的头像" }],
  ["woman", { en: "woman", zh: "女士" }],
  ["man", { en: "man", zh: "男士" }],
  ["elder", { en: "elder", zh: "老人" }],
  ["child", { en: "child", zh: "孩子" }],
  ["ada", { en: "Ada", zh: "艾达" }],
  ["leo", { en: "Leo", zh: "利奥" }],
  ["rosa", { en: "Rosa", zh: "罗莎" }],
  ["mika", { en: "Mika (cartoon)", zh: "米卡（卡通）" }],
];

export const LIPS = [
  ["learnt", { en: "from the sound (learnt)", zh: "由声音（学得）" }],
  ["dynamic-visemes", { en: "from the phones (dynamic visemes)", zh: "由音素（动态视位）" }],
  ["ferguson", { en: "from one opening (Ferguson)", zh: "由单一开口（Ferguson）" }],
];

export const EXPRESSIONS = [
  ["smile", { en: "smile", zh: "微笑" }],
  ["joy", { en: "joy", zh: "高兴" }],
  ["surprise", { en: "surprise", zh: "惊讶" }],
  ["sadness", { en: "sadness", zh: "悲伤" }],
  ["anger", { en: "anger", zh: "生气" }],
  ["fear", { en: "fear", zh: "害怕" }],
  ["disgust", { en: "disgust", zh: "厌恶" }],
];
