"""The synthesizer's configuration."""

from collections.abc import Mapping
from typing import Annotated, Any

from pydantic import AfterValidator, Field

from kouxing.services.lip_models import lip_model_info, lip_model_names
from kouxing.shared.errors import UserError
from kouxing.shared.face.config import FaceConfig, LiveConfig
from kouxing.shared.face.lip_constants import DEFAULT_LIP_MODEL
from kouxing.shared.settings.config import BoundEndpoint, KnownNames, ValueHint


def _delay_ms(values: Mapping[str, Any]) -> float:
    """Return the default delay for the values of earlier keys."""
    try:
        return lip_model_info(values.get("lips", DEFAULT_LIP_MODEL)).delay_ms
    except UserError:  # a broken package; the synthesizer reports it when it loads the lip model
        return lip_model_info(DEFAULT_LIP_MODEL).delay_ms


def _check_milliseconds(value: float) -> float:
    if 0.0 < value < 1.0:  # surely seconds
        raise ValueError
    return value


class SynthesizerConfig(FaceConfig, LiveConfig):
    """The synthesizer's configuration keys."""

    phone_input: BoundEndpoint = "tcp://127.0.0.1:5570"
    """Endpoint that receives phones and lip positions from recognizers."""
    faps: BoundEndpoint = "tcp://127.0.0.1:5571"
    """Endpoint that publishes FAP frames."""
    frame_rate_hz: Annotated[float, Field(ge=10, le=240)] = 50.0
    """FAP frames per second."""
    lips: Annotated[str, KnownNames(lip_model_names)] = DEFAULT_LIP_MODEL
    """Default lip model. A client can choose another one for its session."""
    delay_ms: Annotated[
        float,
        Field(ge=0, le=300),
        AfterValidator(_check_milliseconds),
        ValueHint("0, or a number of milliseconds from 1 to 300"),
    ] = Field(default_factory=_delay_ms)
    """How much later than its audio a frame is made, in steps of 20 ms. A longer delay gives
    better lips. The default is 160 if lips is dynamic-visemes or ferguson."""
    expressiveness: Annotated[float, Field(ge=0.5, le=2)] = 1.4
    """Size of the mouth movements. 1 leaves the lip model unchanged. Closures stay closed."""
    feeling: Annotated[float, Field(ge=0, le=1)] = 0.5
    """How strongly the face shows the emotion in the voice. 0 turns this off."""
