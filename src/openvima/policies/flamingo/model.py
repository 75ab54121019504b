"""VIMA-Flamingo: four latents summarise a pair of frames, and cross-attention reads the prompt."""

from openvima.policies.nn.token_policy import TokenPolicy


class Flamingo(TokenPolicy):
    """A Perceiver resampler over the patches of both views.

        prompt   [put, the, 4 latents, into, the, 4 latents, ., end]
        history  [4 latents, action, 4 latents, action, …]
                          |
                     1st action

    Source: VIMA (Jiang et al. 2023), baselines; after Flamingo (Alayrac et al. 2022).
    """
