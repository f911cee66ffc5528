"""Control rejects unknown names in the settings of a face."""

from typing import Any

import msgspec
import pytest

from kouxing.services.control.face_check import check_acoustic_model, check_face
from kouxing.shared.errors import Rejected
from kouxing.shared.wire.face import FaceSettings

LIP_MODELS = ["learned", "my-lips"]


def test_known_names_are_accepted() -> None:
    settings = FaceSettings(
        lip_model="my-lips", acoustic="light", expressions={"joy": 0.5}, shapes=["vrm"]
    )
    check_face(FaceSettings(), LIP_MODELS)
    check_face(settings, LIP_MODELS)
    check_face(settings, [])  # no synthesizer reports its lip models


def test_the_light_acoustic_model_has_only_mandarin() -> None:
    light = FaceSettings(acoustic="light")
    check_acoustic_model(light, "mandarin")
    check_acoustic_model(light, None)
    check_acoustic_model(FaceSettings(acoustic="full"), "english")
    with pytest.raises(Rejected, match="light has only mandarin; leave out acoustic") as caught:
        check_acoustic_model(light, "english")
    assert caught.value.code == "bad-face"


def test_a_face_cannot_listen_to_itself() -> None:
    check_face(FaceSettings(listen_to="b"), LIP_MODELS, "a")
    with pytest.raises(Rejected, match="face 'a' cannot listen to itself"):
        check_face(FaceSettings(listen_to="a"), LIP_MODELS, "a")


@pytest.mark.parametrize(
    ("settings", "text"),
    [
        ({"lip_model": "muscles"}, "unknown lip model 'muscles'; use learned, my-lips"),
        ({"acoustic": "fast"}, "unknown acoustic model 'fast'; use full, light"),
        ({"shapes": ["vrm", "clay"]}, "unknown set of shapes 'clay'; use arkit, oculus, vrm"),
        ({"expressions": {"happy": 1.0}}, "unknown expression 'happy'; use joy, sadness, "),
        ({"expressions": {"joy": 2}}, "expression joy: strength 2.0 is not between 0 and 1"),
    ],
)
def test_a_rejected_setting_is_named(settings: dict[str, Any], text: str) -> None:
    with pytest.raises(Rejected, match=text) as caught:
        check_face(msgspec.convert(settings, FaceSettings), LIP_MODELS)
    assert caught.value.code == "bad-face"
