"""The C library with OVRLipSync's interface has the same visemes as the server."""

import ctypes
import shutil
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import soxr
from numpy.typing import NDArray

from kouxing.evaluation.system.lips_package import server_events
from kouxing.services.cli.web_model import web_model
from kouxing.services.recognizer.acoustic.encoder import EncoderStream, load_encoder
from kouxing.services.recognizer.front_end.resample import to_16_khz
from kouxing.services.recognizer.front_end.whisper_mel import WhisperMel
from kouxing.services.recognizer.live.voice_traits import load_voice_readout
from kouxing.shared.face.faps import NUM_MOUTH_FAPS
from kouxing.shared.face.shapes import OCULUS
from kouxing.shared.phones.events import LipPositions, Phone, Progress, SoundEvent, SpeechChange
from tests.documents import code_blocks
from tests.lips_package import FRAME_RATE_HZ, Frames, closure_at_the_end_of_speech, server_faps
from tests.system import DEMO, NODE, ROOT, samples_of_file

SOURCE = ROOT / "clients" / "ovrlipsync"
LIBRARY = "OVRLipSync.c", "lips.c", "encoder.c", "face.c", "lips_model.c"
NUM_VISEMES = 15
RATE_HZ, BUFFER = 48_000, 1024
FACE_BYTES = 1 << 20  # more than a ``Face`` needs
SUCCESS, CANNOT_CREATE, INVALID, BAD_RATE, UNDEFINED = 0, -2201, -2202, -2203, -2206
ENHANCED, WITH_LAUGHTER = 1, 2
S16_MONO, F32_MONO, F32_STEREO = 0, 2, 3
VISEME_ON, SMOOTHING = 0, 3
EVIDENCE_FRACTION = 0.1  # of a new position, for laughter
Weights = NDArray[np.float64]


class CLipPositions(ctypes.Structure):
    """``LipPositions`` of ``encoder.h``."""

    _fields_ = (
        ("time_s", ctypes.c_double),
        ("delay_s", ctypes.c_double),
        ("faps", ctypes.c_double * NUM_MOUTH_FAPS),
        ("closure", ctypes.c_double),
    )


class Frame(ctypes.Structure):
    _fields_ = (
        ("frame_number", ctypes.c_int),
        ("frame_delay", ctypes.c_int),
        ("visemes", ctypes.POINTER(ctypes.c_float)),
        ("visemes_length", ctypes.c_uint),
        ("laughter_score", ctypes.c_float),
        ("laughter_categories", ctypes.POINTER(ctypes.c_float)),
        ("laughter_categories_length", ctypes.c_uint),
    )


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The program ``visemes`` and the library, compiled without CMake."""
    folder = tmp_path_factory.mktemp("ovrlipsync")
    for name, content in web_model().items():
        (folder / name).write_bytes(content)
    subprocess.run([NODE, SOURCE / "model.mjs", folder, folder], check=True, timeout=60)
    for file in [*SOURCE.glob("*.c"), *SOURCE.glob("*.h")]:
        shutil.copy(file, folder)
    compiler = shutil.which("gcc") or shutil.which("tcc")
    assert compiler is not None, "no C compiler; install gcc or tcc"
    objects = [name.replace(".c", ".o") for name in LIBRARY]
    for command in (
        ["-O2", "-Wall", "-Werror", "-fPIC", "-c", "visemes.c", *LIBRARY],
        ["-o", "visemes", "visemes.o", *objects, "-lm"],
        ["-shared", "-o", "libOVRLipSync.so", *objects, "-lm"],
    ):
        subprocess.run([compiler, *command], cwd=folder, check=True, timeout=120)
    return folder


@pytest.fixture
def library(folder: Path) -> Iterator[Any]:
    library = ctypes.CDLL(str(folder / "libOVRLipSync.so"))
    assert library.ovrLipSync_Initialize(RATE_HZ, BUFFER) == SUCCESS
    yield library
    library.ovrLipSync_Shutdown()


def server_weights(events: Sequence[SoundEvent]) -> Weights:
    """Return the server's visemes (num_frames, 15); feeling does not move them in the library."""
    events = [event for event in events if not isinstance(event, Phone)]
    return np.array([OCULUS.weights(faps) for faps in server_faps(events, feeling=0.0)])


def at_faces(expected: Weights, known_s: Weights, delays_ms: Weights) -> Weights:
    """Return the weights at the times of faces, which are before what is known by the delay."""
    numbers = np.round((known_s - delays_ms / 1e3) * FRAME_RATE_HZ).astype(int)
    weights: Weights = expected[np.maximum(numbers, 0)]
    return weights


def assert_close(ours: Weights, theirs: Weights) -> None:
    """Rounding to 8 bits amplifies differences in the last digit, so a few frames may differ."""
    difference = np.abs(ours - theirs)
    assert difference.mean() < 0.003
    assert np.percentile(difference.max(axis=1), 95) < 0.03


def run_program(folder: Path, name: str) -> tuple[Frames, Weights]:
    """Return a sound and the rows that the program prints for it."""
    integers = (
        np.round(samples_of_file(DEMO / f"{name}.wav") * 32768).clip(-32768, 32767).astype("<i2")
    )
    printed = subprocess.run(
        [folder / "visemes", "16000"], input=integers.tobytes(), capture_output=True, check=True
    ).stdout.decode()
    rows = np.array([line.split() for line in printed.splitlines()], float)
    return (integers / 32768).astype(np.float32), rows


def test_a_c_program_has_the_servers_visemes(folder: Path) -> None:
    sound, rows = run_program(folder, "bilabials-female")
    numbers, delays_ms, weights = rows[:, 0], rows[:, 1], rows[:, 3:]
    assert numbers.tolist() == [*range(len(rows))]
    assert delays_ms[10:].max() == 60
    expected = server_weights(server_events(sound))
    assert_close(weights, at_faces(expected, (numbers + 1) / FRAME_RATE_HZ, delays_ms))
    assert weights[:, 1:].max(axis=0)[[0, 9]].min() > 0.3  # PP and aa


def library_weights(library: Any, events: Sequence[SoundEvent]) -> Weights:
    """Return the visemes of events (num_frames, 15), from the functions of ``face.h``.

    The events' progress is one frame at a time.
    """
    face = ctypes.create_string_buffer(FACE_BYTES)
    weights = (ctypes.c_float * NUM_VISEMES)()
    library.face_init(face)
    rows: list[list[float]] = []
    for event in events:
        match event:
            case SpeechChange(time_s=time_s, active=active):
                library.face_change_speech(face, ctypes.c_double(time_s), ctypes.c_bool(active))
            case LipPositions(time_s=time_s, delay_s=delay_s, faps=faps, closure=closure):
                values = (ctypes.c_double * NUM_MOUTH_FAPS)(*faps.tolist())
                library.face_add_lips(
                    face, ctypes.byref(CLipPositions(time_s, delay_s, values, closure))
                )
            case Progress(time_s=time_s, level_db=level_db):
                library.face_add_level(face, ctypes.c_double(time_s), ctypes.c_double(level_db))
                library.face_visemes(face, ctypes.c_double(len(rows) / FRAME_RATE_HZ), weights)
                rows.append([*weights])
    return np.array(rows)


def test_lips_do_not_pass_through_each_other_at_the_end_of_speech(library: Any) -> None:
    events = closure_at_the_end_of_speech()
    np.testing.assert_allclose(library_weights(library, events), server_weights(events), atol=1e-4)


def new_frame() -> tuple[Frame, Frames]:
    weights = np.full(NUM_VISEMES, np.nan, np.float32)
    pointer = weights.ctypes.data_as(ctypes.POINTER(ctypes.c_float))
    return Frame(visemes=pointer, visemes_length=NUM_VISEMES), weights


def create(library: Any, provider: int = WITH_LAUGHTER) -> ctypes.c_uint:
    context = ctypes.c_uint()
    assert library.ovrLipSync_CreateContext(ctypes.byref(context), provider) == SUCCESS
    assert context.value > 0
    return context


def process(
    library: Any, context: ctypes.c_uint, sound: Frames, kind: int = F32_MONO
) -> tuple[Weights, Weights]:
    """Return delays and weights after each buffer."""
    frame, weights = new_frame()
    rows = []
    for begin in range(0, len(sound) - BUFFER + 1, BUFFER):
        buffer = np.ascontiguousarray(sound[begin : begin + BUFFER])
        result = library.ovrLipSync_ProcessFrameEx(
            context, buffer.ctypes.data_as(ctypes.c_void_p), BUFFER, kind, ctypes.byref(frame)
        )
        assert result == SUCCESS
        rows.append([frame.frame_delay, *weights])
    table = np.array(rows)
    return table[:, 0], table[:, 1:]


def test_buffers_at_48_khz_from_python(library: Any) -> None:
    samples = samples_of_file(DEMO / "hello-female.wav")[:48_000]
    sound = soxr.resample(samples, 16_000, RATE_HZ).astype(np.float32)
    context = create(library)
    delays_ms, mono = process(library, context, sound)
    known_s = (1 + np.arange(len(mono))) * BUFFER / RATE_HZ
    assert 60 <= delays_ms[10:].min() < delays_ms[10:].max() <= 90
    expected = server_weights(server_events(to_16_khz(sound, RATE_HZ)))
    assert_close(mono, at_faces(expected, known_s, delays_ms))

    assert library.ovrLipSync_ResetContext(context) == SUCCESS
    _, stereo = process(library, context, np.repeat(sound[:, None], 2, axis=1), F32_STEREO)
    np.testing.assert_allclose(stereo, mono, atol=1e-6)
    other = create(library, ENHANCED)
    integers = np.round(sound * 32767).astype(np.int16)
    _, from_integers = process(library, other, integers, S16_MONO)
    assert np.abs(from_integers - mono).mean() < 0.003


def test_a_rate_with_many_phases_has_the_visemes_of_a_similar_rate(library: Any) -> None:
    """The filter has 16,000 phases at 47,999 Hz; the library interpolates between 640."""
    samples = samples_of_file(DEMO / "hello-female.wav")[:32_000]
    sound = soxr.resample(samples, 16_000, RATE_HZ).astype(np.float32)
    other = ctypes.c_uint()
    create_ex = library.ovrLipSync_CreateContextEx
    assert create_ex(ctypes.byref(other), ENHANCED, RATE_HZ - 1, False) == SUCCESS
    (_, expected), (_, weights) = (
        process(library, context, sound) for context in (create(library), other)
    )
    assert_close(weights, expected)


def laughter_of(samples: Frames) -> list[float]:
    """Return the server's evidence of laughter, after each position of the encoder."""
    bands = WhisperMel().accept_waveform(samples)
    encoder, readout = EncoderStream(load_encoder()), load_voice_readout()
    evidence, values = 0.0, []
    for pair in bands[: len(bands) // 2 * 2].reshape(-1, 2, bands.shape[1]):
        outputs = encoder.process_encoder_frame(pair).state @ readout.weights + readout.bias
        evidence += EVIDENCE_FRACTION * (float(outputs[2]) - evidence)
        values.append(evidence)
    return values


def test_laughter_scores_are_the_servers_evidence(folder: Path) -> None:
    sound, rows = run_program(folder, "lake-male")
    scores, expected = rows[:, 2], np.clip(laughter_of(sound), 0.0, 1.0)
    assert scores.max() > 0.1
    number = min(len(scores), len(expected)) - 1
    np.testing.assert_allclose(scores[1 : number + 1], expected[:number], atol=0.02)


def test_bad_arguments_have_ovrlipsyncs_errors(library: Any) -> None:
    context = create(library)
    frame, _ = new_frame()
    sound = np.zeros(BUFFER, np.float32)
    pointer = sound.ctypes.data_as(ctypes.c_void_p)

    def run(**changes: Any) -> int:
        values = {"context": context, "audio": pointer, "count": BUFFER, "kind": F32_MONO}
        values |= {"frame": ctypes.byref(frame)} | changes
        return int(library.ovrLipSync_ProcessFrameEx(*values.values()))

    assert run() == SUCCESS
    for changes in ({"context": 99}, {"audio": None}, {"count": -1}, {"kind": 9}, {"frame": None}):
        assert run(**changes) == INVALID
    frame.visemes_length = NUM_VISEMES - 1
    assert run() == INVALID
    assert library.ovrLipSync_SendSignal(context, SMOOTHING, 70, 0) == SUCCESS
    assert library.ovrLipSync_SendSignal(context, SMOOTHING, 0, 0) == INVALID
    assert library.ovrLipSync_SendSignal(context, VISEME_ON, 10, 0) == UNDEFINED
    assert library.ovrLipSync_DestroyContext(context) == SUCCESS
    assert library.ovrLipSync_DestroyContext(context) == INVALID
    new = ctypes.c_uint()
    create_ex = library.ovrLipSync_CreateContextEx
    assert create_ex(ctypes.byref(new), ENHANCED, 4000, False) == BAD_RATE
    assert library.ovrLipSync_Initialize(4000, BUFFER) == BAD_RATE
    library.ovrLipSync_Shutdown()
    assert create_ex(ctypes.byref(new), ENHANCED, RATE_HZ, False) == CANNOT_CREATE


def test_the_python_program_of_the_guide_runs(folder: Path) -> None:
    (program,) = code_blocks(ROOT / "docs" / "clients" / "ovrlipsync.md", "python")
    (folder / "build").mkdir()
    shutil.copy(folder / "libOVRLipSync.so", folder / "build")
    command = [sys.executable, "-c", program]
    printed = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True).stdout
    assert printed.split()[:2] == ["21", "[1."]  # ms, and the weight of "sil"


def test_samples_that_are_not_finite_are_silence(library: Any) -> None:
    invalid, silent = (
        process(library, create(library), np.full(20 * BUFFER, sample, np.float32))[1]
        for sample in (np.nan, 0.0)
    )
    np.testing.assert_array_equal(invalid, silent)
