"""Channels first and channels last."""

import numpy as np
import pytest

from openvima.render import channels_first, channels_last


@pytest.mark.parametrize("leading", [(), (5,), (2, 5)])
def test_the_layouts_differ_in_the_place_of_the_channels_alone(leading) -> None:
    images = np.arange(np.prod(leading, dtype=int) * 24).reshape(*leading, 3, 2, 4)
    last = channels_last(images)
    assert last.shape == (*leading, 2, 4, 3)
    assert np.array_equal(last[..., 1, 3, 2], images[..., 2, 1, 3])
    assert np.array_equal(channels_first(last), images)
    assert np.shares_memory(last, images)
