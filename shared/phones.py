"""The 60 recognition units of Mandarin and what a recognizer says about them.

Source: Li et al. 2011, section 3.1: 21 initials, 38 finals and silence. Finals follow its
spelling: ``ii`` after z c s, ``iii`` after zh ch sh r, ``v`` for ü.
"""

from __future__ import annotations

from dataclasses import dataclass

INITIALS = tuple("b p m f d t n l g k h j q x zh ch sh r z c s".split())
FINALS = tuple(
    "a o e i ii iii u v er ai ei ao ou ia ie ua uo ve iao iou uai uei an en in vn ian uan van uen "
    "ang eng ing ong iang uang iong ueng".split()
)
SILENCE = "sil"
UNITS = (*INITIALS, *FINALS, SILENCE)
UNIT_INDEX = {unit: index for index, unit in enumerate(UNITS)}


@dataclass(frozen=True, slots=True, kw_only=True)
class Phone:
    """One recognised unit.

    A live recognizer says the same ``index`` at least twice: first with an estimated duration
    (``final`` false), then with the true onset and duration (``final`` true).
    """

    index: int  # counts the units of a session from 0
    unit: str  # one of UNITS
    onset_s: float  # seconds from the session's first sample
    duration_s: float  # seconds
    confidence: float  # 0 to 1
    final: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class SpeechChange:
    """Voice activity began or ended."""

    active: bool
    time_s: float  # seconds from the session's first sample
