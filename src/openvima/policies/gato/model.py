"""VIMA-Gato: every patch of a frame is a token, and the prompt is the prefix of the sequence."""

from openvima.policies.nn.token_policy import TokenPolicy


class Gato(TokenPolicy):
    """Patches of both views in one causal sequence.

        [put, the, 16 patches, into, the, 16 patches, ., end, separator, 16 patches, action, 16 patches, …]
                                                                                  |
                                                                             1st action

    Source: VIMA (Jiang et al. 2023), baselines; after Gato (Reed et al. 2022).
    """
