"""The recognizer's configuration."""

from typing import Annotated

from pydantic import Field

from kouxing.services.recognizer.search.output_rule import MODEL_RULES, OutputRuleConfig
from kouxing.shared.config import BoundEndpoint, DependentDefault, KnownNames
from kouxing.shared.face.config import LiveConfig

_DEFAULT_RULE = OutputRuleConfig()
MODEL_NAMES = ("blocks", "light", "gmm", "universal")


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
    """Acoustic model: blocks has the fewest errors, light suits weak machines, and universal knows
    the phones of all languages."""
    num_stable_frames: Annotated[int, Field(ge=1, le=20)] = Field(
        default_factory=DependentDefault(
            "acoustic",
            MODEL_RULES.keys,
            lambda name: MODEL_RULES[name].num_stable_frames,
            _DEFAULT_RULE.num_stable_frames,
        )
    )
    """Consecutive frames that must agree before a phone is emitted (N = 3 in Li 2011)."""
    min_confidence: Annotated[float, Field(ge=0, le=1)] = Field(
        default_factory=DependentDefault(
            "acoustic",
            MODEL_RULES.keys,
            lambda name: MODEL_RULES[name].min_confidence,
            _DEFAULT_RULE.min_confidence,
        )
    )
    """Confidence that the phone must reach in each of these frames. 0 is the rule of Li 2011."""

    @property
    def output_rule(self) -> OutputRuleConfig:
        """The output rule: decides when a phone is emitted."""
        return OutputRuleConfig(self.num_stable_frames, self.min_confidence)
