"""A head that decides on one component of an action after the other, each in the light of those before it.

Each component is a token of its own in the trunk's sequence, in the order x, y and rotation of pose0, then of
pose1. Where two actions would be right, independent components may mix them; here the first one decides.

Shape suffixes as in `base.py`; C components of an action, K bins of one.
"""

from dataclasses import dataclass

import torch
from torch import nn

from openvima.errors import ConfigError, PolicyError
from openvima.policies.heads.base import ACTION_WIDTH, Choose, HeadInputs, ReadOn, from_unit_range, likeliest
from openvima.policies.heads.bins import NUM_BINS, BinsConfig, BinsHead, decode_bins, encode_bins


@dataclass(frozen=True, slots=True)
class AutoregressiveConfig:
    """Sizes of the autoregressive head.

    Args:
        hidden_width: Width of the two hidden layers of each component's classifier.
        token_std: Standard deviation of the fresh vectors of the bins.
    """

    hidden_width: int = 512
    token_std: float = 0.02

    def __post_init__(self) -> None:
        if self.token_std <= 0:
            raise ConfigError(f"autoregressive head: token_std is {self.token_std}; it must be above 0.")


class AutoregressiveHead(BinsHead):
    """Twelve classifiers over the bins of the published head, each on the output at a place of its own.

        [..., last slot,  x0,  y0, a0, b0, c0, d0,  x1,  y1, a1, b1, c1, d1, next step ...]
                  |       |    |   |   |   |   |    |    |   |   |   |
                  x0      y0   a0  b0  c0  d0  x1   y1   a1  b1  c1  d1

    The places are those of the trunk, which has read all that came before.
    """

    def __init__(self, config: AutoregressiveConfig, width: int) -> None:
        super().__init__(BinsConfig(config.hidden_width), width)

    def scores(self, inputs: HeadInputs) -> list[torch.Tensor]:
        """Return one tensor (B, T, bins) for each component, given the demonstrated ones before it."""
        assert inputs.components_BTCD is not None  # whole histories are read with their actions
        places = inputs.components_BTCD.unbind(2)
        return [classifier(place) for classifier, place in zip(self.classifiers, places, strict=True)]

    def decide(
        self, inputs: HeadInputs, choose: Choose = likeliest, read_on: ReadOn | None = None
    ) -> torch.Tensor:
        """Choose a bin, read its token, choose the next one, and so on.

        Raises:
            PolicyError: `read_on` is missing; `PolicyNetwork.decide` gives it.
        """
        if read_on is None:
            raise PolicyError(
                "this head decides on one component after the other and reads each in between; call "
                "PolicyNetwork.decide with the state of the trunk."
            )
        output_BTD, chosen = inputs.query_BTD, []
        for component, classifier in enumerate(self.classifiers):
            chosen.append(choose(classifier(output_BTD)))
            if component + 1 < ACTION_WIDTH:
                output_BTD = read_on(component, chosen[-1])
        bins = torch.stack(chosen, dim=-1)
        return from_unit_range(decode_bins(bins, inputs.positions_BTN2.dtype))


class ComponentTokens(nn.Module):
    """A past action -> twelve tokens, one for each component: a learned vector for each of its bins."""

    starts: torch.Tensor

    def __init__(self, width: int, std: float) -> None:
        super().__init__()
        self.bins = nn.Embedding(sum(NUM_BINS), width)
        nn.init.normal_(self.bins.weight, std=std)
        starts = [sum(NUM_BINS[:component]) for component in range(ACTION_WIDTH)]
        # A constant has a device of its own, so that a network without weights has it, too.
        self.register_buffer("starts", torch.tensor(starts, device="cpu"), persistent=False)

    def forward(self, unit_actions: torch.Tensor) -> torch.Tensor:
        """Map actions in unit range, shape (..., 12), to tokens (..., 12, D)."""
        return self.bins(encode_bins(unit_actions) + self.starts)

    def of(self, component: int, bins: torch.Tensor) -> torch.Tensor:
        """Map bins of one component, int64, any shape, to tokens (..., D)."""
        return self.bins(bins + self.starts[component])
