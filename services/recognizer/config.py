"""The recognizer's configuration."""

from dataclasses import dataclass
from typing import Annotated

from msgspec import Meta

from kouxing.services.recognizer.search.output_rule import MODEL_RULES, OutputRuleConfig
from kouxing.shared.face.config import LiveConfig
from kouxing.shared.settings.config import BoundEndpoint, KnownNames, derived_default

MODEL_NAMES = ("blocks", "light", "gmm", "universal")


def _default_rule(config: "RecognizerConfig") -> OutputRuleConfig:
    return MODEL_RULES.get(config.acoustic, OutputRuleConfig())


@dataclass(frozen=True, kw_only=True)
class RecognizerConfig(LiveConfig):
    """The keys of the recognizer."""

    audio: BoundEndpoint = "tcp://127.0.0.1:5560"
    """Endpoint to which clients send the audio of live sessions."""
    phones: BoundEndpoint = "tcp://127.0.0.1:5561"
    """Endpoint that publishes phones, lip positions, speech and sound."""
    unpaced_audio: BoundEndpoint = "tcp://127.0.0.1:5562"
    """Endpoint to which clients send the audio of sessions that are not paced. Live audio takes
    precedence."""
    acoustic: Annotated[
        str, KnownNames(lambda: MODEL_NAMES, r".*\.\w+", ", or a file such as model.npz")
    ] = "blocks"
    """Acoustic model: blocks has the fewest errors, light suits weak machines, and universal has
    the phones of all languages."""
    num_stable_frames: Annotated[int, Meta(ge=1, le=20)] = derived_default(
        lambda config: _default_rule(config).num_stable_frames
    )
    """Number of consecutive frames that must agree before a phone is emitted (N in Li 2011, where
    it is 3). More frames give fewer wrong phones, but later ones. The default is 1 if acoustic is
    light or gmm."""
    min_confidence: Annotated[float, Meta(ge=0, le=1)] = derived_default(
        lambda config: _default_rule(config).min_confidence
    )
    """Confidence that the phone must reach in each of these frames. 0 is the rule of Li 2011. The
    default is 0.9 if acoustic is light or gmm."""

    @property
    def output_rule(self) -> OutputRuleConfig:
        """The output rule: decides when a phone is emitted."""
        return OutputRuleConfig(self.num_stable_frames, self.min_confidence)
