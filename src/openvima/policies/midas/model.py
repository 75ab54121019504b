"""MIDAS: VIMA's object tokens, one decoder over prompt and history, autoregressive actions."""

from openvima.policies.nn.token_policy import TokenPolicy


class Midas(TokenPolicy):
    """Object tokens for each view, the prompt as prefix, and one token per action component.

        [put, the, A front, A top, into, …, end, separator, front 1, front 2, top 1, top 2, x0, y0, …, d1, …]
                                                                                       |    |
                                                                                       x0   y0

    The visual residual adds what enters the text encoder for an object to what it returns.

    Source: MIDAS (Li et al. 2023).
    """
