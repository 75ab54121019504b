"""Decoders: causality, masks, padding, caches, and limits of length."""

import pytest
import torch

from openvima.errors import ConfigError, PolicyError
from openvima.policies.nn.decoder import (
    CausalDecoder,
    Decoder,
    DecoderConfig,
    PrefixDecoder,
    PrefixDecoderConfig,
)


@pytest.fixture(params=["decoder", "prefix"])
def decoder(request) -> CausalDecoder:
    torch.manual_seed(0)
    if request.param == "decoder":
        return Decoder(DecoderConfig(width=16, num_layers=2, num_self_heads=2, num_cross_heads=2)).eval()
    return PrefixDecoder(PrefixDecoderConfig(width=16, num_layers=2, num_heads=2)).eval()


def test_future_and_masked_positions_do_not_change_earlier_outputs(decoder) -> None:
    tokens, prompt = torch.randn(1, 8, 16), torch.randn(1, 3, 16)
    mask, prompt_mask = torch.ones(1, 8, dtype=torch.bool), torch.tensor([[True, True, False]])
    mask[0, 3] = False

    def run(tokens, prompt):
        return decoder(decoder.init_cache(prompt, prompt_mask), tokens, mask)[0]

    expected = run(tokens, prompt)
    changed = tokens.clone()
    changed[0, 6:] = 9.0  # future
    changed[0, 3] = 9.0  # masked
    changed_prompt = prompt.clone()
    changed_prompt[0, 2] = 9.0
    actual = run(changed, changed_prompt)
    torch.testing.assert_close(actual[0, [0, 1, 2, 4, 5]], expected[0, [0, 1, 2, 4, 5]])
    assert not torch.allclose(actual[0, 6], expected[0, 6])


def test_decoding_in_pieces_equals_decoding_at_once(decoder) -> None:
    tokens, prompt = torch.randn(2, 9, 16), torch.randn(2, 3, 16)
    mask = torch.rand(2, 9) > 0.3
    mask[:, 0] = True  # an output that attends to nothing has no meaning
    cache = decoder.init_cache(prompt, torch.tensor([[True, True, True], [True, True, False]]))
    expected, _ = decoder(cache, tokens, mask)
    state, pieces = cache, []
    for start, stop in ((0, 1), (1, 5), (5, 9)):
        piece, state = decoder(state, tokens[:, start:stop], mask[:, start:stop])
        pieces.append(piece)
    torch.testing.assert_close(torch.cat(pieces, dim=1), expected)


def test_invalid_positions_are_zero_and_change_nothing(decoder) -> None:
    tokens, prompt = torch.randn(3, 6, 16), torch.randn(3, 2, 16)
    exist = torch.tensor([[True] * 6, [True] * 4 + [False] * 2, [True, False, True, True, False, False]])
    mask = exist.clone()
    mask[0, 5] = mask[1, 3] = False  # computed, but not attended to
    cache = decoder.init_cache(prompt, torch.ones(3, 2, dtype=torch.bool))
    expected, whole = decoder(cache, tokens, mask)
    actual, packed = decoder(cache, tokens, mask, exist)
    torch.testing.assert_close(actual[exist], expected[exist])
    assert not actual[~exist].any()
    later, mask = torch.randn(3, 2, 16), torch.ones(3, 2, dtype=torch.bool)
    torch.testing.assert_close(decoder(packed, later, mask)[0], decoder(whole, later, mask)[0])


def test_too_long_a_history_is_refused(decoder) -> None:
    tokens, prompt = torch.zeros(1, 513, 16), torch.zeros(1, 1, 16)
    mask = torch.ones(1, 513, dtype=torch.bool)
    length = 513 if isinstance(decoder, Decoder) else 515  # prompt and separator count there
    with pytest.raises(PolicyError, match=f"history has {length} tokens; this policy takes 512"):
        decoder(decoder.init_cache(prompt, mask[:, :1]), tokens, mask)


def test_masked_positions_do_not_count_towards_the_limit(decoder) -> None:
    tokens, mask = torch.zeros(1, 600, 16), torch.zeros(1, 600, dtype=torch.bool)
    mask[0, ::2] = True
    outputs, _ = decoder(decoder.init_cache(tokens[:, :1], mask[:, :1]), tokens, mask)
    assert outputs.isfinite().all()


@pytest.mark.parametrize("heads", [0, 3])
def test_heads_that_do_not_divide_the_width_are_named(heads) -> None:
    with pytest.raises(ConfigError, match=f"width 16 must be a multiple of its {heads} heads"):
        PrefixDecoderConfig(width=16, num_layers=1, num_heads=heads)
