"""Mandarin: the 60 phones of Li et al. 2011, pinyin as its lexicon, and the visemes of each phone.

``phones.tsv`` follows Li et al. 2011, section 3.1 (21 initials, 38 finals and silence; ``ii`` after
z c s, ``iii`` after zh ch sh r, ``v`` for ü) and table 1: the visemes of initials and of finals
with a single shape; compound finals are split ("iao = i + ao"). The table lacks the finals with
``v``. Their split, and the second, rounded viseme of an initial before a rounded final, follow
Crystal.TTVS (Tsinghua University, Apache-2.0). Deviations: ``eng`` is table 1's {e, eng}, where
Crystal has {ei, en, eng}; the vowels ``ii`` and ``iii`` keep the shape of the initials before them.
"""

import re

from kouxing.shared.phones.mandarin.pinyin import pronounce, spell, transcribe

__all__ = ["CODE", "READABLE", "pronounce", "spell", "transcribe"]

CODE = "zh"
READABLE = re.compile(r"[\u3007\u4e00-\u9fff]+")
