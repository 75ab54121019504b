"""VIMA-GPT: one token summarises a pair of frames, and the prompt is the prefix of the sequence."""

from openvima.policies.nn.token_policy import TokenPolicy


class Gpt(TokenPolicy):
    """The class vectors of both views, side by side, are one token.

        [put, the, A, into, the, B, ., end, separator, frames, action, frames, action, …]
                                                            |
                                                       1st action

    Source: VIMA (Jiang et al. 2023), baselines; after GPT (Radford et al. 2018).
    """
