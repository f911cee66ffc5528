"""Natural recordings that no recogniser learns from, so that they can be measured on them.

``conversation.tsv`` is a manifest (:mod:`corpora.speech_corpus`) of those with a text: podcasts, a
talk, a web seminar and a prompt, eight voices. The texts were published with the recordings: by
those who give them away (``MOSS-TTSD``, ``Step-Audio-EditX``), or as what one large recogniser
(``RapidASR``) or the majority of several (``vad_example``) recognises. So some errors are the
text's. Long recordings are cut into pieces that overlap by 0.48 s, and so do the texts.
"""

from __future__ import annotations

from pathlib import Path

CONVERSATION = Path(__file__).parent / "conversation.tsv"
_SOURCES = (  # whole recordings, and all recordings of a speaker; how names of files begin
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


def is_kept_back(recording: Path) -> bool:
    """Tell by its name whether a recording is for measuring alone."""
    return recording.name.startswith(_SOURCES)
