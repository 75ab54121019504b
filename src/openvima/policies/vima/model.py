"""VIMA: object tokens, and cross-attention to the prompt."""

from openvima.policies.nn.token_policy import TokenPolicy


class Vima(TokenPolicy):
    """One token for each object in each view.

    "Put the {a} into the {b}." with one object in each image, two objects on the table:

        prompt   [put, the, A front, A top, into, the, B front, B top, ., end]
        history  [front 1, front 2, top 1, top 2, action, front 1, front 2, top 1, top 2, …]
                                             |                                       |
                                        1st action                              2nd action

    With `images.fuse_views` both views of an object are one token; with `query_token` the action is decoded
    from a learned token behind the objects instead of the last object token.

    Source: VIMA (Jiang et al. 2023), section 4.
    """
