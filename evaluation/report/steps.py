"""The steps of the report: one command each, and the code and data that it depends on."""

from collections.abc import Mapping
from dataclasses import dataclass

from kouxing.evaluation.rivals.tables import PROGRAMS
from kouxing.evaluation.source_tree import ROOT, SAMPLE

CONVERSATION = ROOT / "corpora" / "conversation.tsv"

# Options of ``kouxing evaluate report`` that give the folders of recordings.
FOLDER_OPTIONS = {
    "lips": "--clips",
    "corpus": "--corpus",
    "natural": "--conversation",
    "languages": "--languages",
}
DELAYS_MS = (0, 30, 60, 100, 160, 220, 300)
_MODELS = "--acoustic blocks --acoustic light --acoustic gmm"
_DELAYS = " ".join(f"--delay-ms {delay}" for delay in DELAYS_MS)
_ALL_LIPS = "--lips learned --lips dynamic-visemes --lips ferguson"
_TABLES = " ".join(f"--from-csv {{rivals}}/{name}" for name in PROGRAMS)

# A result is out of date if one of these files, or a module that it imports, has changed.
_RECOGNIZER = (
    "evaluation/recognizer/error_rates.py",
    "shared/phones/mandarin",
    *(
        f"services/recognizer/models/{name}.npz"
        for name in ("blocks", "encoder", "gmm", "phone_lm")
    ),
)
_FACES = (
    "services/recognizer/models/*.npz",
    "services/synthesizer/lips",
    "shared/face",
    "shared/phones/*/*.tsv",
)
_LIP_SCORES_CODE = ("evaluation/lips/lip_scores.py", *_FACES)
_SCHEMES_CODE = ("evaluation/lips/scheme_scores.py", "evaluation/lips/sentences.py", *_FACES)
_SERVICES = (
    "services/control",
    "services/recognizer",
    "services/synthesizer",
    "shared/face",
    "shared/phones",
)


@dataclass(frozen=True, slots=True)
class Step:
    """A command whose output is part of the report.

    In commands, ``{lips}``, ``{corpus}``, ``{natural}`` and ``{languages}`` are folders of
    recordings, ``{rivals}`` is a folder for tables. The last command writes the results.
    """

    commands: tuple[str, ...]
    code: tuple[str, ...]  # folders and files, also patterns
    quick: tuple[str, ...] | None = None  # None: the same as ``commands``; empty: skipped


_READ = "evaluate recognizer --corpus {corpus} --condition clean " + _MODELS
_LIP_SCORES = "evaluate lips --clips {lips}"
_SCHEMES = "evaluate schemes --corpus {corpus} --acoustic blocks --acoustic gmm"

STEPS: Mapping[str, Step] = {
    "read": Step((_READ + " --split test",), _RECOGNIZER, (_READ + " --split dev",)),
    "conversation": Step(
        (
            f"evaluate recognizer --corpus {CONVERSATION.relative_to(ROOT)} --audio {{natural}}"
            f" --split conversation --condition clean {_MODELS}",
        ),
        _RECOGNIZER,
        (),
    ),
    "disturbed": Step(("evaluate recognizer --corpus {corpus} --split dev",), _RECOGNIZER, ()),
    "languages": Step(
        ("evaluate languages --audio {languages}",),
        (
            "evaluation/recognizer/languages.py",
            "evaluation/rivals/hama_phones.py",
            "corpora/languages.tsv",
            "services/recognizer/models/*.npz",
            "shared/phones",
        ),
        (),
    ),
    "lips": Step((_LIP_SCORES,), _LIP_SCORES_CODE, (_LIP_SCORES + " --condition clean",)),
    "delay": Step((f"{_LIP_SCORES} --condition clean {_DELAYS}",), _LIP_SCORES_CODE, ()),
    "rivals": Step(
        (
            "evaluate rivals {rivals} --clips {lips}",
            f"{_LIP_SCORES} --condition clean {_ALL_LIPS} {_TABLES}",
        ),
        (*_LIP_SCORES_CODE, "evaluation/rivals"),
        (
            "evaluate rivals {rivals} --clips {lips} --program headaudio --program loudness",
            f"{_LIP_SCORES} --condition clean --lips learned --from-csv {{rivals}}/headaudio"
            " --from-csv {rivals}/loudness",
        ),
    ),
    "schemes": Step((_SCHEMES,), _SCHEMES_CODE, ("evaluate schemes",)),
    "schemes-paper-rule": Step((_SCHEMES + " --paper-rule",), _SCHEMES_CODE, ()),
    "visemes": Step(
        ("evaluate visemes --clips {lips}",), ("evaluation/lips/viseme_fit.py", *_FACES), ()
    ),
    "ferguson": Step(
        ("evaluate ferguson --clips {lips}",), ("evaluation/lips/speaking_rates.py", *_FACES), ()
    ),
    "latency": Step(
        (f"bench latency {SAMPLE.relative_to(ROOT)}",),
        (
            *(f"evaluation/system/{name}.py" for name in ("latency", "costs", "page")),
            "services/gateway",
            *_SERVICES,
        ),
    ),
    "load": Step(
        ("bench load",),
        ("evaluation/system/load.py", *_SERVICES),
        ("bench load --sessions 6 --seconds 3",),
    ),
    "busy": Step(
        ("bench busy",),
        ("evaluation/system/busy.py", *_SERVICES),
        ("bench busy --programs 6 --seconds 10",),
    ),
    "faults": Step(("evaluate faults",), ("evaluation/system/faults.py", *_SERVICES), ()),
    "browser": Step(
        (f"bench lips-page {SAMPLE.relative_to(ROOT)} --clips {{lips}}",),
        ("clients/kouxing-lips", "evaluation/system/lips_page.*"),
        (f"bench lips-page {SAMPLE.relative_to(ROOT)}",),
    ),
    "package": Step(
        ("evaluate lips-package --clips {lips} --corpus {corpus}",),
        ("clients/kouxing-lips/engine", "evaluation/system/lips_package.py", *_FACES),
        (),
    ),
    "sizes": Step(
        ("bench sizes",), ("services/recognizer/models/*.npz", "evaluation/system/sizes.py")
    ),
}
