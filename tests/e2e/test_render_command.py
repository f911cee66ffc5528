"""``kouxing render`` and ``kouxing head``: files in, files out."""

import json
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import av
import numpy as np
import pytest
import soundfile
from PIL import Image

from kouxing.services.cli import heads as page_heads
from kouxing.services.cli.heads import import_mesh
from kouxing.services.cli.launch.run import head_environment
from kouxing.services.cli.options import CurveFormat
from kouxing.services.cli.recordings.commands import render as render_files
from kouxing.services.driver.config import Framing
from kouxing.services.driver.head.glb_export import export_glb
from kouxing.services.driver.head.glb_head import read_glb
from kouxing.services.driver.head.head import Head
from kouxing.services.driver.render.renderer import Renderer
from kouxing.services.heads import page_heads_folder
from kouxing.services.live_pipeline import LivePipeline
from kouxing.services.recognizer.acoustic.load import load_model
from kouxing.services.recognizer.lips.lip_predictor import load_lip_predictor
from kouxing.services.recognizer.lips.mouth_profile import MouthProfile
from kouxing.services.service_kinds import read_settings
from kouxing.services.synthesizer.lips.load import load_lip_model
from kouxing.shared.audio.audio_file import read_audio
from kouxing.shared.errors import UserError
from kouxing.shared.face.fap_file import FapAnimation, read_fap, write_fap
from kouxing.shared.face.lip_constants import DEFAULT_LIP_MODEL
from tests.e2e.conftest import CommandRunner
from tests.glb_writer import write_glb
from tests.meshes import ORIGINAL, meshes
from tests.system import VOWELS_FILE, samples_of_file


def render(source: Path, output: Path, **options: Any) -> None:
    render_files([source, output], force=True, **options)


@pytest.fixture(scope="module")
def vowels(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The first 1.4 s of a recording."""
    path = tmp_path_factory.mktemp("vowels") / "vowels.wav"
    soundfile.write(path, samples_of_file(VOWELS_FILE)[:22_400], 16_000)
    return path


@pytest.fixture(scope="module")
def face(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Ten frames at 20 Hz, in which FAP 1 opens the mouth and FAP 2 shows joy."""
    visemes = np.zeros((10, 4), np.int64)
    visemes[:, 0], visemes[:, 2] = 10, np.linspace(0, 63, 10)
    expressions = np.zeros((10, 6), np.int64)
    expressions[:, 0], expressions[:, 1] = 1, 63
    path = tmp_path_factory.mktemp("fap") / "some face.fap"
    animation = FapAnimation("a name", 20.0, np.zeros((10, 68), np.float32), visemes, expressions)
    write_fap(path, animation)
    return path


def test_renders_a_fap_file_as_a_video_with_sound(
    command: CommandRunner, face: Path, vowels: Path, tmp_path: Path
) -> None:
    video = tmp_path / "face.mp4"
    arguments = ("--sound", vowels, "--size", "160x120", "--background", "white")
    status, _, stderr = command("render", face, video, *arguments)
    assert (status, "phones" in stderr) == (0, False), stderr
    with av.open(str(video)) as film:
        assert film.streams.video[0].average_rate == 20
        assert len(film.streams.audio) == 1
        images = [frame.to_ndarray(format="rgb24") for frame in film.decode(video=0)]
    assert len(images) / 20 == pytest.approx(1.4, abs=0.1), "the last face is held"
    assert images[0][3, 3].min() > 245
    change = np.abs(images[9].astype(int) - images[0]).mean(axis=2)
    assert change[70:100, 60:100].max() > 40, "the mouth opens"
    np.testing.assert_allclose(images[-1].astype(int), images[12], atol=25)


def test_renders_a_transparent_picture_of_any_head(face: Path, tmp_path: Path) -> None:
    pictures = []
    for head, view in (("man", Framing.HEAD), ("man", Framing.SIDE), ("child", Framing.HEAD)):
        path = tmp_path / f"{head}-{view}.png"
        render(
            face, path, head=head, size="161x121", background="transparent",
            camera=view, at=0.2,
        )  # fmt: skip
        pictures.append(np.asarray(Image.open(path)).astype(int))
    for picture in pictures:
        assert picture.shape == (121, 161, 4)
        assert picture[3, 3, 3] == 0
        assert picture[60, 80, 3] == 255
    assert np.abs(pictures[0] - pictures[1]).mean() > 5
    assert np.abs(pictures[0] - pictures[2]).mean() > 5


@pytest.mark.parametrize(
    ("output", "options", "message"),
    [
        ("a.png", {"at": 9.0, "size": "64x48"}, "use 0 to 0.45 seconds"),
        ("a.mp4", {"sound": Path("absent.wav")}, "no such file"),
        ("a.mp4", {"lips": ["learned"]}, "--lips applies to audio"),
        ("a.mp4", {"mouth": Path("me.mouth")}, "--mouth applies to audio"),
        ("a.mp4", {"live": True}, "--live applies to audio"),
        ("a.csv", {"text": "你好"}, "--text applies to audio"),
        ("no/a.png", {"size": "64x48"}, "cannot write"),
    ],
)
def test_rejects_options_that_do_not_fit(
    face: Path, tmp_path: Path, output: str, options: dict[str, Any], message: str
) -> None:
    with pytest.raises(UserError, match=message):
        render(face, tmp_path / output, **options)


def test_renders_a_sound_as_curves_and_converts_them(vowels: Path, tmp_path: Path) -> None:
    fap, lines = tmp_path / "a.fap", tmp_path / "a.jsonl"
    render(vowels, fap)
    faps = read_fap(fap)
    assert faps.frame_rate_hz == 50
    assert np.ptp(faps.faps[:, 2]) > 100
    render(fap, lines, curve_format=CurveFormat.ARKIT)
    frames = [json.loads(line) for line in lines.read_text().splitlines()]
    jaw = [frame["arkit"]["jawOpen"] for frame in frames]
    assert np.corrcoef(jaw, faps.faps[:, 2])[0, 1] > 0.8
    with pytest.raises(UserError, match="a live stream has no text"):
        render(vowels, lines, live=True, text="啊")


def test_a_text_that_does_not_fit_is_rendered_with_exit_status_1(
    command: CommandRunner, vowels: Path, tmp_path: Path
) -> None:
    status, _, stderr = command("render", vowels, tmp_path / "a.csv", "--text", "你好")
    assert status == 1
    assert "the text does not fit the audio" in stderr
    assert "a.csv: the mouth follows the text; without --text, it" in stderr
    assert (tmp_path / "a.csv").exists()


def test_live_frames_are_those_of_the_live_pipeline(vowels: Path, tmp_path: Path) -> None:
    render(vowels, tmp_path / "live.fap", live=True)
    pipeline = LivePipeline(load_model(), load_lip_model())
    samples = read_audio(vowels)[0][:, 0]
    frames = pipeline.accept_waveform(samples) + pipeline.input_finished()
    written = read_fap(tmp_path / "live.fap").faps[:, 2:]
    np.testing.assert_allclose(written, [faps[2:] for _, faps in frames], rtol=1e-6, atol=1e-6)


def test_releases_the_renderer_of_each_file_that_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    closed: list[Renderer] = []
    close = Renderer.close

    def record_close(renderer: Renderer) -> None:
        closed.append(renderer)
        close(renderer)

    monkeypatch.setattr(Renderer, "close", record_close)
    sources = [tmp_path / name for name in ("a.fap", "b.fap", "c.fap")]
    for source in sources:
        source.write_text("damaged", encoding="utf-8")
    with pytest.raises(UserError, match="3 of 3 files failed"):
        render_files(sources, size="64x48")
    assert len(closed) == 3


def test_renders_lip_models_side_by_side(vowels: Path, tmp_path: Path) -> None:
    alone, both = tmp_path / "alone.png", tmp_path / "beside.png"
    shot: dict[str, Any] = {"camera": Framing.MOUTH, "at": 1.2}
    render(vowels, alone, size="200x160", **shot)
    lips = ["dynamic-visemes", "learned"]
    render(vowels, both, lips=lips, size="400x160", **shot)
    default = np.asarray(Image.open(alone)).astype(int)
    visemes, learned = np.split(np.asarray(Image.open(both)).astype(int), 2, axis=1)
    assert DEFAULT_LIP_MODEL == "learned"
    np.testing.assert_array_equal(learned[:140], default[:140])
    assert np.abs(visemes - learned)[:140].max() > 40
    assert default[140:].min(axis=2).max() < 200 < learned[140:].min(axis=2).max(), "a caption"
    with pytest.raises(UserError, match="choose a width that is a multiple of 2"):
        render(vowels, both, lips=lips, size="401x160", **shot)


def test_a_mouth_profile_changes_the_face(vowels: Path, tmp_path: Path) -> None:
    lips = load_lip_predictor()
    mouth, misfit = tmp_path / "me.mouth", tmp_path / "misfit.mouth"
    profile = MouthProfile(
        scale=np.full(15, 3, np.float32),
        offset=np.zeros(15, np.float32),
        residual=np.zeros(lips.residual_shape, np.float32),
    )
    mouth.write_bytes(profile.to_bytes(lips.digest))
    misfit.write_bytes(profile.to_bytes(bytes(32)))
    with pytest.raises(UserError, match=r"misfit\.mouth: it was made for another lip model"):
        render(vowels, tmp_path / "a.png", mouth=misfit, size="160x128")
    shot: dict[str, Any] = {"camera": Framing.MOUTH, "at": 1.2, "size": "160x128"}
    render(vowels, tmp_path / "plain.png", **shot)
    render(vowels, tmp_path / "wide.png", mouth=mouth, **shot)
    plain, wide = (np.asarray(Image.open(tmp_path / f"{name}.png")) for name in ("plain", "wide"))
    assert np.abs(plain.astype(int) - wide).max() > 40


def test_renders_an_imported_mesh(face: Path, tmp_path: Path) -> None:
    write_glb(tmp_path / "mesh.glb", meshes())
    rows = [
        f"{name} {' '.join(map(str, ORIGINAL.vertices[vertex]))}"
        for name, vertex in ORIGINAL.feature_points.items()
    ]
    (tmp_path / "points.tsv").write_text("\n".join(rows), encoding="utf-8")
    imported = tmp_path / "mine.npz"
    import_mesh(tmp_path / "mesh.glb", tmp_path / "points.tsv", imported)
    render(face, tmp_path / "frames", head=str(imported), size="64x48")
    assert len(list((tmp_path / "frames").iterdir())) == 10


@pytest.mark.parametrize(
    ("assignments", "option", "driver", "page"),
    [
        ({}, "", "woman", "woman"),
        ({"common.head": "mika"}, "", "mika", "mika"),
        ({"driver.head": "mika", "gateway.head": ""}, "man", "man", "man"),
        ({"driver.head": "mika"}, "", "mika", "mika"),
        ({"driver.head": "mika", "gateway.head": ""}, "", "mika", "mika"),
        ({"driver.head": "mika", "gateway.head": "my.glb"}, "", "mika", None),
    ],
)
def test_the_page_shows_the_head_of_the_driver(
    tmp_path: Path, assignments: dict[str, str], option: str, driver: str, page: str | None
) -> None:
    environment = head_environment(read_settings(assignments=assignments), option, tmp_path)
    assert environment["KOUXING_DRIVER_HEAD"] == driver
    assert environment.get("KOUXING_GATEWAY_HEAD") == page


def test_the_page_gets_a_file_of_an_avatar(tmp_path: Path) -> None:
    export_glb(Head.load("child", "coarse"), tmp_path / "my.glb")
    settings = read_settings(assignments={"common.head": str(tmp_path / "my.glb")})
    environment = head_environment(settings, "", tmp_path / "out")
    page_head = tmp_path / "out" / "head.glb"
    assert environment == {
        "KOUXING_DRIVER_HEAD": str(tmp_path / "my.glb"),
        "KOUXING_GATEWAY_HEAD": str(page_head),
    }
    given, shown = read_glb(tmp_path / "my.glb"), read_glb(page_head)
    assert len(shown.vertices) == len(given.vertices)


def test_run_exports_missing_heads_to_the_cache(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(page_heads, "_PAGE", tmp_path / "nowhere")
    monkeypatch.setattr(page_heads, "HEAD_NAMES", ("woman", "man"))
    page_heads.ensure_page_heads()
    files = sorted(page_heads_folder().iterdir())
    assert [file.name for file in files] == ["head-man.glb", "head.glb"]
    written_ns = [file.stat().st_mtime_ns for file in files]
    page_heads.ensure_page_heads()
    assert [file.stat().st_mtime_ns for file in files] == written_ns, "they are up to date"


def test_run_without_a_home_folder_needs_no_cache(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr(Path, "home", Mock(side_effect=RuntimeError))
    monkeypatch.setattr(page_heads, "_PAGE", tmp_path)
    page_heads.ensure_page_heads()
    assert "this user has no home folder; set XDG_CACHE_HOME" in capsys.readouterr().err
