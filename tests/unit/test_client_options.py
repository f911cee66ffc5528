"""Keywords of sessions and faces: unknown ones and wrong values are rejected before sending."""

from typing import Any

import pytest
from kouxing_client import FapFrame, KouxingError, Phone, Shapes
from kouxing_client.messages import Event
from kouxing_client.options import FaceSettings, check_results, open_fields

from kouxing.shared.wire import face


def test_the_package_has_all_face_settings_of_the_protocol() -> None:
    assert FaceSettings.__annotations__.keys() == {*face.FaceSettings.__struct_fields__}


@pytest.mark.parametrize(
    ("options", "hint"),
    [
        ({"sample_rate": 48000}, r"open_session\(\) .*; did you mean 'sample_rate_hz'"),
        ({"channels": 2}, "did you mean 'num_channels'"),
        ({"x": 1}, "use sample_rate_hz, num_channels, "),
        ({"lip_model": "learned"}, r"write face=\{'lip_model': \.\.\.\}"),
        ({"face": {"lip_mode": ""}}, r"set_face\(\) has .* 'lip_mode'; did you mean 'lip_model'"),
    ],
)
def test_an_unknown_keyword_is_rejected_with_the_nearest(options: Any, hint: str) -> None:
    with pytest.raises(TypeError, match=hint):
        open_fields("", options)


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"sample_rate_hz": 200000}, "must be an integer from 8000 to 48000, not 200000"),
        ({"sample_rate_hz": 16000.0}, "must be an integer from 8000 to 48000, not 16000.0"),
        ({"num_channels": 3}, "num_channels must be an integer from 1 to 2, not 3"),
        ({"encoding": "mp3"}, "encoding must be one of s16le, f32le, not 'mp3'"),
        ({"shapes": "arkit"}, r"shapes must be a list of sets, such as \['arkit'\]"),
        ({"face": {"shapes": "vrm"}}, r"shapes must be a list of sets, such as \['vrm'\]"),
    ],
)
def test_wrong_values_are_rejected(options: Any, text: str) -> None:
    with pytest.raises(KouxingError, match=text):
        open_fields("", options)


@pytest.mark.parametrize(
    ("classes", "text"),
    [
        (["FapFrame"], "not 'FapFrame'"),
        ([Event], "not <class .*Event'>"),
        ([], "needs classes"),
        ([FapFrame, Shapes], "shapes='arkit'"),
    ],
)
def test_results_need_classes_that_a_session_publishes(classes: list[Any], text: str) -> None:
    check_results([FapFrame, Phone], "")
    check_results([FapFrame, Shapes], "arkit")
    with pytest.raises(KouxingError, match=text):
        check_results(classes, "")


def test_the_fields_contain_defaults_and_one_list_of_shapes() -> None:
    fields = open_fields("s", {"shapes": ("vrm",), "face": {"still": True}})
    assert fields == {
        "session": "s",
        "sample_rate_hz": 16000,
        "num_channels": 1,
        "encoding": "s16le",
        "face": {"still": True, "shapes": ["vrm"]},
    }
