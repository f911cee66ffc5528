"""The steps of the report: one command each, and the code and data that it depends on."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from kouxing.evaluation.rivals.tables import PROGRAMS

ROOT = Path(__file__).resolve().parents[2]  # root of the source tree, behind its links
CONVERSATION = ROOT / "corpora" / "conversation.tsv"
SAMPLE = ROOT / "shared" / "demo" / "hello-female.wav"

DELAYS_MS = (0, 30, 60, 100, 160, 220, 300)
_MODELS = "--acoustic blocks --acoustic light --acoustic gmm"
_DELAYS = " ".join(f"--delay-ms {delay}" for delay in DELAYS_MS)
_ALL_LIPS = "--lips learnt --lips dynamic-visemes --lips ferguson"
_TABLES = " ".join(f"--from-csv {{rivals}}/{name}" for name in PROGRAMS)

_RECOGNIZER = ("services/recognizer", "shared/phones", "evaluation/recognizer", "corpora")
_LIPS = (*_RECOGNIZER, "services/synthesizer", "services/*.py", "shared/face", "evaluation/lips")
_SYSTEM = ("services/control", "services/recognizer", "services/synthesizer", "services/gateway")
_CHAIN = (*_SYSTEM, "shared", "evaluation/system")


@dataclass(frozen=True, slots=True)
class Step:
    """A command whose output is part of the report.

    In commands, ``{lips}``, ``{corpus}`` and ``{natural}`` are folders of recordings, ``{rivals}``
    is a folder for tables. The last command writes the results.
    """

    commands: tuple[str, ...]
    code: tuple[str, ...]  # folders and files
    quick: tuple[str, ...] | None = None  # None: the same as ``commands``; empty: skipped


_READ = "evaluate recognizer --manifest {corpus} --condition clean " + _MODELS
_LIP_SCORES = "evaluate lips --clips {lips}"
_SCHEMES = "evaluate schemes --manifest {corpus} --acoustic blocks --acoustic gmm"

STEPS: Mapping[str, Step] = {
    "read": Step((_READ + " --split test",), _RECOGNIZER, (_READ + " --split dev",)),
    "conversation": Step(
        (
            f"evaluate recognizer --manifest {CONVERSATION.relative_to(ROOT)} --audio {{natural}}"
            f" --split conversation --condition clean {_MODELS}",
        ),
        _RECOGNIZER,
        (),
    ),
    "disturbed": Step(("evaluate recognizer --manifest {corpus} --split dev",), _RECOGNIZER, ()),
    "lips": Step(
        (_LIP_SCORES,),
        _LIPS,
        (_LIP_SCORES + " --condition clean --every 8",),
    ),
    "lookahead": Step(
        (f"{_LIP_SCORES} --condition clean {_DELAYS}",),
        _LIPS,
        (f"{_LIP_SCORES} --condition clean {_DELAYS} --every 16",),
    ),
    "rivals": Step(
        (
            "evaluate rivals {rivals} --clips {lips}",
            f"{_LIP_SCORES} --condition clean {_ALL_LIPS} {_TABLES}",
        ),
        (*_LIPS, "evaluation/rivals"),
        (
            "evaluate rivals {rivals} --clips {lips} --program headaudio --program loudness",
            f"{_LIP_SCORES} --condition clean --lips learnt --from-csv {{rivals}}/headaudio"
            " --from-csv {rivals}/loudness --every 8",
        ),
    ),
    "schemes": Step((_SCHEMES,), _LIPS, ("evaluate schemes",)),
    "schemes-paper-rule": Step((_SCHEMES + " --paper-rule",), _LIPS, ()),
    "visemes": Step(("evaluate visemes --clips {lips}",), _LIPS, ()),
    "ferguson": Step(("evaluate ferguson --clips {lips}",), _LIPS, ()),
    "chain": Step((f"bench chain {SAMPLE.relative_to(ROOT)}",), _CHAIN),
    "load": Step(("bench load",), _CHAIN, ("bench load --sessions 6 --seconds 3",)),
    "busy": Step(("bench busy",), _CHAIN, ("bench busy --programs 6 --seconds 10",)),
    "faults": Step(("evaluate faults",), _CHAIN, ()),
    "browser": Step(
        (f"bench lips-page {SAMPLE.relative_to(ROOT)}",),
        ("clients/kouxing-lips", "services/cli/web_model.py", "evaluation/system"),
    ),
    "sizes": Step(
        ("bench sizes",),
        ("services/recognizer/models", "shared/wire", "evaluation/system/sizes.py"),
    ),
}
