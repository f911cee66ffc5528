"""Natural recordings that are held out from all training, to measure recognizers on them.

``conversation.tsv`` is a manifest (:mod:`kouxing.corpora.speech_corpus`) of those with a text:
podcasts, a talk, a web seminar and a prompt, with eight voices. The publishers of ``MOSS-TTSD`` and
``Step-Audio-EditX`` provide the texts. Other texts are the output of one large recognizer
(``RapidASR``) or the majority of several (``vad_example``), so they contain errors. Long recordings
are cut into pieces that overlap by 0.48 s, and so are their texts.
"""

from __future__ import annotations

from pathlib import Path

CONVERSATION = Path(__file__).parent / "conversation.tsv"
_PREFIXES = (  # of file names; they cover whole recordings and all recordings of a speaker
    "MOSS-TTSD_",
    "MOSS-TTS_reference_zh_3",
    "MiMo-Audio_aa7ed1",
    "RapidASR_",
    "Step-Audio-EditX_",
    "alibabacloud-bailian-speech-demo_",
    "paraformer-python_P9",
    "paraformer-python_vad",
    "websdk-java-demo_16K",
)


def is_held_out(recording: Path) -> bool:
    """Return whether a recording is held out, by the name of its file."""
    return recording.name.startswith(_PREFIXES)
