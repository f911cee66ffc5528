"""The synthesizer's configuration."""

from dataclasses import dataclass
from typing import Annotated

from msgspec import Meta

from kouxing.services.lip_models import lip_model_info, lip_model_names
from kouxing.shared.errors import UserError
from kouxing.shared.face.config import FaceConfig, LiveConfig
from kouxing.shared.face.lip_constants import DEFAULT_LIP_MODEL
from kouxing.shared.settings.config import (
    BoundEndpoint,
    Check,
    KnownNames,
    ValueHint,
    derived_default,
)


def _default_delay_ms(config: "SynthesizerConfig") -> float:
    try:
        return lip_model_info(config.lips).delay_ms
    except UserError:  # a broken package; the synthesizer reports it when it loads the lip model
        return lip_model_info(DEFAULT_LIP_MODEL).delay_ms


def _check_milliseconds(value: float) -> float:
    if 0.0 < value < 1.0:  # surely seconds
        raise ValueError
    return value


@dataclass(frozen=True, kw_only=True)
class SynthesizerConfig(FaceConfig, LiveConfig):
    """The synthesizer's configuration keys."""

    phone_input: BoundEndpoint = "tcp://127.0.0.1:5570"
    """Endpoint that receives phones and lip positions from recognizers."""
    faps: BoundEndpoint = "tcp://127.0.0.1:5571"
    """Endpoint that publishes FAP frames."""
    frame_rate_hz: Annotated[float, Meta(ge=10, le=240)] = 50.0
    """FAP frames per second."""
    lips: Annotated[str, KnownNames(lip_model_names)] = DEFAULT_LIP_MODEL
    """Default lip model. A client can choose another one for its session."""
    delay_ms: Annotated[
        float,
        Meta(ge=0, le=300),
        Check(_check_milliseconds),
        ValueHint("0, or a number of milliseconds from 1 to 300"),
    ] = derived_default(_default_delay_ms)
    """How much later than its audio a frame is made, in steps of 20 ms. A longer delay gives
    better lips. The default is 160 if lips is dynamic-visemes or ferguson."""
    expressiveness: Annotated[float, Meta(ge=0.5, le=2)] = 1.4
    """Size of the mouth movements. 1 leaves the lip model unchanged. Closures stay closed."""
    feeling: Annotated[float, Meta(ge=0, le=1)] = 0.5
    """How strongly the face shows the emotion in the voice. 0 turns this off."""
