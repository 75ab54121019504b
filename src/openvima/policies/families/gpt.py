"""VIMA-GPT: one token sums up a pair of frames, and the prompt is the beginning of the sequence.

[put, the, A, into, the, B, ., end, separator, frames, action, frames, action, …]
                                                    |
                                               1st action
"""

from openvima.policies.config import PolicyConfig
from openvima.policies.families.common import Size
from openvima.policies.families.frames import frame_transformer
from openvima.policies.nn.frame_encoder import FrameEncoderConfig


def gpt(size: Size) -> PolicyConfig:
    """Return VIMA-GPT in a size."""
    frame = frame_transformer(size, class_token=True)
    return size.member(FrameEncoderConfig(frame, "class"), size.prefix())
