// The text to read aloud: "The North Wind and the Sun" by Aesop, which is common in phonetics.

export const READING_TEXTS = {
  zh:
    "有一回，北风跟太阳正在那儿争论谁的本事大。说着说着，来了一个过路的，身上穿着一件厚袍子。它们俩就商量好了，" +
    "说谁能先叫这个过路的把他的袍子脱下来，就算谁的本事大。北风就使劲儿地吹起来了，可是它越是吹得厉害，那个人就把袍子裹得越紧。" +
    "后来北风没法子了，只好就算了。过了一会儿，太阳出来了，热热地一晒，那个人马上就把袍子脱下来了。" +
    "北风不得不承认，还是太阳比它的本事大。",
  en:
    "The North Wind and the Sun were disputing which was the stronger, when a traveller came along " +
    "wrapped in a warm cloak. They agreed that the one who first succeeded in making the traveller " +
    "take his cloak off should be considered stronger than the other. Then the North Wind blew as " +
    "hard as he could, but the more he blew the more closely did the traveller fold his cloak " +
    "around him; and at last the North Wind gave up the attempt. Then the Sun shone out warmly, and " +
    "immediately the traveller took off his cloak. And so the North Wind was obliged to confess " +
    "that the Sun was the stronger of the two.",
};
