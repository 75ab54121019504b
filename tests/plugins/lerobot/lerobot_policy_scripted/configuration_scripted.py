"""Its configuration, in the file that LeRobot looks for."""

from dataclasses import dataclass, field

from lerobot.configs import FeatureType, PolicyFeature
from lerobot.configs.policies import PreTrainedConfig
from lerobot.optim.optimizers import AdamWConfig

IMAGE = PolicyFeature(FeatureType.VISUAL, (3, 128, 256))


@PreTrainedConfig.register_subclass("scripted")
@dataclass
class ScriptedConfig(PreTrainedConfig):
    """Reads the text, the top view, and the top view of the first prompt image.

    Args:
        low_level: Decide commands of the tool, from the text and the top view alone.
    """

    low_level: bool = False

    input_features: dict[str, PolicyFeature] | None = field(
        default_factory=lambda: {
            "observation.images.top": IMAGE,
            "observation.images.prompt_0_top": IMAGE,
            "observation.state": PolicyFeature(FeatureType.STATE, (7,)),
        }
    )
    output_features: dict[str, PolicyFeature] | None = field(
        default_factory=lambda: {"action": PolicyFeature(FeatureType.ACTION, (12,))}
    )

    observation_delta_indices = action_delta_indices = reward_delta_indices = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.low_level:
            self.input_features = {
                "observation.images.top": IMAGE,
                "observation.state": PolicyFeature(FeatureType.STATE, (12,)),
            }
            self.output_features = {"action": PolicyFeature(FeatureType.ACTION, (5,))}

    def get_optimizer_preset(self) -> AdamWConfig:
        return AdamWConfig()

    def get_scheduler_preset(self) -> None:
        return None

    def validate_features(self) -> None:
        pass
