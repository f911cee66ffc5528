"""The lexicon of Mandarin: Chinese text to pinyin (its Latin spelling), and pinyin to phones.

Source of the phones: Li et al. 2011, section 3.1 (21 initials, 38 finals). Spelling rules: the
Scheme for the Chinese Phonetic Alphabet (1958) and ISO 7098:2015.

Decisions beyond these sources:

- A syllable is valid if its final belongs to a row that its initial allows (``j q x`` only before i
  and ü, and so on). This accepts rare readings (``biang``, ``fiao``, ``den``) on which word lists
  differ, and rejects typing errors (``muo``, ``ja``).
- Er-hua (an r-colored ending) as a separate syllable (``er5`` or ``r5``) is the phone ``er``. In a
  syllable (``huar1``), ``er`` follows the syllable's final.
- The syllable ``ê`` (also ``eh``) is ``ei``, the nearest phone by mouth shape. ``yo`` is ``iou``,
  and ``wong`` is ``ueng``. ``yai`` (an old reading of 崖) is ``ia`` + ``i``.
- The interjections ``m n ng hm hng`` have no final. They are the nasal initials with the same mouth
  shape (``n`` for ``ng``), after ``h`` if it is written.
"""

import re
import unicodedata
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache

from kouxing.shared.errors import UserError
from kouxing.shared.phones.mandarin.bopomofo import WORDS_IN_BOPOMOFO, read_bopomofo
from kouxing.shared.phones.mandarin.numbers import rewrite_ambiguous_numbers, spell_numbers
from kouxing.shared.phones.mandarin.particles import readings_in_context
from kouxing.shared.phones.transcript import SpokenSyllable, Transcript

# Longest first, so that zh is not read as z + h.
_INITIALS_BY_LENGTH = tuple("zh ch sh b p m f d t n l g k h j q x r z c s".split())

# Rows of finals: the initials before them, and their spellings. A spelling is also the phone,
# except in SPELLING=PHONE. After j q x, a written u is ü.
_ROWS = (
    ("b p m f d t n l g k h zh ch sh r z c s", "u a e ai ei ao ou an en ang eng ong"),
    ("b p m f l", "o"),
    ("b p m f d t n l j q x", "i ia ie iao ian in iang ing iong iu=iou"),
    ("d t n l g k h zh ch sh r z c s", "ua uo uai uan uang ui=uei un=uen"),
    ("n l j q x", "v ve van vn ue=ve"),
    ("j q x", "u=v uan=van un=vn"),
    ("zh ch sh r", "i=iii"),
    ("z c s", "i=ii"),
)
_FINALS = {
    (initial, spelling): phone or spelling
    for initials, finals in _ROWS
    for initial in initials.split()
    for spelling, _, phone in (final.partition("=") for final in finals.split())
}
_V_PHONES = ("v", "ve", "van", "vn")

_WITHOUT_INITIAL = {
    **{phone: (phone,) for phone in "a o e er ai ei ao ou an en ang eng".split()},
    **{"yi": ("i",), "ya": ("ia",), "ye": ("ie",), "yao": ("iao",), "you": ("iou",)},
    **{"yan": ("ian",), "yin": ("in",), "yang": ("iang",), "ying": ("ing",), "yong": ("iong",)},
    **{"wu": ("u",), "wa": ("ua",), "wo": ("uo",), "wai": ("uai",), "wei": ("uei",)},
    **{"wan": ("uan",), "wen": ("uen",), "wang": ("uang",), "weng": ("ueng",)},
    **{"yu": ("v",), "yue": ("ve",), "yuan": ("van",), "yun": ("vn",)},
    **{"yv": ("v",), "yve": ("ve",), "yvan": ("van",), "yvn": ("vn",)},
    **{"ê": ("ei",), "eh": ("ei",), "yo": ("iou",), "wong": ("ueng",), "yai": ("ia", "i")},
    **{"r": ("er",), "m": ("m",), "n": ("n",), "ng": ("n",), "hm": ("h", "m"), "hng": ("h", "n")},
}

# Spelling of finals: without initial (the first spelling above), after an initial, after j q x.
_SPELLED_ALONE = {
    phones[0]: spelling
    for spelling, phones in reversed(_WITHOUT_INITIAL.items())
    if len(phones) == 1 and phones[0] not in _INITIALS_BY_LENGTH
}
_SPELLED_AFTER = {"ii": "i", "iii": "i", "iou": "iu", "uei": "ui", "uen": "un"}
_SPELLED_AFTER |= {phone: "ü" + phone[1:] for phone in _V_PHONES}
_SPELLED_AFTER_J = {phone: "u" + phone[1:] for phone in _V_PHONES}

_CHINESE = re.compile("[〇\u3400-\u9fff\uf900-\ufaff\U00020000-\U0003ffff]")
_PINYIN_WORD = re.compile(r"(?:[^\W_]|[\u0300-\u036f]|(?<=[uU]):)+")
_LETTER = "[A-Za-z\u00c0-\u024f\u0300-\u036f]"
_MARKED = "[āáǎàēéěèīíǐìōóǒòūúǔùǖǘǚǜńňǹḿĀÁǍÀĒÉĚÈŌÓǑÒ\u0300\u0301\u0304\u030c]"
_TONED_WORD = f"(?:[a-zü][a-zü:]*[1-5]|(?={_LETTER}*{_MARKED}){_LETTER}++)"
_TONELESS = (
    "(?:de|le|ma|ba|ne|zi|men|tou|zhe|guo|a|ya|me|er|r|ge|li|shang)"  # after other syllables
)
_TONED_WORDS = (
    rf"[(（]?(?<!{_LETTER}){_TONED_WORD}"
    rf"(?:[\s'’,.!?;，。！？；：、…“”-]{{0,3}}(?:{_TONED_WORD}|{_TONELESS}(?!{_LETTER}|\d)))*"
    rf"(?!{_LETTER}|\d)[)）]?"
)
_ANNOTATION = re.compile(f"{WORDS_IN_BOPOMOFO.pattern}|{_TONED_WORDS}")
_MIN_ALIKE = 0.7  # fraction of equal syllables: characters may have several readings
_MAX_WORD_LETTERS = 500
_MAX_LETTERS = 10  # limit for a syllable with its tone, decomposed
_LATIN = "A-Za-z\u00c0-\u04ff"
_SPACE_BESIDE_CHARACTER = re.compile(f"(?<![{_LATIN}]) | (?![{_LATIN}])")
# Traditional characters with two simplified ones, where the reading differs from the usual one.
_READ_AS = (
    (re.compile("(?<![名顯显原編编論论卓土昭])著(?![名作者稱称書书述])"), "着"),
    (re.compile("乾(?![隆坤卦])"), "干"),
)
_KEYCAP = re.compile("[0-9#*]\ufe0f?\u20e3")  # emoji of a key, a bullet
_NUMERAL = re.compile("[①-⒛Ⅰ-Ⅻⅰ-ⅻ㈠-㈩㊀-㊉]")  # a number as one character
_NUMBER = re.compile(r"(?<![^\W_])\d")  # the start of a number, but not a tone
_LETTERS = str.maketrans("ɑɡ\u0306", "ag\u030c")  # schoolbook letters; a breve instead of a caron
_TONES = {"\u0304": 1, "\u0301": 2, "\u030c": 3, "\u0300": 4}  # combining marks


def phones_of_syllable(syllable: str) -> tuple[str, ...]:
    """Split a pinyin syllable into an initial and a final, or only a final; er-hua adds ``er``.

    Parameters
    ----------
    syllable
        One syllable, with or without a tone digit (1-5, 0) or a tone mark. ü may be written ``ü``,
        ``v`` or ``u:``. Case is ignored.

    Raises ``UserError`` if the syllable does not exist in Mandarin.

    Examples
    --------
    >>> phones_of_syllable("zhuang1")
    ('zh', 'uang')
    >>> phones_of_syllable("yuán")
    ('van',)
    """
    plain = _normalize_syllable(syllable)
    phones = _syllable_phones(plain)
    if phones is None and plain.endswith("r"):  # er-hua: hua + r
        stem = _syllable_phones(plain[:-1])
        phones = (*stem, "er") if stem else None
    if phones is None:
        raise UserError(
            f"unknown pinyin syllable {syllable!r}; write one syllable such as zhuang1, lü4 or er5"
        )
    return phones


@lru_cache(maxsize=8192)
def spell(phones: tuple[str, ...]) -> str:
    """Return the pinyin of a syllable's phones, without tone; an initial is its own spelling.

    Examples
    --------
    >>> spell(("sh", "iii"))
    'shi'
    >>> spell(("van",))
    'yuan'
    """
    *initial, final = phones
    if not initial:
        return _SPELLED_ALONE.get(final) or _SPELLED_AFTER.get(final, final)
    if initial[0] in "jqx":
        final = _SPELLED_AFTER_J.get(final, final)
    return initial[0] + _SPELLED_AFTER.get(final, final)


@lru_cache(maxsize=8192)
def write(spelling: str) -> str:
    """Return a syllable with tone mark and ü, or a phone as it is written in a syllable.

    The mark is on a or e, on the o of ou, and otherwise on the last vowel (ISO 7098). pypinyin's
    ``to_tone`` is not used: it writes ng1 as n1g, and its tables take 0.3 s to load.

    Examples
    --------
    >>> write("lv4"), write("gui4"), write("er5"), write("uei")
    ('lǜ', 'guì', 'er', 'ui')
    """
    plain = _normalize_syllable(spelling)
    if plain in _SPELLED_AFTER:
        return _SPELLED_AFTER[plain]
    letters = plain.replace("v", "u" if plain[0] in "jqxy" else "ü")
    tone = _to_tone_digit(spelling)[-1]
    mark = next((mark for mark, number in _TONES.items() if str(number) == tone), None)
    patterns = ("[aeê]|o(?=u)", "[iouü](?=[^iouü]*$)", "[mn]")  # without a vowel: hm, ng, r
    marked = next(filter(None, (re.search(pattern, letters) for pattern in patterns)), None)
    if mark is None or marked is None:
        return letters
    place = marked.end()
    return unicodedata.normalize("NFC", letters[:place] + mark + letters[place:])


def transcribe(text: str) -> Transcript:
    """Convert a text to syllables: characters, numbers and dates, or pinyin and bopomofo.

    Among characters, bopomofo and pinyin with tones are also read. They are the reading of the
    characters before or after them if they sound alike, or if they follow in brackets. Punctuation,
    and spaces between Chinese characters, are ignored. Other words and symbols are dropped: letters
    among characters, and unknown pinyin syllables. Joined syllables without tones (``nihao``) are
    split only if most letters are pinyin, because words of other languages may look the same.

    Examples
    --------
    >>> [syllable.spelling for syllable in transcribe("10月1日").syllables]
    ['shi2', 'yue4', 'yi1', 'ri4']
    >>> transcribe("ni3 hao3, Tom").dropped
    ('Tom',)
    """
    text = _NUMERAL.sub(lambda match: f" {unicodedata.numeric(match[0]):.0f} ", text)
    text = _KEYCAP.sub(" ", text)
    if _CHINESE.search(text):
        return _read_annotated(text)
    if not any(letter.isalpha() for letter in text):
        return _read_characters(text)
    if _NUMBER.search(text):
        numbers = _read_characters(text)
        if not numbers.dropped:  # numbers with units, such as 100kg
            return numbers
    text = read_bopomofo(text, spell)
    words = _PINYIN_WORD.findall(unicodedata.normalize("NFKC", text))
    spellings = [_split_word(word) for word in words]
    without_tones = [
        split or _split_toneless(word) for split, word in zip(spellings, words, strict=True)
    ]
    num_readable = sum(len(word) for word, split in zip(words, without_tones, strict=True) if split)
    if num_readable > sum(map(len, words)) / 2:
        spellings = without_tones
    syllables = tuple(
        SpokenSyllable(spelling, _to_tone_digit(spelling), phones_of_syllable(spelling))
        for split in spellings
        for spelling in split
    )
    dropped = tuple(word for word, split in zip(words, spellings, strict=True) if not split)
    return Transcript(syllables, dropped)


def _split_word(word: str) -> list[str]:
    """Split a pinyin word with tones (``nǐhǎo``, ``ni3hao3``) into syllables; empty: impossible.

    Within a word, a syllable that starts with a, o or e follows an apostrophe (GB/T 16159).
    """
    if len(word) > _MAX_WORD_LETTERS:
        return []
    if _is_syllable(word):
        return [word]
    for end in range(min(len(word) - 1, _MAX_LETTERS), 0, -1):
        has_tone = re.search(r"\d$", _to_tone_digit(word[:end]))
        if (
            has_tone
            and _normalize_syllable(word[end:])[:1] not in "aoeê"
            and _is_syllable(word[:end])
        ):
            rest = _split_word(word[end:])
            if rest:
                return [word[:end], *rest]
    return []


def _split_toneless(word: str) -> list[str]:
    """Split a pinyin word without tones (``nihao``, ``tiananmen``); empty if this is impossible.

    Prefers a split in which only the first syllable may start with a, o or e.
    """
    if re.search(r"\d", _to_tone_digit(word)):  # a typing error
        return []
    word = _normalize_syllable(word)
    for later_starts in ("", "aoeê"):
        splits: dict[int, list[str]] = {len(word): []}  # by start: splits of the rest of the word
        for place in range(min(len(word), _MAX_WORD_LETTERS) - 1, -1, -1):
            if place and word[place] in "aoeê" and not later_starts:
                continue
            for end in range(min(place + _MAX_LETTERS, len(word)), place, -1):
                syllable = word[place:end]
                is_known = syllable in _syllables_of_characters() or (
                    syllable == "r" and 0 < place == len(word) - 1
                )
                if is_known and end in splits:
                    splits[place] = [syllable, *splits[end]]
                    break
        if 0 in splits:
            return splits[0]
    return []


@lru_cache(maxsize=1)
def _syllables_of_characters() -> frozenset[str]:
    """Return the syllables of all characters, without tones."""
    from pypinyin.constants import PINYIN_DICT  # noqa: PLC0415 (few callers need it)

    readings = {reading for line in PINYIN_DICT.values() for reading in line.split(",")}
    return frozenset(
        plain for plain in map(_normalize_syllable, readings) if re.search("[aeêiouv]", plain)
    )


def _is_syllable(word: str) -> bool:
    try:
        phones_of_syllable(word)
    except UserError:
        return False
    return True


def _read_annotated(text: str) -> Transcript:
    """Read characters with words in bopomofo or toned pinyin, or with readings of characters.

    A reading follows its characters, or precedes them, such as the lines of pinyin in textbooks.
    """
    syllables: list[SpokenSyllable] = []
    dropped: list[str] = []
    end = 0
    announced: tuple[SpokenSyllable, ...] = ()  # a reading whose characters may follow
    for match in (*_ANNOTATION.finditer(text), None):
        reading = transcribe(match[0]) if match else Transcript(())
        if match and reading.dropped and re.search("[A-Za-z]", match[0]):  # not pinyin, as mp3
            continue
        characters = _read_characters(text[end : match.start() if match else None])
        following = characters.syllables[: len(announced)]
        if _sound_alike(following, announced):
            syllables[-len(announced) :] = _annotate(following, announced)
            syllables += characters.syllables[len(announced) :]
        else:
            syllables += characters.syllables
        dropped += characters.dropped + reading.dropped
        if match:
            end, announced = match.end(), reading.syllables
            preceding = syllables[max(0, len(syllables) - len(announced)) :]
            if match[0][0] in "(（" or _sound_alike(preceding, announced):
                syllables[len(syllables) - len(preceding) :] = _annotate(preceding, announced)
                announced = ()
            else:
                syllables += announced
    return Transcript(tuple(syllables), tuple(dropped))


def _sound_alike(characters: Sequence[SpokenSyllable], reading: Sequence[SpokenSyllable]) -> bool:
    if not reading or len(characters) != len(reading):
        return False
    num_equal = sum(
        character.phones == syllable.phones
        for character, syllable in zip(characters, reading, strict=True)
    )
    return num_equal >= _MIN_ALIKE * len(reading)


def _annotate(
    characters: Sequence[SpokenSyllable], reading: Sequence[SpokenSyllable]
) -> Sequence[SpokenSyllable]:
    """Return characters with the phones of a reading."""
    if len(characters) != len(reading):
        return reading
    return [
        replace(syllable, text=character.text)
        for character, syllable in zip(characters, reading, strict=True)
    ]


def _read_characters(text: str) -> Transcript:
    text = rewrite_ambiguous_numbers(text)
    without_spaces = _SPACE_BESIDE_CHARACTER.sub("", " ".join(text.split()))
    characters = spell_numbers(without_spaces)
    syllables = tuple(
        SpokenSyllable(character, spelling.replace("v", "ü"), phones_of_syllable(spelling))
        for character, spelling in zip(characters, _convert_to_pinyin(characters), strict=True)
        if spelling
    )
    readable = {syllable.text for syllable in syllables}
    dropped = "".join(
        letter if letter not in readable and _is_spoken(letter) else " " for letter in characters
    )
    return Transcript(syllables, tuple(dropped.split()))


def _convert_to_pinyin(characters: str) -> list[str]:
    """Return the pinyin of each character of a text; "" for other characters."""
    from pypinyin import Style, lazy_pinyin  # noqa: PLC0415 (takes 0.3 s, and few callers read text)

    simplified = _simplify(characters)
    syllables: list[str] = lazy_pinyin(
        simplified,
        style=Style.TONE3,
        errors=lambda unknown: [""] * len(unknown),  # type: ignore[arg-type,return-value]
        neutral_tone_with_five=True,
        v_to_u=False,
    )
    for index, reading in readings_in_context(simplified):
        syllables[index] = reading
    return syllables


def _simplify(characters: str) -> str:
    """Replace traditional characters, whose readings in words pypinyin lacks: 音樂 -> 音乐."""
    for pattern, replacement in _READ_AS:
        characters = pattern.sub(replacement, characters)
    return "".join(
        letter if letter.encode("gb2312", "ignore") else _simplify_character(letter)
        for letter in characters
    )


@lru_cache(maxsize=8192)
def _simplify_character(character: str) -> str:
    from wetext import Normalizer  # noqa: PLC0415 (takes 0.3 s)

    simplified: str = Normalizer(lang="zh", operator="tn", traditional_to_simple=True).normalize(
        character
    )
    return simplified if len(simplified) == 1 else character


def _is_spoken(letter: str) -> bool:
    """Return whether a character is not punctuation, a separator, a mark or a control character."""
    return unicodedata.category(letter)[0] not in "PZCM" and letter not in "~～"


def _to_tone_digit(syllable: str) -> str:
    """Write a tone mark as a digit: pǎo -> pao3."""
    decomposed = unicodedata.normalize("NFD", syllable).translate(_LETTERS)
    digits = [str(_TONES[mark]) for mark in decomposed if mark in _TONES]
    letters = "".join(mark for mark in decomposed if mark not in _TONES)
    return unicodedata.normalize("NFC", letters) + "".join(digits[:1])


def _normalize_syllable(syllable: str) -> str:
    """Return a syllable in lower case, with v for ü, without its tone."""
    decomposed = unicodedata.normalize("NFD", syllable.strip().lower()).translate(_LETTERS)
    toneless = "".join(mark for mark in decomposed if mark not in _TONES)
    composed = unicodedata.normalize("NFC", toneless)
    return re.sub(r"[0-5]$", "", composed).replace("u:", "v").replace("ü", "v")


@lru_cache(maxsize=1024)
def _syllable_phones(plain: str) -> tuple[str, ...] | None:
    """Return the phones of a syllable without er-hua, or None if it does not exist."""
    if plain in _WITHOUT_INITIAL:
        return _WITHOUT_INITIAL[plain]
    initial = next((phone for phone in _INITIALS_BY_LENGTH if plain.startswith(phone)), None)
    if initial is None:
        return None
    final = _FINALS.get((initial, plain.removeprefix(initial)))
    return (initial, final) if final else None
