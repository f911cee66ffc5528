"""Readings of 地 and 得 that depend on the words before and after.

地 is the particle de5 after adverbs, and otherwise the noun di4. Adverbs are doubled characters,
degree and adjective, and common adjectives. 得 is dei3 (must) between a pronoun and a verb, as in
我得走了. After other words, the usual readings are kept.
"""

import re
from collections.abc import Iterator

_ADJECTIVES = (
    "高兴 快乐 开心 愉快 幸福 得意 骄傲 兴奋 激动 紧张 着急 焦急 生气 愤怒 伤心 难过"
    " 痛苦 悲伤 害怕 惊讶 惊奇 好奇 疑惑 认真 仔细 小心 细心 耐心 专心 用心 安心 放心"
    " 热心 精心 关心 努力 用力 尽力 刻苦 勤奋 积极 主动 热情 热烈 亲切 友好 温柔 温和"
    " 善良 礼貌 客气 诚恳 真诚 严肃 严格 严厉 冷静 平静 安静 沉默 镇定 勇敢 坚定 坚决"
    " 果断 顽强 大胆 自信 自豪 大声 小声 轻声 高声 低声 齐声 飞快 迅速 快速 缓慢 急忙"
    " 匆忙 轻松 轻易 容易 顺利 成功 有效 有力 清楚 清晰 明确 明显 简单 直接 准确 正确"
    " 完整 详细 具体 全面 深入 深刻 充分 合理 科学 系统 灵活 巧妙 自由 自觉 自动 不停"
    " 不断 不住 不时 不禁 反复 持续 逐步 逐渐 偶尔 经常 特别 格外 非常 意外 神秘 秘密"
    " 公开 共同 独立 单独 正式 熟练 流利 舒服 随意 随便 懒洋洋 无奈 无情 疯狂 拼命 一个劲"
    " 整齐 美丽 优美 美好 自私 残忍 粗暴 温暖 甜蜜 和平 健康"
).replace(" ", "|")
# Verbs that may follow such an adverb although 地 and their first character are a noun.
_VERBS = (
    "学习 学会 处理 上升 上涨 上楼 下降 下载 下楼 面对 表示 表达 表现 表演 表明 点头 点了"
    " 形成 产生 理解 道歉 带着 带来 带走 保护 保持 利用 动手 动起 动了"
).replace(" ", "|")
_ADVERB = re.compile(
    rf"(?:([^\W妈爸爷奶哥弟姐妹公婆叔家处人])\1|(\w\w)\2|然|[很更太]\w|{_ADJECTIVES})地"
    rf"(?P<rest>{_VERBS}|\w?)"
)

_MUST = re.compile(
    r"(?:[我你您他她它咱谁]们?|大家|自己|还|就|都|总|也|必须|可能)得(?=\w)"
    r"(?![了过到着的地得奖分病意罪以逞失胜体名救益手志宠票冠金银铜势第〇零一二三四五六七八九十百千两满])"
    r"(?!知(?!道)|出(?![门去来发差国院席面场])|天(?!天)|当(?![心面场天着])|道(?![歉谢别])|利(?!用)|证(?!明))"
)


def readings_in_context(characters: str) -> Iterator[tuple[int, str]]:
    """Yield the index and the pinyin of 地 and 得; the characters are simplified."""
    for index in _adverb_particles(characters):
        yield index, "de5"
    for match in _MUST.finditer(characters):
        yield match.end() - 1, "dei3"


def _adverb_particles(characters: str) -> Iterator[int]:
    """Yield the indices of 地 after an adverb, as in 慢慢地走; the characters are simplified."""
    from pypinyin.constants import PHRASES_DICT  # noqa: PLC0415 (takes 0.3 s with pypinyin)

    for match in _ADVERB.finditer(characters):
        if "地" + match["rest"] not in PHRASES_DICT:  # as in 特别地区
            yield match.start("rest") - 1
