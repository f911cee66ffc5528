"""Converts the numbers, dates, times and units of Chinese texts to words.

wetext converts most of them. However, it reads every pair that may be a month and a day as a date,
and other pairs as subtractions. Such pairs are therefore rewritten first:

- 12-25 is a range, 25-12 and 比分12-25 are scores. Dates have a year or a zero: 2024-12-25, 02-05.
- 12.25 is a decimal.
"""

import re

# wetext gets one sentence at a time: its time and memory grow with the square of the length.
_SENTENCE = re.compile(
    r"[^。！？]{1,500}(?![^。！？])[。！？]*|.{1,500}(?<!\d)|.{1,500}", re.DOTALL
)
_HALF_WIDTH = str.maketrans("０１２３４５６７８９．％￥", "0123456789.%¥")
_PHONE_NUMBER = re.compile(
    r"(?<!\d)(?:(?P<prefix>\+86)[ -]?)?(1\d\d|0\d{2,3})(?P<gap>[ -]?)(\d{4})(?P=gap)(\d{4})(?!\d)"
)
_DIGITS = str.maketrans("0123456789.", "零一二三四五六七八九点", "·")
_DATE = (
    r"(?<![\d.:/-])((?:19|20)\d\d)([-/.])(0?[1-9]|1[0-2])\2(0?[1-9]|[12]\d|3[01])"
    r"(?![\d./-])[日号號]?"
)
# Telephone and account numbers, numbers with a leading zero, versions such as 1.2.3, and 9·11.
_READ_DIGIT_BY_DIGIT = (
    r"(?<![\d.])\d{13,}(?![\d.])"
    r"|(?<![\d.,:/-])0\d+(?![\d%]|[.,:/-]\d|[月日号號])"
    r"|(?<![\d.])(?!(?:19|20)\d\d\.)\d+(?:\.\d+){2,}(?![\d.])"
    r"|(?<!\d)\d{1,2}·\d{1,2}(?!\d)"
)
# Two numbers with a hyphen that are not a date (2024-12, 02-05), a time or a telephone number.
_RANGE = (
    r"(比[分数]\D{0,3})?(?<![\d.:/-])(?!(?:19|20)\d\d-(?:0?[1-9]|1[0-2])(?!\d)|0\d-)"
    r"(\d+(?:\.\d+)?)-(?=(\d+(?:\.\d+)?)(?![\d.:/-]| *=)"
    r"([胜勝负負平赢贏输輸战戰]|[大险險获獲][胜勝]|领先|領先|落后|落後|击败|擊敗)?)"
)


def rewrite_ambiguous_numbers(text: str) -> str:
    """Rewrite the numbers that wetext 0.1 reads wrongly."""
    text = _PHONE_NUMBER.sub(_join_phone_number, text.translate(_HALF_WIDTH))
    text = re.sub(r"(?<=\d)\s+(?=\d)", "、", text)  # different numbers
    for pattern, replacement in _NUMBER_SPELLINGS:
        text = pattern.sub(replacement, text)
    return text


def spell_numbers(text: str) -> str:
    """Convert numbers, dates, times and units to words: 3.5% -> 百分之三点五."""
    return "".join(map(_read_sentence, _SENTENCE.findall(text)))


def _read_sentence(text: str) -> str:
    if not re.search(r"\d", text):
        return text
    from wetext import Normalizer  # noqa: PLC0415 (takes 0.3 s)

    read: str = Normalizer(lang="zh", operator="tn").normalize(text)
    return read.replace("第两", "第二")  # ordinals: wetext 0.1 reads every 2 before a measure as 两


def _read_range(match: re.Match[str]) -> str:
    """Read 12-25 as a range, and 25-12 or 比分12-25 as a score."""
    before, first, second, result = match.groups(default="")
    is_score = before or result or float(first) >= float(second)
    return f"{before}{first}{'比' if is_score else '~'}"


def _read_date(match: re.Match[str]) -> str:
    year, _, month, day = match.groups()
    return f"{year}年{int(month)}月{int(day)}日"


def _join_phone_number(match: re.Match[str]) -> str:
    prefix, *parts = match.group("prefix", 2, 4, 5)
    return f"{'加八六' if prefix else ''}{''.join(parts)}"


def _read_digits(number: str) -> str:
    return number.translate(_DIGITS)


# Rewritten before wetext 0.1 reads numbers, because it reads these wrongly.
_NUMBER_SPELLINGS = tuple(
    (re.compile(pattern), replacement)
    for pattern, replacement in (
        (r"(?<=\d)：(?=\d)", ":"),
        (r"(?<![A-Za-z])(?:上午)? ?[Aa][Mm] ?(?=\d{1,2}:\d\d(?!\d))", "上午"),
        (r"(?<![A-Za-z])(?:下午)? ?[Pp][Mm] ?(?=\d{1,2}:\d\d(?!\d))", "下午"),
        (r"(?<!\d)(\d{1,2}):(\d\d)分(?!\d)", r"\1点\2分"),
        (r"(?<![^\s约负，、（(-])\.(?=\d)", "0."),
        (r"(?<=\d) ?[*＊×] ?(?=\d)", "乘"),
        (r"(?<=\d) ?÷ ?(?=\d)", "除以"),
        (r"(?<=\d) ?[+＋] ?(?=\d)", "加"),
        (r"(?<=[一二三四五六七八九〇○])○|○(?=[一二三四五六七八九])", "〇"),
        (r"(?<![\d.,])(\d{1,3}(?:,\d{3})+)(?![\d,])", lambda match: match[1].replace(",", "")),
        (r"(?<=\d)[,，](?=\d)(?!\d{3}(?!\d))", "、"),  # 5，6个: two numbers, not 56
        (r"(?<=[%℃度])[-−–—－~～](?=\d)", "到"),
        (r"(?<=\d)[–—－～](?=\d)", "~"),
        (r"(?<!\d)[(（]?(0\d{2,3})[)）-](?=\d{7,8}(?!\d))", r"\1"),
        (_DATE, _read_date),
        (_READ_DIGIT_BY_DIGIT, lambda match: _read_digits(match[0])),
        (r"(?<=\d) - (?=\d)", "减"),
        (r"(?<=\d)-(?=[\d.加乘减以除-]{0,40}\d ?[=＝])", "减"),
        (r"(?<=\d) ?[=＝] ?(?=-?\d)", "等于"),
        (_RANGE, _read_range),
        (
            r"(?<![\d.])(1[0-2])\.(\d\d?)(?![\d.])",
            lambda match: f"{match[1]}点{_read_digits(match[2])}",
        ),
        (r"(?<!\d)[−－](?=\d)", "-"),
        (r"(?<=[A-Za-z])-(?=\d)", " "),
        (r"(\d[\d.]*)‰", r"千分之\1"),
        (r"[¥$€£](?=[\d.]+[万亿萬億]?[元块塊])", ""),
        (r"¥([\d.]+[万亿萬億])", r"\1元"),
        (r"(?<!\d)0(?=[1-9][月日号號])", ""),
        (r"(?<![\d.])2(?=[月日号號楼樓])", "二"),
        (r"(?<![\d.第])2(?=[個張隻條種歲塊點雙間顆輛])", "兩"),
    )
)
