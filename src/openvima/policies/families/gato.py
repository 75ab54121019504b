"""VIMA-Gato: every patch of a frame is a token, and the prompt is the beginning of the sequence.

[put, the, 16 patches, into, the, 16 patches, ., end, separator, 16 patches, action, 16 patches, …]
                                                                          |
                                                                     1st action
"""

from openvima.policies.config import PolicyConfig
from openvima.policies.families.common import Size
from openvima.policies.families.frames import frame_transformer
from openvima.policies.nn.frame_encoder import FrameEncoderConfig


def gato(size: Size) -> PolicyConfig:
    """Return VIMA-Gato in a size."""
    frame = frame_transformer(size, class_token=False)
    return size.member(FrameEncoderConfig(frame, "patches"), size.prefix())
