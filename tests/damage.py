"""Random accidents to the bytes of a file, for `damage_data.py` and the tests."""

import random
from collections.abc import Sequence

BLOCKS = (1, 8, 64, 512)  # bytes


def damaged(
    content: bytes, rng: random.Random, *, blocks: Sequence[int] = BLOCKS, cut_prob: float = 0.3
) -> bytes:
    """Return the content after one to five accidents: to bits, bytes, blocks, order or length.

    Args:
        content: What the file holds.
        rng: Source of the accidents.
        blocks: Sizes of damaged blocks, in bytes.
        cut_prob: How probable a cut that was drawn is made; it hides all other damage behind it.
    """
    result = bytearray(content)
    for _ in range(rng.choice((1, 1, 1, 2, 5))):
        place, other = rng.randrange(len(result)), rng.randrange(len(result))
        block = min(rng.choice(blocks), len(result) - max(place, other))
        accident = rng.choice(("bit", "byte", "noise", "zeros", "swap", "cut", "lose", "grow"))
        if accident == "bit":
            result[place] ^= 1 << rng.randrange(8)
        elif accident == "byte":
            result[place] = rng.choice((0, 127, 128, 255))
        elif accident == "noise":
            result[place : place + block] = rng.randbytes(block)
        elif accident == "zeros":
            result[place : place + block] = bytes(block)
        elif accident == "swap" and abs(place - other) >= block:
            first, second = result[place : place + block], result[other : other + block]
            result[place : place + block], result[other : other + block] = second, first
        elif accident == "cut" and rng.random() < cut_prob:
            del result[max(place, 1) :]
        elif accident == "lose" and len(result) > 2 * block:
            del result[place : place + block]
        elif accident == "grow":
            result[place:place] = rng.randbytes(block)
    return bytes(result)
