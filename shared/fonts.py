"""Fonts of drawn text: Noto Sans for pinyin, and an installed font for Chinese characters."""

from functools import lru_cache
from itertools import groupby

import fontpkg
from PIL import ImageFont

# font files with Chinese characters on Linux, macOS and Windows
_CHINESE_FONTS = (
    "NotoSansCJK-Regular.ttc", "NotoSansSC-Regular.otf", "SourceHanSansSC-Regular.otf",
    "wqy-zenhei.ttc", "wqy-microhei.ttc", "DroidSansFallbackFull.ttf", "PingFang.ttc",
    "Hiragino Sans GB.ttc", "msyh.ttc", "simsun.ttc",
)  # fmt: skip
_FIRST_CHINESE = "\u2e80"
NO_CHINESE_FONT = (
    "no font with Chinese characters was found; install one (Debian: sudo apt install"
    " fonts-noto-cjk)"
)


def can_draw(text: str) -> bool:
    """Return whether there is a font for a text."""
    return not _is_chinese(text) or _chinese_font(1.0) is not None


def font_for(text: str, size_px: float) -> ImageFont.FreeTypeFont:
    """Return a font for a text; Chinese characters are boxes if no font has them."""
    chinese = _chinese_font(size_px) if _is_chinese(text) else None
    return chinese or ImageFont.truetype(fontpkg.path("Noto Sans"), size_px)


def text_runs(text: str, size_px: float) -> list[tuple[str, ImageFont.FreeTypeFont]]:
    """Split a text into runs with one font each, because some Chinese fonts lack tone marks."""
    runs = ("".join(letters) for _, letters in groupby(text, _is_chinese))
    return [(run, font_for(run, size_px)) for run in runs]


def _is_chinese(text: str) -> bool:
    return any(character >= _FIRST_CHINESE for character in text)


@lru_cache
def _chinese_font(size_px: float) -> ImageFont.FreeTypeFont | None:
    """Return the first installed font of ``_CHINESE_FONTS``, or None."""
    for name in _CHINESE_FONTS:
        try:
            return ImageFont.truetype(name, size_px)
        except OSError:
            continue
    return None
