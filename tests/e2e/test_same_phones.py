"""Every way into kouxing returns the same phones for the same recording."""

import asyncio
import csv
from pathlib import Path

import numpy as np
import pytest
import soundfile
from kouxing_client import Phone
from kouxing_client.aio import AsyncClient

from kouxing.services.recognizer.acoustic.load import load_model
from kouxing.services.recognizer.offline import recognize
from kouxing.shared.audio_file import read_audio
from kouxing.shared.phones import events
from tests.system import DEMO, LIMIT_S, VOWELS_FILE, System, kouxing, start_python

CHUNK = 997  # samples, so that no chunk ends with a slice of 20 ms
Timed = tuple[str, int, int, float]  # symbol, onset and duration in samples at 16 kHz, confidence


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Some samples, and a loud stereo recording at 44.1 kHz that ends within a word."""
    folder = tmp_path_factory.mktemp("recordings")
    samples = read_audio(DEMO / "lake-male.wav")[0][:, 0]
    times = np.arange(0, 40_000, 16_000 / 44_100)  # of 2.5 s
    stereo = np.interp(times, np.arange(len(samples)), samples)[:, None] * [1.5, 0.4]
    soundfile.write(folder / "stereo.wav", stereo, 44100, subtype="FLOAT")
    demos = [DEMO / f"{name}.wav" for name in ("lake-male", "hello-female", "bilabials-female")]
    return [*demos, VOWELS_FILE, folder / "stereo.wav"]


@pytest.fixture(scope="module")
def expected(recordings: list[Path]) -> dict[str, list[events.Phone]]:
    """The phones of each recording by its name, found by a single call."""
    model = load_model()
    return {path.name: recognize(model, *read_audio(path)) for path in recordings}


def spoken(phones: list[events.Phone]) -> list[events.Phone]:
    return [phone for phone in phones if phone.is_spoken]


def line(phone: events.Phone) -> str:
    """Return a phone as ``kouxing listen`` prints it."""
    return f"{phone.onset_s:9.3f} s  {phone.duration_s:6.3f} s  {phone.symbol}"


def test_recordings_have_phones_in_order(expected: dict[str, list[events.Phone]]) -> None:
    for name, phones in expected.items():
        assert len(spoken(phones)) >= 6, name
        assert [phone.index for phone in phones] == [*range(len(phones))]
        assert all(phone.duration_s > 0 for phone in phones)
        ends_s = [0.0, *(phone.onset_s + phone.duration_s for phone in phones)]
        assert all(
            end_s <= phone.onset_s + 1e-9 for end_s, phone in zip(ends_s, phones, strict=False)
        )


def test_phones_and_render_return_them(
    recordings: list[Path], expected: dict[str, list[events.Phone]], tmp_path: Path
) -> None:
    assert kouxing("phones", *recordings, "-o", tmp_path, "--format", "csv").returncode == 0
    for path in recordings:
        with (tmp_path / f"{path.stem}.csv").open() as file:
            rows = [[row[name] for name in row] for row in csv.DictReader(file)]
        for row, phone in zip(rows, expected[path.name], strict=True):
            assert row[1] == phone.symbol
            times = (phone.onset_s, phone.duration_s, phone.confidence)
            np.testing.assert_allclose([*map(float, row[2:5])], times, atol=5.1e-4)
    live = kouxing("render", recordings[0], tmp_path / "live.csv", "--live")
    assert f", {len(spoken(expected[recordings[0].name]))} phones" in live.stderr
    options = ("--size", "64x64", "--rate", "1", "-o", tmp_path)
    rendered = kouxing("render", *recordings, *options)
    for path in recordings:
        count = len(spoken(expected[path.name]))
        assert any(
            f"{path.stem}.mp4:" in text and text.endswith(f", {count} phones")
            for text in rendered.stderr.splitlines()
        ), rendered.stderr


def test_speak_and_listen_return_them(
    system: System, recordings: list[Path], expected: dict[str, list[events.Phone]]
) -> None:
    for number, path in enumerate(recordings):
        name = f"same-{number}"
        listener = start_python(
            "-m", "kouxing", "listen", name, "--show", "phones", control=system.control
        )
        assert listener.stderr is not None
        assert name in listener.stderr.readline()
        pace = ["--fast"] if number else []
        phones = spoken(expected[path.name])
        said = kouxing("speak", path, "--session", name, *pace, control=system.control)
        assert f"session {name}: {len(phones)} phones in" in said.stderr
        output, log = listener.communicate(timeout=LIMIT_S)
        assert f"session {name} ended: {len(phones)} phones" in log
        assert output.splitlines() == [line(phone) for phone in phones]


def test_the_asyncio_client_returns_them_bit_for_bit(
    system: System, recordings: list[Path], expected: dict[str, list[events.Phone]]
) -> None:
    async def recognized(client: AsyncClient, path: Path) -> list[Timed]:
        samples, rate_hz = read_audio(path)
        session = await client.open_session(
            encoding="f32le",
            sample_rate_hz=rate_hz,
            num_channels=samples.shape[1],
            paced=False,
        )
        async with session:
            results = await session.results(Phone, keep_all=True)
            for begin in range(0, len(samples), CHUNK):
                await session.push(samples[begin : begin + CHUNK].astype("<f4").tobytes())
            await session.finish()
            return [
                (phone.symbol, phone.media_time, phone.duration, phone.confidence)
                async for phone in results
                if phone.final and phone.duration
            ]

    async def run() -> list[list[Timed]]:
        async with AsyncClient(system.control) as client:
            return await asyncio.gather(*(recognized(client, path) for path in recordings))

    for path, phones in zip(recordings, asyncio.run(run()), strict=True):
        assert phones == [
            (
                phone.symbol,
                round(phone.onset_s * 16000),
                round(phone.duration_s * 16000),
                phone.confidence,
            )
            for phone in expected[path.name]
        ]
