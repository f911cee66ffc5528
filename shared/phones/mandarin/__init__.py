"""Mandarin: the 60 phones of Li et al. 2011, pinyin as its lexicon, and the visemes of each phone.

The phones in ``phones.tsv`` follow Li et al. 2011, section 3.1: 21 initials, 38 finals and silence.
``ii`` is the final after z c s, ``iii`` the final after zh ch sh r, and ``v`` is ü. The visemes
follow table 1, which has initials and finals with a single shape, and splits compound finals ("iao
= i + ao"). The table lacks the finals with ``v``. Their split, and the rounded viseme of an initial
before a rounded final, follow Crystal.TTVS (Tsinghua University, Apache-2.0).

Deviations: ``eng`` is table 1's {e, eng}, where Crystal has {ei, en, eng}. The vowels ``ii`` and
``iii`` keep the shape of the initials before them.
"""

import re

from kouxing.shared.phones.mandarin.pinyin import spell, transcribe, write

__all__ = ["CODE", "READABLE", "UNREADABLE_HINT", "spell", "transcribe", "write"]

CODE = "zh"
READABLE = re.compile(r"[\u3007\u4e00-\u9fff]+")
UNREADABLE_HINT = " as Mandarin; use Chinese characters instead"
