"""Compares the package ``kouxing-lips`` with the server, on the same recordings.

Both have their default settings. The server's face has no idle motion. The opening and the
closures are compared with real lips, the final phones with forced alignment. The package runs in
Node. The tests show that frames in browsers are the same.
"""

import json
import subprocess
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from rich.progress import track

from kouxing.corpora.scoring import ErrorCounts, count_errors
from kouxing.evaluation.lips.agreement import Agreement, agreement_of
from kouxing.evaluation.lips.live_faces import animate_live
from kouxing.evaluation.lips.mouths import clip_mouth, predicted_mouth
from kouxing.evaluation.lips.references import clips_to_score
from kouxing.evaluation.recognizer.aligned_corpus import AlignedRecording, align_corpus
from kouxing.evaluation.rivals.tables import find_node
from kouxing.evaluation.source_tree import ROOT
from kouxing.services.cli.web_model import web_model
from kouxing.services.live_pipeline import recognize_events
from kouxing.services.recognizer.acoustic.load import load_model
from kouxing.services.recognizer.config import RecognizerConfig
from kouxing.services.recognizer.lips.lip_predictor import load_lip_predictor
from kouxing.services.synthesizer.config import SynthesizerConfig
from kouxing.services.synthesizer.face_animator import configured_face
from kouxing.services.synthesizer.lips.load import load_lip_model
from kouxing.shared.arrays import Floats
from kouxing.shared.command.terminal import CONSOLE
from kouxing.shared.errors import UserError
from kouxing.shared.phones.events import Phone, SoundEvent
from kouxing.shared.phones.inventory import SILENCE

Samples = Floats
Faps = Floats

SERVER, PACKAGE, DIFFERENCE = "server", "package", "difference"
_SCRIPT = ROOT / "clients/kouxing-lips/demo/frames.mjs"
_PHONES = {"light": True, "blocks": "final"}  # the package's option for each acoustic model
_LIMIT_S = 600.0


@contextmanager
def exported_models() -> Iterator[Path]:
    """Write the models of the package to a temporary folder."""
    with tempfile.TemporaryDirectory() as name:
        for file, content in web_model().items():
            (Path(name) / file).write_bytes(content)
        yield Path(name)


def package_output(models: Path, samples: Samples, **options: Any) -> dict[str, Any]:
    """Run the package in Node on samples, 16 kHz mono, or at ``sampleRateHz`` of the options.

    Returns ``names``, ``frames`` and ``phones`` of the engine, or ``error``.
    """
    file = models / "sound.f32"
    samples.astype("<f4").tofile(file)
    done = subprocess.run(  # noqa: S603
        [find_node(), _SCRIPT, models, file, json.dumps({"chunk": 320, "shapes": [], **options})],
        capture_output=True,
        check=False,
        timeout=_LIMIT_S,
    )
    if done.returncode:
        raise UserError(f"Node failed: {done.stderr.decode(errors='replace')[-300:]}")
    output: dict[str, Any] = json.loads(done.stdout)
    return output


def package_faps(output: dict[str, Any]) -> Faps:
    """Return the FAPs of the output's frames (F, 68)."""
    return np.array([frame["faps"] for frame in output["frames"]], np.float32)


def package_phones(output: dict[str, Any]) -> list[str]:
    """Return the final phones of the output, without silence."""
    return [
        phone["symbol"]
        for phone in output["phones"]
        if phone["isFinal"] and phone["durationS"] > 0.0 and phone["symbol"] != SILENCE
    ]


def server_events(samples: Samples, acoustic: str = "light") -> list[SoundEvent]:
    """Return the events of the server's recognizer, for a face with the default delay."""
    delay_s = SynthesizerConfig().delay_ms / 1e3
    config = RecognizerConfig(acoustic=acoustic)
    return recognize_events(load_model(acoustic), samples, load_lip_predictor(), delay_s, config)


def server_faps(events: Sequence[SoundEvent], **settings: Any) -> Faps:
    """Return the server's frames (F, 68), without idle motion; ``settings`` replace defaults."""
    face = configured_face(load_lip_model(), SynthesizerConfig(idle_motion=False, **settings))
    return np.array([faps for _, faps in animate_live(face, events)])


def compare(clips: Path, corpus: Path | None = None) -> dict[str, Any]:
    """Compare on held-out clips with tracked lips and, if given, the split test of a corpus.

    Returns figures for a JSON file. Those of the lips have the keys ``server`` and ``package``. The
    phone error rates, by acoustic model, also have ``difference``, between package and server.
    Raises ``UserError`` if a folder has no recordings, if Node is not installed, or outside a
    checkout, which has the package.
    """
    if not _SCRIPT.is_file():
        raise UserError("kouxing-lips is missing; run this command in a checkout of kouxing")
    references = align_corpus(load_model("blocks"), corpus, "test") if corpus else []
    with exported_models() as models:
        num_clips, agreements = _compare_lips(models, clips)
        counts = {name: _compare_phones(models, references, name) for name in _PHONES if references}
    return {
        "num_clips": num_clips,
        "opening_correlation": {name: a.correlation["opening"] for name, a in agreements.items()},
        "closure_f1": {name: a.closure_f1 for name, a in agreements.items()},
        "num_recordings": len(references),
        "phone_error_rate": {
            model: {name: errors.rate for name, errors in by_name.items()}
            for model, by_name in counts.items()
        },
    }


def _compare_lips(models: Path, folder: Path) -> tuple[int, dict[str, Agreement]]:
    clips = clips_to_score(folder, language=None)
    pairs: dict[str, list[Any]] = {SERVER: [], PACKAGE: []}
    for clip in track(clips, "clips", console=CONSOLE, transient=True):
        real = clip_mouth(clip)
        faps = {
            SERVER: server_faps(server_events(clip.samples)),
            PACKAGE: package_faps(package_output(models, clip.samples)),
        }
        for name, predicted in faps.items():
            pairs[name].append((predicted_mouth(predicted.astype(float)), real))
    return len(clips), {name: agreement_of(values) for name, values in pairs.items()}


def _compare_phones(
    models: Path, references: Sequence[AlignedRecording], acoustic: str
) -> dict[str, ErrorCounts]:
    """Count the errors of server and package, and the differences between the two."""
    counts = {name: ErrorCounts() for name in (SERVER, PACKAGE, DIFFERENCE)}
    for reference in track(references, acoustic, console=CONSOLE, transient=True):
        samples = reference.read_audio()
        truth = [phone.symbol for phone in reference.phones]
        server_symbols = [
            event.symbol
            for event in server_events(samples, acoustic)
            if isinstance(event, Phone) and event.is_spoken
        ]
        package_symbols = package_phones(package_output(models, samples, phones=_PHONES[acoustic]))
        counts[SERVER] += count_errors(truth, server_symbols)
        counts[PACKAGE] += count_errors(truth, package_symbols)
        counts[DIFFERENCE] += count_errors(server_symbols, package_symbols)
    return counts
