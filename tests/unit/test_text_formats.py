"""Spoken texts in subtitles, markup and other encodings."""

import os
import re
from pathlib import Path

import pytest

from kouxing.services.cli.texts.spoken_text import read_spoken_text, read_transcript
from kouxing.services.cli.texts.text_encoding import decode_text
from kouxing.services.cli.texts.text_formats import extract_text
from kouxing.shared.errors import UserError
from kouxing.shared.phones.inventory import load_inventory
from tests.languages import MANDARIN

ONE, TWO = "大家好，我是人。", "请看我的嘴唇。"
SPOKEN_TEXT = "大家好我是人请看我的嘴唇"

TEXTS = {
    "": f"{ONE}{TWO}",
    "SubRip (SRT)": f"""\ufeff1\r
00:00:00,400 --> 00:00:03,000 X1:40\r
{{\\an8}}<i>{ONE}</i>\r
2\r
00:00:03,200 --> 00:00:06,000\r
<font color="#fff">请看</font>\r
我的嘴唇。\r
""",
    "WebVTT": f"""WEBVTT - title 12

STYLE
::cue {{ color: red }}

NOTE 3 lines

intro
00:00.400 --> 00:03.000 align:start position:10%
<v Anna 2>{ONE}</v>

00:00:03.200 --> 00:00:06.000
请<00:00:03.500><c.red>看</c>我的嘴唇&nbsp;。
""",
    "LRC": f"""[ti:greeting]
[by:2024]
[00:03.20]请看<00:04.00>我的嘴唇。
[00:00.40]{ONE}
""",
    "ASS or SSA": """[Script Info]
Title: 7
[V4+ Styles]
Style: Default,Arial,20
[Events]
Format: Layer, Start, End, Style, Name, MarginL, MarginR, MarginV, Effect, Text
Comment: 0,0:00:00.00,0:00:03.00,Default,,0,0,0,,3
Dialogue: 0,0:00:03.20,0:00:06.00,Default,,0,0,0,,{\\pos(9,9)}请看\\N我的嘴唇。
Dialogue: 0,0:00:00.40,0:00:03.00,Default,,0,0,0,,大家好,我是人。
Dialogue: 0,0:00:00.40,0:00:03.00,Default,,0,0,0,,{\\p1}m 0 0 l 9 9{\\p0}
""",
    "SBV": f"""0:00:00.400,0:00:03.000
{ONE}

0:00:03.200,0:00:06.000
请看[br]我的嘴唇。
""",
    "MicroDVD or MPL2": f"{{10}}{{75}}{{y:i}}{ONE}\n{{80}}{{150}}请看|我的嘴唇。\n",
    "a table of labels": f"start\tend\ttext\n400\t3000\t{ONE}\n3200\t6000\t{TWO}\n",
    "SSML": """<?xml version="1.0"?>
<!-- 1 2 3 -->
<speak version="1.0" xml:lang="zh-CN"><metadata><a>9</a></metadata>大家好，<break time="2s"/>
我是<sub alias="人">R2</sub>。
<prosody rate="90%">请看<mark name="4"/>我的嘴唇。</prosody></speak>""",
    "TTML": f"""<?xml version="1.0"?><tt xmlns="http://www.w3.org/ns/ttml" xmlns:ttm="x"><head>
<metadata><ttm:title>5</ttm:title></metadata></head><body><div>
<p begin="00:00:00.400" end="3s">{ONE}</p><p begin="3.2s">请看<br/>我的<span>嘴唇。</span></p>
</div></body></tt>""",
    "HTML": f"""<!DOCTYPE html><html><head><title>5</title><style>a {{ top: 4 }}</style></head>
<body><p>{ONE}<p>请看我的<ruby>嘴<rt>zuǐ</rt></ruby>唇。<script>1 < 2</script></body></html>""",
    "Markdown": """---
date: 2024
---
# 大家好，

![5](a1.png)
1. **我是人**。
> 请看[我的](https://example.com/1)嘴唇。

```
x = 1
```
""",
    "JSON": '{"text": "大家好，我是人。请看我的嘴唇。", "segments": [{"text": "大"}]}',
    "text with tags": '大家好，<break time="200ms"/>我是<b>人</b>。请看我的嘴唇。',
    "a transcript with times": f"0:00\n{ONE}\n0:03\n{TWO}\n",
    "TextGrid": f"""File type = "ooTextFile"
Object class = "TextGrid"
xmin = 0
xmax = 6
tiers? <exists>
size = 2
item []:
    item [1]:
        class = "IntervalTier"
        name = "phones"
        intervals: size = 1
        intervals [1]:
            xmin = 0
            xmax = 6
            text = "sh"
    item [2]:
        class = "IntervalTier"
        name = "words"
        intervals: size = 3
        intervals [1]:
            xmin = 0
            xmax = 3
            text = "{ONE}"
        intervals [2]:
            text = "sil"
        intervals [3]:
            text = "请看我的""嘴唇""。"
""",
}  # fmt: skip
SHORT_TEXT_GRID = f"""File type = "ooTextFile"
"TextGrid"
0
6
<exists>
1
"IntervalTier"
"5"
0
6
1
0
6
"{ONE}{TWO}"
"""


@pytest.mark.parametrize("form", TEXTS)
def test_extracts_the_spoken_text(form: str) -> None:
    spoken, format_name = extract_text(TEXTS[form])
    assert format_name == form
    transcript = MANDARIN.read(spoken)
    assert "".join(syllable.text for syllable in transcript.syllables) == SPOKEN_TEXT
    assert transcript.dropped == ()


@pytest.mark.parametrize(
    ("text", "spoken_text"),
    [
        (SHORT_TEXT_GRID, SPOKEN_TEXT),
        (
            '[{"from": 0.4, "content": "大家好"}, {"from": 3.2, "content": "我是人"}]',
            "大家好我是人",
        ),
        ("[00:01.00][00:03.00]你好\n[00:02.00]大家", "你好大家你好"),
        ("1\n\n0:00.4 --> 0:01.0\n[掌声]你好 ♪\n", "你好"),
        ("0:00 --> 0:01\n你\n\n0:01 --> 0:01\n你\n\n0:01 --> 0:02\n你\n好", "你好"),
        ("1\n0:00.4 --> 0:01.0\n你好\n\n2\n0:01.0 --> 0:02.0\n你好\n", "你好你好"),
        ("[00:00.000 --> 00:03.000]  大家好\n[00:03.000 --> 00:06.000]  你好\n", "大家好你好"),
        ("[0.00s -> 3.40s] 大家好\n[3.40s -> 5.00s] 你好\n", "大家好你好"),
        ("[0.40 - 3.00] 大家好\n(3.2-6.0)：你好\n", "大家好你好"),
        ("0.4 --> 3.00 大家好\n3.2 --> 6.00 你好\n", "大家好你好"),
        ("00:00:00 小明\n大家好\n\n00:00:03 小红\n你好\n再见\n", "大家好你好再见"),
        ("[3.5]大家好", "三点五大家好"),
        ("{00:01}你好", "你好"),
        ("（00：01）大家好\n你好", "大家好你好"),
        ("00:00:01 你好", "你好"),
        ("00:01 你好", "你好"),
        ("0:05\t你好", "你好"),
        ("00:01～00:03 你好", "你好"),
        ("00:30出发", "零点三十分出发"),
        ("0:30 --> 0:40 你好", "你好"),
        ("0:30 --> 0:40 你好\n0:40 --> 0:50 再见\n", "你好再见"),
        ("1\n00:00:00,400 --> 00:00:01,000\n2\n00:00:01,200 --> 00:00:02,000\n你好\n", "你好"),
        ("WEBVTT\n\n00:00.400 --> 00:01.000\n00:01.200 --> 00:02.000\n你好\n", "你好"),
        ("[0.4 - 3.0] 大家好\n(0:03) 你好\n", "大家好你好"),
        ("[00:01.00]大[00:01.40]家 [00:02.00]好\n[00:03.00]你好", "大家好你好"),
        ("SPEAKER_00: 大家好\nSPEAKER_01: 你好", "大家好你好"),
        ("PM 3:30 开会", "下午三点三十分开会"),
        ("G20：峰会", "二十峰会"),
        ("Speaker 1  00:05: 大家好", "大家好"),
        ("说话人 2：你好", "你好"),
        ("start,end,text\n0,1,大家好\n1,2,你好\n", "大家好你好"),
        ("<00:01>{00:03}你好", "你好"),
        ("说话人1 00:05\n大家好\n\n说话人2 00:12\n你好\n", "大家好你好"),
        ("【00:05】大家好\n【01:10】你好\n", "大家好你好"),
        ("[400,260](400,500,0)大(900,500,0)家\n[900,260]<900,500,0>好", "大家好"),
        ("a 1 0.40 0.20 大家\na 1 0.60 0.20 好\n", "大家好"),
        ("BAC009S0002W0122 大家 好\nBAC009S0002W0123 你 好\n", "大家好你好"),
        ("00:00:01:大家好\n00:00:03:你好\n", "大家好你好"),
        ("大家好 (00:01)\n你好 (00:03)\n", "大家好你好"),
        ("大家好|0.0|1.5\n你好|1.5|2.0\n", "大家好你好"),
        ("0 5000000 大家好\n5000000 9000000 你好\n", "大家好你好"),
        ("a001 大家好\na002 你好\n", "大家好你好"),
        ("大家好 (a-001)\n你好 (a-002)\n", "大家好你好"),
        ("大家#1好，#3你好#4", "大家好你好"),
        ("[laughter]大家好[pause:500]，<#0.5#>你好<|end|>", "大家好你好"),
        ("8:00 起床\n9:00 上课", "八点起床九点上课"),
        ("&#20320;&#22909;&nbsp;吧&amp;", "你好吧"),
        ("下午3:30见，8:00到", "下午三点三十分见八点到"),
        ("１２：３０，２个", "十二点三十分两个"),
    ],
)
def test_reads_times_only_where_they_are_spoken(text: str, spoken_text: str) -> None:
    transcript = MANDARIN.read(extract_text(text)[0])
    assert "".join(syllable.text for syllable in transcript.syllables) == spoken_text


@pytest.mark.parametrize("text", ["The price is $5 [approx 3]", "[Hello] world", "[Anna] ist da"])
def test_words_in_brackets_are_text(text: str) -> None:
    assert extract_text(text) == (text, "")


@pytest.mark.parametrize(
    "command",
    ["[S1]", "[uv_break]", "[laugh_0]", "[laughs harder]", "[/emphasis]", "[mischievously]"],
)
def test_commands_of_synthesizers_are_not_text(command: str) -> None:
    spoken, name = extract_text(f"Hello {command} world")
    assert (spoken, name) == ("Hello  world", "text with commands of a synthesizer")


def test_a_sentence_may_start_like_a_format_in_lower_case() -> None:
    sentence = "webvtt is a format of subtitles"
    assert extract_text(sentence) == (sentence, "")


@pytest.mark.parametrize("line_end", ["\n", "\r\n", "\r", "\r\r\n"])
def test_line_ends_do_not_matter(line_end: str) -> None:
    for name, text in TEXTS.items():
        changed = text.replace("\r\n", "\n").replace("\n", line_end)
        assert extract_text(changed) == extract_text(text), name


def test_the_frame_rate_of_microdvd_is_not_spoken() -> None:
    assert extract_text("{1}{1}23.976\n{10}{75}Hello\n")[0] == "Hello\n"
    assert extract_text("{1}{75}12\n{80}{150}13")[0] == "12\n13"


def test_invisible_characters_do_not_divide_a_word() -> None:
    words = read_transcript("\ufeffre\u00adcord\u200bing", load_inventory("english")).syllables
    assert [word.text for word in words] == ["recording"]


@pytest.mark.parametrize("words", ["2008\n", "It was\n2008\n"])
def test_a_cue_without_a_number_may_end_with_a_spoken_number(words: str) -> None:
    cues = f"WEBVTT\n\n0:01.0 --> 0:02.0\n{words}\n0:03.0 --> 0:04.0\nHello\n"
    assert extract_text(cues)[0] == f"{words}Hello"


def test_the_number_of_a_cue_is_not_spoken_in_a_file_with_doubled_lines() -> None:
    cues = "1\n\n0:01.0 --> 0:02.0\n\nHello\n\n\n\n2\n\n0:03.0 --> 0:04.0\n\nAnna\n"
    assert extract_text(cues)[0] == "Hello\nAnna"


def test_a_reading_aid_ends_with_its_ruby() -> None:
    page = "<body><ruby>汉<rp>(<rt>hàn<rp>)</ruby><ruby>字<rt>zì</ruby>很好</body>"
    assert extract_text(page)[0] == "汉字很好"


def test_the_value_of_an_attribute_is_not_spoken() -> None:
    page = """<body><p title="1 > 2">one <a href='x>y'>two <b id=o'clock>three</b></a></body>"""
    assert extract_text(page)[0].strip() == "one two three"


def test_a_transcript_in_xml_may_contain_escaped_html() -> None:
    transcript = '<transcript><text start="0">it&amp;#39;s &amp;lt;me&amp;gt;</text></transcript>'
    assert extract_text(transcript)[0].strip() == "it's <me>"


def test_text_next_to_the_times_of_a_cue_is_spoken() -> None:
    cues = "00:00.400 --> 00:01.000 align:start line:80%\nHello\n\n0:01 --> 0:02 Anna: hi\n"
    assert extract_text(cues)[0] == "Hello\nAnna: hi"


WORDS = TEXTS["TextGrid"].replace(ONE, "good").replace('"请看我的""嘴唇""。"', '"morning"')


def test_the_words_of_other_languages_are_read() -> None:
    assert extract_text(WORDS) == ("good\nmorning", "TextGrid")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('<?xml version="1.0"?><ANNOTATION_DOCUMENT>你</ANNOTATION_DOCUMENT>', "ANNOTATION_DOC"),
        ("Scenarist_SCC V1.0\n\n00:00:00:00 9420", "SCC captions"),
        ('{"phones": []}', "JSON without"),
        ('{"text": ', "not valid JSON"),
        ('{"text":' + "[" * 900 + '"a"' + "]" * 900 + "}", "JSON without"),
        ("大家好 at 00:00:03.200 请看", "times in an unknown format"),
        (WORDS.replace('"words"', '"tones"'), "'phones', 'tones', none with"),
        ("[Events]\nDialogue: 0,x,0:00:03.00,Default,,0,0,0,,你", "not valid ASS"),
    ],
)
def test_rejects_a_format_by_its_name(text: str, message: str) -> None:
    with pytest.raises(UserError, match=message):
        extract_text(text)


@pytest.mark.parametrize(
    ("encoding", "form"),
    [
        ("utf-8", ""),
        ("utf-8-sig", ""),
        ("utf-16", "UTF-16"),
        ("utf-16-le", "UTF-16-LE"),
        ("utf-16-be", "UTF-16-BE"),
        ("gb18030", "GB18030"),
        ("big5", "BIG5"),
    ],
)
def test_detects_the_encoding_of_a_file(encoding: str, form: str) -> None:
    text = "歡迎收聽，我們會請你看嘴唇怎麼動。" if encoding == "big5" else f"\n{ONE}{TWO} 123"
    assert decode_text(text.encode(encoding), "mandarin") == (text, form)


@pytest.mark.parametrize(
    ("language", "text", "encoding"),
    [
        ("french", "La fenêtre est grande", "cp1252"),
        ("german", "Übung macht den Meister", "cp1252"),
        ("spanish", "¿Qué tal? ¡Él!", "cp1252"),
        ("polish", "Zażółć gęślą jaźń", "cp1250"),
        ("russian", "Доброе утро", "cp1251"),
        ("turkish", "İyi günler, ağabey", "cp1254"),
        ("japanese", "おはようございます。", "cp932"),
        ("japanese", "おはようございます。", "euc-jp"),
        ("korean", "안녕하세요", "cp949"),
        ("universal", "La fenêtre est grande", "cp1252"),
        ("universal", "niños y año", "cp1252"),
        ("universal", "«Bonjour» dit-elle à l’enfant.", "cp1252"),
        ("universal", "A和B都有iPhone", "gb18030"),
        ("mandarin", "x和y都大。", "gb18030"),
        ("mandarin", "歡迎看 Unity、Godot 的人", "big5"),
        ("mandarin", "電話", "big5"),
        ("mandarin", "臺灣", "big5"),
        ("mandarin", "圖書館", "big5"),
        ("mandarin", "天數", "big5"),
        ("mandarin", "木條", "big5"),
        ("mandarin", "枝头", "gb18030"),
        ("mandarin", "转转", "gb18030"),
        ("mandarin", "角度θ", "gb18030"),
        ("mandarin", "上手需要和以", "gb18030"),
        ("mandarin", "nǐ hǎo", "gb18030"),
        ("mandarin", "ok", "utf-16-le"),
        ("english", "£5 — ok", "utf-16-le"),
        ("english", "£5 — ok", "utf-16-be"),
        ("cantonese", "歡迎收聽", "big5"),
        ("cantonese", "喺度食嘢", "big5hkscs"),
    ],
)
def test_an_encoding_depends_on_the_language(language: str, text: str, encoding: str) -> None:
    assert decode_text(text.encode(encoding), language) == (text, encoding.upper())


@pytest.mark.parametrize(
    ("language", "text"),
    [
        ("universal", "Да, שלום"),
        ("mandarin", "他说 Привет"),
        ("mandarin", "「の」和 [ʂ]"),
        ("russian", "да"),
    ],
)
def test_a_utf_8_file_may_have_any_script(language: str, text: str) -> None:
    assert decode_text(text.encode(), language) == (text, "")


@pytest.mark.parametrize(
    ("language", "content"),
    [
        ("hindi", "été".encode("cp1252")),  # an encoding that the language does not have
        ("mandarin", 9 * ONE.encode("gb18030") + b"\x80 "),  # also valid Windows-1252
        ("mandarin", ONE.encode()[:-1]),
    ],
)
def test_rejects_an_unknown_encoding(language: str, content: bytes) -> None:
    with pytest.raises(UserError, match=r"encoding is unknown; save .* in UTF-8"):
        decode_text(content, language)


def test_reads_a_file_in_the_encoding_of_its_language(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "said.txt"
    path.write_bytes("Mädchen".encode("cp1252"))
    transcript = read_transcript(str(path), load_inventory("german"))
    assert [syllable.text for syllable in transcript.syllables] == ["Mädchen"]
    assert (
        "said.txt was read as CP1252; if its characters are wrong, save it"
        in capsys.readouterr().err
    )


@pytest.mark.parametrize(
    ("content", "name"),
    [
        (b"%PDF-1.7", "PDF"),
        (b"{\\rtf1 ", "RTF"),
        (b"PK\3\4word/document.xml", "Word"),
        (b"RIFF$\0\0\0WAVE", "a WAV file"),
        (b"FORM\0\0\0$AIFF", "an AIFF file"),
        (b"\x01\x02\xff\xfe\xfd", "not a text file"),
    ],
)
def test_rejects_a_file_that_is_not_text(content: bytes, name: str, tmp_path: Path) -> None:
    (tmp_path / "said.txt").write_bytes(content)
    with pytest.raises(UserError, match=rf"said\.txt: this is .*{name}"):
        read_spoken_text(str(tmp_path / "said.txt"))


def test_a_text_may_start_like_an_audio_file() -> None:
    assert decode_text(b"FORM and caffeine", "english") == ("FORM and caffeine", "")


def test_reads_a_subtitle_file_and_names_its_format(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "said.srt"
    path.write_bytes(TEXTS["SubRip (SRT)"].encode("gb18030", "ignore"))
    assert len(read_transcript(str(path), MANDARIN).syllables) == len(SPOKEN_TEXT)
    assert "said.srt was read as SubRip (SRT) in GB18030" in capsys.readouterr().err


def test_warns_about_a_spoken_time_of_day(capsys: pytest.CaptureFixture[str]) -> None:
    assert read_spoken_text("12:30 我们走") == "12:30 我们走"
    assert "12:30 is read as a spoken time of day" in capsys.readouterr().err
    read_spoken_text("我们12:30走")
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize(
    ("text", "label"),
    [
        ("张三：你好\n李四：再见", "'张三：'"),
        ("【旁白】你好\n（笑）再见", "'【旁白】'"),
        ("1. 你好\n2、再见", "'1.'"),
        ("1\n0:01 --> 0:02\n张三：大家好\n\n2\n0:02 --> 0:03\n李四：你好\n", "'张三：'"),
        ("他说：你好", ""),
        ("八点：出发\n1.5度\n3:2获胜\n", ""),
    ],
)
def test_warns_about_labels_that_may_not_be_spoken(
    text: str, label: str, capsys: pytest.CaptureFixture[str]
) -> None:
    spoken = read_spoken_text(text)
    assert label.strip("'") in spoken
    assert spoken == text or "-->" in text
    message = capsys.readouterr().err
    assert f"{label} is read as spoken text" in message if label else not message


def test_decodes_an_argument_in_another_encoding(capsys: pytest.CaptureFixture[str]) -> None:
    assert read_spoken_text(os.fsdecode("你好".encode("gb18030"))) == "你好"
    assert "read as GB18030" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["no.srt", "no.TextGrid", "no.docx", "no.svg"])
def test_rejects_a_missing_file(name: str) -> None:
    with pytest.raises(UserError, match=f"{re.escape(name)}: no such file"):
        read_spoken_text(name)


def test_reports_each_word_that_cannot_be_read(capsys: pytest.CaptureFixture[str]) -> None:
    for text in ("大家好 hello world，café Tom，Tom", "da4 jia1 hao3 hello, world! café Tom"):
        assert MANDARIN.read(text).dropped[:4] == ("hello", "world", "café", "Tom")
        assert len(read_transcript(text, MANDARIN).syllables) == 3
        assert "ignored: 'hello', 'world', 'café', 'Tom'; write" in capsys.readouterr().err
    with pytest.raises(
        UserError,
        match=r"read: 'hello', 'world'; write them in .*Mandarin, the default .* --language en",
    ):
        read_transcript("hello world", MANDARIN)
    with pytest.raises(UserError, match="read: '你好'; write them as they are spoken, or use ano"):
        read_transcript("你好", load_inventory("german"))


@pytest.mark.parametrize(
    "text", ["Nǐ hǎo，nǚ’ér！", "ni3 hao3, nu:3…er2", "ｎｉ３　ｈａｏ３，nv3-er2", "nǐ hǎo nü er"]
)
def test_reads_pinyin_with_any_punctuation(text: str) -> None:
    assert MANDARIN.read(text).phones == [("n", "i"), ("h", "ao"), ("n", "v"), ("er",)]


@pytest.mark.parametrize(
    ("text", "spoken"),
    [
        ("<html>" + "<a " * 300_000, "<a " * 300_000),
        ("<html></" + "a:" * 300_000, "</" + "a:" * 300_000),
        ("<html>" + "<a '\"" * 200_000, "<a '\"" * 200_000),
        ("[Events]\nDialogue: 0,0:00:00.00,0:00:01.00,D,,0,0,0,," + "{" * 300_000, "{" * 300_000),
        ("<html>" + "<![CDATA[" * 300_000, ""),
        ("<html>" + "<!--" * 300_000, ""),
        ("<html>" + "<title>" * 200_000 + "</x>" * 200_000, ""),
        ("# a\n" + "![" * 300_000, "a\n" + "![" * 300_000),
        ("](" * 300_000, "](" * 300_000),
        ("1.1" + " " * 300_000 + "a", "1.1" + " " * 300_000 + "a"),
        ("WEBVTT\n\n1\n" + " " * 300_000 + "a", "1\na"),
        ("[00:01]a" + " " * 300_000 + "b", "a" + " " * 300_000 + "b"),
        ("a" + "1" * 300_000 + "!", "a" + "1" * 300_000 + "!"),
    ],
)
def test_reads_damaged_text_in_linear_time(text: str, spoken: str) -> None:
    """The test would need hours otherwise."""
    assert extract_text(text)[0].strip() == spoken.strip()


def test_rejects_a_short_text_that_repeats_a_long_line() -> None:
    refrain = "[00:01.00]" * 5000
    with pytest.raises(UserError, match="the repeated lines have more than 8388608 characters"):
        extract_text(refrain + "a" * 5000)
    assert extract_text(refrain + "a")[0].count("a") == 5000
