"""Converts bopomofo (zhuyin), the phonetic letters of Taiwan, to pinyin."""

import re
from collections.abc import Callable

_INITIALS = dict(
    zip("ㄅㄆㄇㄈㄉㄊㄋㄌㄍㄎㄏㄐㄑㄒㄓㄔㄕㄖㄗㄘㄙ",
        "b p m f d t n l g k h j q x zh ch sh r z c s".split(), strict=True)
)  # fmt: skip
_RIMES = dict(
    zip("ㄚㄛㄜㄝㄞㄟㄠㄡㄢㄣㄤㄥㄦ", "a o e ei ai ei ao ou an en ang eng er".split(), strict=True)
)
_FINALS = _RIMES | {
    **{"ㄧ": "i", "ㄧㄚ": "ia", "ㄧㄛ": "iou", "ㄧㄝ": "ie", "ㄧㄠ": "iao", "ㄧㄡ": "iou"},
    **{"ㄧㄢ": "ian", "ㄧㄣ": "in", "ㄧㄤ": "iang", "ㄧㄥ": "ing", "ㄨ": "u", "ㄨㄚ": "ua"},
    **{"ㄨㄛ": "uo", "ㄨㄞ": "uai", "ㄨㄟ": "uei", "ㄨㄢ": "uan", "ㄨㄣ": "uen", "ㄨㄤ": "uang"},
    **{"ㄨㄥ": "ong", "ㄩ": "v", "ㄩㄝ": "ve", "ㄩㄢ": "van", "ㄩㄣ": "vn", "ㄩㄥ": "iong"},
}
_WITHOUT_FINAL = dict.fromkeys("ㄓㄔㄕㄖ", "iii") | dict.fromkeys("ㄗㄘㄙ", "ii")
_TONES = {"": "1", "ˉ": "1", "ˊ": "2", "ˇ": "3", "ˋ": "4", "˙": "5"}
_SYLLABLE = re.compile("(˙?)(?=[ㄅ-ㄩ])([ㄅ-ㄙ]?)([ㄧㄨㄩ]?[ㄚ-ㄦ]?)([ˉˊˇˋ˙]?)")
WORDS_IN_BOPOMOFO = re.compile("([(（]?[ㄅ-ㄩˉˊˇˋ˙](?:[ㄅ-ㄩˉˊˇˋ˙ ]*[ㄅ-ㄩˉˊˇˋ˙])?[)）]?)")


def read_bopomofo(text: str, spell: Callable[[tuple[str, ...]], str]) -> str:
    """Convert syllables in bopomofo to pinyin. ``spell`` spells the phones of a syllable."""
    return _SYLLABLE.sub(lambda match: _spell(match, spell), text)


def _spell(match: re.Match[str], spell: Callable[[tuple[str, ...]], str]) -> str:
    neutral, initial, final, tone = match.groups()
    phone = _FINALS.get(final) if final else _WITHOUT_FINAL.get(initial)
    if phone is None:  # not a syllable
        return match[0]
    if final == "ㄨㄥ" and not initial:
        phone = "ueng"
    phones = (_INITIALS[initial], phone) if initial else (phone,)
    return f" {spell(phones)}{_TONES[neutral or tone]} "
