"""The action heads of VIMA, the baselines and MIDAS, by config."""

from openvima.policies.nn.action_encoder import ActionEncoder
from openvima.policies.nn.action_head import ActionHead
from openvima.policies.nn.autoregressive import AutoregressiveConfig, AutoregressiveHead, ComponentTokens
from openvima.policies.nn.bins import BinsConfig, BinsHead
from openvima.policies.nn.continuous import MixtureConfig, MixtureHead, RegressionConfig, RegressionHead

HeadConfig = BinsConfig | AutoregressiveConfig | MixtureConfig | RegressionConfig
HEADS: dict[str, type[HeadConfig]] = {
    "bins": BinsConfig,
    "autoregressive": AutoregressiveConfig,
    "mixture": MixtureConfig,
    "regression": RegressionConfig,
}


def build_action_tokens(config: HeadConfig, width: int) -> ActionEncoder | ComponentTokens:
    """Build the tokens of past actions; before the decoder, so that a seed gives the same weights."""
    if isinstance(config, AutoregressiveConfig):
        return ComponentTokens(width, config.token_std)
    return ActionEncoder(config.action_width, width)


def build_head(
    config: HeadConfig, width: int, actions: ActionEncoder | ComponentTokens
) -> ActionHead | AutoregressiveHead:
    """Build the head that goes with the tokens of past actions."""
    if isinstance(actions, ComponentTokens):
        return AutoregressiveHead(config.hidden_width, width, actions)
    if isinstance(config, MixtureConfig):
        return MixtureHead(config, width, actions)
    if isinstance(config, RegressionConfig):
        return RegressionHead(config, width, actions)
    return BinsHead(config.hidden_width, width, actions)
