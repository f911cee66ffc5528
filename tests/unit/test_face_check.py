"""Control refuses unknown names in the settings of a face."""

from typing import Any

import pytest

from kouxing.services.control.face_check import check_face
from kouxing.shared.errors import Rejected
from kouxing.shared.wire.face import FaceSettings


def test_known_names_are_accepted() -> None:
    check_face(FaceSettings())
    check_face(
        FaceSettings(
            lip_model="my-lips", acoustic="light", expressions={"joy": 0.5}, shapes=["vrm"]
        )
    )


@pytest.mark.parametrize(
    ("settings", "text"),
    [
        ({"acoustic": "fast"}, "unknown acoustic model 'fast'; use full, light"),
        ({"shapes": ["vrm", "clay"]}, "unknown set of shapes 'clay'; use arkit, oculus, vrm"),
        ({"expressions": {"happy": 1.0}}, "unknown expression 'happy'; use joy, sadness, "),
    ],
)
def test_an_unknown_name_is_refused_with_the_known_ones(
    settings: dict[str, Any], text: str
) -> None:
    with pytest.raises(Rejected, match=text) as caught:
        check_face(FaceSettings(**settings))
    assert caught.value.code == "bad-face"
