import pytest

from kouxing.shared.errors import UserError
from kouxing.shared.phones.mandarin.pinyin import phones_of_syllable, spell, transcribe, write
from tests.languages import MANDARIN

# The syllables of Mandarin (Xinhua Zidian's table): the finals of each initial, ü written v after
# n and l.
FINALS = {
    "": "a o e ai ei ao ou an en ang eng er",
    "y": "i a o e ao ou an in ang ing ong u ue uan un",
    "w": "u a o ai ei an en ang eng",
    "b": "a o ai ei ao an en ang eng i ie iao ian in ing u",
    "p": "a o ai ei ao ou an en ang eng i ie iao ian in ing u",
    "m": "a o e ai ei ao ou an en ang eng i ie iao iu ian in ing u",
    "f": "a o ei ou an en ang eng u",
    "d": "a e ai ei ao ou an en ang eng i ia ie iao iu ian ing u uo ui uan un ong",
    "t": "a e ai ao ou an ang eng i ie iao ian ing u uo ui uan un ong",
    "n": "a e ai ei ao ou an en ang eng i ie iao iu ian in iang ing u uo uan ong v ve",
    "l": "a e ai ei ao ou an ang eng i ia ie iao iu ian in iang ing u uo uan un ong v ve",
    "g": "a e ai ei ao ou an en ang eng u ua uo uai ui uan un uang ong",
    "k": "a e ai ei ao ou an en ang eng u ua uo uai ui uan un uang ong",
    "h": "a e ai ei ao ou an en ang eng u ua uo uai ui uan un uang ong",
    "j": "i ia ie iao iu ian in iang ing iong u ue uan un",
    "q": "i ia ie iao iu ian in iang ing iong u ue uan un",
    "x": "i ia ie iao iu ian in iang ing iong u ue uan un",
    "zh": "i a e ai ei ao ou an en ang eng u ua uo uai ui uan un uang ong",
    "ch": "i a e ai ao ou an en ang eng u ua uo uai ui uan un uang ong",
    "sh": "i a e ai ei ao ou an en ang eng u ua uo uai ui uan un uang",
    "r": "i e ao ou an en ang eng u ua uo ui uan un ong",
    "z": "i a e ai ei ao ou an en ang eng u uo ui uan un ong",
    "c": "i a e ai ei ao ou an en ang eng u uo ui uan un ong",
    "s": "i a e ai ao ou an en ang eng u uo ui uan un ong",
}
LEGAL = [initial + final for initial, row in FINALS.items() for final in row.split()]


def test_every_valid_syllable_has_distinct_phones() -> None:
    for initial, row in FINALS.items():
        for final in row.split():
            syllable = initial + final
            phones = phones_of_syllable(syllable)
            if initial in MANDARIN.initials:
                assert phones[0] == initial, syllable
                assert len(phones) == 2, syllable
            assert phones[-1] in MANDARIN.vowels, syllable
    phones_of = {name: phones_of_syllable(name) for name in LEGAL if name != "yo"}  # yo is you
    assert len(set(phones_of.values())) == len(phones_of)
    assert set().union(*phones_of.values()) == set(MANDARIN.phones) - {"sil"}


SPELLINGS = """
zhuang1: zh uang, yi1: i, yin: in, ying2: ing, wu3: u, wen4: uen, weng: ueng, yu2: v, yue4: ve,
yuan2: van, yun2: vn, you3: iou, nv3: n v, nü3: n v, nu:3: n v, nǚ: n v, lve4: l ve, lüe4: l ve,
lüè: l ve, ju2: j v, jv2: j v, xue2: x ve, quan: q van, jun1: j vn, gui4: g uei, niu2: n iou,
lun2: l uen, zi4: z ii, ci: c ii, si: s ii, zhi: zh iii, chi: ch iii, shi4: sh iii, ri4: r iii,
er2: er, hua1: h ua, huar1: h ua er, wanr2: uan er, yuán: van, LÜ4: l v, ê4: ei, eh: ei, m2: m,
ng4: n, hm: h m, de5: d e, de0: d e
"""


def test_splits_a_syllable_into_phones() -> None:
    for spelling in SPELLINGS.replace("\n", " ").split(","):
        syllable, phones = spelling.strip().rsplit(": ", 1)
        assert phones_of_syllable(syllable) == tuple(phones.split())
    for wrong in ("", "1", "ja", "muo3", "luun2", "xyz", "zhuangg", "b", "ni3hao3"):
        with pytest.raises(UserError, match=f"'{wrong}'"):
            phones_of_syllable(wrong)


@pytest.mark.parametrize(
    ("text", "read"),
    [
        ("2024年10月1日", "二零二四年十月一日"),
        ("下午3:30", "下午三点三十分"),
        ("3.5%", "百分之三点五"),
        ("100kg，5 km", "一百千克五公里"),
        ("第2个，2个", "第二个两个"),
        ("-5℃", "负五摄氏度"),
        ("－5度，50%-60%", "负五度百分之五十到百分之六十"),
        ("3—5天，1.5-2.5倍，3-5%", "三到五天一点五到二点五倍三到百分之五"),
        ("￥300元，¥1.5万", "三百元一点五万元"),
        ("13,000，5‰", "一万三千千分之五"),
        ("01月02日，12月22日", "一月二日十二月二十二日"),
        ("2号，2個人，第2個", "二号兩個人第二個"),
        ("3 2 1\n10", "三二一十"),
        ("138 1234 5678", "幺三八幺二三四五六七八"),
        ("COVID-19病毒", "十九病毒"),
        ("12-25岁，第3-5章，共12-25", "十二到二十五岁第三到五章共十二到二十五"),
        ("比分12-25，21-15，1-1", "比分十二比二十五二十一比十五一比一"),
        ("以1-2落后，5 - 3", "以一比二落后五减三"),
        ("增长12.25，3.14", "增长十二点二五三点一四"),
        ("2024-12-25，02-05，12月25日", "二零二四年十二月二十五日二月五日十二月二十五日"),
        ("0571-1234567，10-3=7", "零五七一一二三四五六七十减三等于七"),
        ("2024-01-02世", "二零二四年一月二日世"),
        ("(021)55556666，010 6552 9988", "零二一五五五五六六六六零一零六五五二九九八八"),
        ("编号0123，6222021234567890", "编号零一二三六二二二零二一二三四五六七八九零"),
        ("12：30分，9:05分，.5米，6*7", "十二点三十分九点零五分零点五米六乘七"),
        ("AM8:00，上午AM 8:00，pm 9：15", "上午八点上午八点下午九点十五分"),
        ("+86 13812345678，138-1234-5678", "加八六幺三八幺二三四五六七八幺三八幺二三四五六七八"),
        ("1.2.3版，9·11，08:05，0.25", "一点二点三版九一一八点零五分零点二五"),
        ("5，6个，1块5，2块3，1,5米", "五六个一块五两块三一五米"),
        ("1，234块，1,234块，密码0086, 007.", "一千二百三十四块一千二百三十四块密码零零八六零零七"),
        ("7×24小时，12÷3个，5+2天", "七乘二十四小时十二除以三个五加两天"),
        ("5×12=60元，20-3-2=15个", "五乘十二等于六十元二十减三减二等于十五个"),
    ],
)
def test_numbers_become_syllables(text: str, read: str) -> None:
    assert "".join(syllable.text for syllable in transcribe(text).syllables) == read


@pytest.mark.parametrize(
    ("texts", "spelling"),
    [
        (
            "随地吐痰 离地三尺 跪地求饶 征地补偿 拿地成本 买地建房 触地得分 贴地飞行 满地打滚"
            " 摔倒在地起不来 落地签证 世界各地人民 一地鸡毛 大量耕地 妈妈地里干活 常常地震"
            " 特别地区 自然地理 幸福地带 重要地位 很多地方 种好地再走 学校地处山区",
            "di4",
        ),
        (
            "慢慢地 慢慢地走 高兴地说 认真地看 非常努力地学习 开心地笑 大声地喊 很快地跑 突然地停下"
            " 小心翼翼地走 一步一步地走 更好地服务 高兴地表示 轻轻地点头 認真地學習",
            "de5",
        ),
    ],
)
def test_reads_the_particle_only_after_an_adverb(texts: str, spelling: str) -> None:
    for text in texts.split():
        read = [syllable.spelling for syllable in transcribe(text).syllables]
        assert read[text.index("地")] == spelling, text


@pytest.mark.parametrize(
    ("texts", "phone"),
    [
        ("我得走了 他还得回家 他得出门 我得知道 大家都得来 我得天天练 我覺得他得來", "ei"),
        ("他得了第一 他得出结论 我得知消息 她得奖了 我得一百分 使他得以生存 唱得好 值得", "e"),
    ],
)
def test_reads_must_only_between_a_pronoun_and_a_verb(texts: str, phone: str) -> None:
    for text in texts.split():
        last = [syllable for syllable in transcribe(text).syllables if syllable.text == "得"][-1]
        assert last.phones == ("d", phone), text


@pytest.mark.parametrize(
    ("text", "spellings"),
    [
        ("音樂、重慶", "yin1 yue4 chong2 qing4"),
        ("睡覺，銀行行長", "shui4 jiao4 yin2 hang2 hang2 zhang3"),
        ("看著，著名，頭髮乾", "kan4 zhe5 zhu4 ming2 tou2 fa4 gan4"),
        ("慢慢地走，认真地说", "man4 man4 de5 zou3 ren4 zhen1 de5 shuo1"),
        ("这块地很大，当地", "zhe4 kuai4 di4 hen3 da4 dang1 di4"),
        ("nǐhǎo, péngyou", "ni3 hao3 peng2 you"),
        ("fāngàn fāng'àn", "fan1 gan4 fang1 an4"),
        ("ni3hao3 hua1r5 hui4 r5", "ni3 hao3 hua1 r5 hui4 r5"),
        ("nĭ hɑ̌o ɡuó", "ni3 hao3 guo2"),
        ("pāris café résumé banana mp3", ""),
        ("nihao, hello", ""),
        ("no so", ""),
        ("他說ㄏㄠˇ ㄖㄜˋ，你ㄋㄧˇ好(ㄏㄠˇ)", "ta1 shuo1 hao3 re4 ni3 hao3"),
        ("重(chong2 qing4)庆，说ma1和mp", "chong2 qing4 qing4 shuo1 ma1 he2"),
        ("重（ㄔㄨㄥˊ）慶", "chong2 qing4"),
        ("我说 nǐ hǎo 吧", "wo3 shuo1 ni3 hao3 ba5"),
        ("他说Nǐhǎo，吃 bāo zi", "ta1 shuo1 Ni3 hao3 chi1 bao1 zi"),
        ("长(zhǎng)大，银行（háng）", "zhang3 da4 yin2 hang2"),
        ("nǐ hǎo, wǒ lái le.\n你好，我来了。", "ni3 hao3 wo3 lai2 le"),
        ("你好，我来了。\nNǐ hǎo, wǒ lái le.", "Ni3 hao3 wo3 lai2 le"),
        ("①第Ⅲ章，二○二四年", "yi1 di4 san1 zhang1 er4 ling2 er4 si4 nian2"),
        ("Nihao Zhongguo! Tom", "ni hao zhong guo"),
        ("tiananmen fangan yidianr lüxing", "tian an men fan gan yi dian r lv xing"),
        ("ㄋㄧˇㄏㄠˇ ㄓㄨㄥㄍㄨㄛˊ˙ㄇㄚ ㄇㄚ˙", "ni3 hao3 zhong1 guo2 ma5 ma5"),
        ("ㄕˋ ㄗˋ ㄩㄢˊ ㄌㄩˋ ㄨㄥ ㄑㄩㄥˊ ㄦˊ ㄇ", "shi4 zi4 yuan2 lü4 weng1 qiong2 er2"),
    ],
)
def test_reads_traditional_characters_and_pinyin_words(text: str, spellings: str) -> None:
    transcript = transcribe(text)
    assert " ".join(syllable.spelling for syllable in transcript.syllables) == spellings


def test_transcript_has_characters_tones_and_dropped_parts() -> None:
    transcript = transcribe("银行 的花儿，A股 ☃。女")
    assert [syllable.text for syllable in transcript.syllables] == list("银行的花儿股女")
    spelling = [syllable.spelling for syllable in transcript.syllables]
    assert spelling == ["yin2", "hang2", "de5", "hua1", "er2", "gu3", "nü3"]
    assert transcript.dropped == ("A", "☃")
    assert [s.spelling for s in transcribe("Nǐ hǎo, lü4 ma!").syllables] == [
        "Ni3", "hao3", "lü4", "ma",
    ]  # fmt: skip
    assert transcribe("，。").syllables == ()


def test_spelling_inverts_reading() -> None:
    for name in LEGAL:
        phones = phones_of_syllable(name)
        assert phones_of_syllable(spell(phones)) == phones, name


def test_the_tone_mark_is_on_the_main_vowel() -> None:
    spellings = "hao3 gou3 liu4 gui4 lve4 ê2 m2 hng4 r2 ma5".split()
    assert " ".join(map(write, spellings)) == "hǎo gǒu liù guì lüè ế ḿ hǹg r ma"
