"""Sizes of the pointer models, `nano` and `small`."""

from dataclasses import dataclass
from typing import ClassVar

from openvima.policies.batch import InputLayout
from openvima.policies.nn.decoder import AnyDecoderConfig, DecoderConfig
from openvima.policies.nn.image_encoders import ConvConfig
from openvima.policies.nn.object_encoder import ObjectEncoderConfig
from openvima.policies.nn.prompt_encoder import PromptEncoderConfig, TextEncoderConfig
from openvima.policies.sizes import SIZES, VOCABULARY_SIZE

ATTRIBUTES = ("texture", "colour", "shape", "profile", "height", "size")
"""In what two objects may be alike, in the order of the projections."""


@dataclass(frozen=True, slots=True)
class ObjectHeadConfig:
    """Sizes of the head that points at objects in view, and weights of its losses.

    Args:
        hidden_width: Width of the hidden layers that predict offset and yaw.
        num_yaw_bins: Classes of the rotation between pick and place, over a full circle; bin 0 is none.
        offset_weight: Weight of the offset loss relative to the pointers'.
        yaw_weight: Weight of the yaw loss.
    """

    hidden_width: int = 128
    num_yaw_bins: int = 72
    offset_weight: float = 2.0
    yaw_weight: float = 0.5


@dataclass(frozen=True, slots=True)
class CandidateHeadConfig(ObjectHeadConfig):
    """Sizes of the head that points at place candidates, and weights of its losses.

    Args:
        hidden_width, num_yaw_bins, offset_weight, yaw_weight: As in `ObjectHeadConfig`.
        appearance_loss_weight: Weight of the losses of picking, and of placing at an object in view, by
            appearance alone. They train the attention to the prompt and the grounding of words; known objects
            can be found without, novel ones cannot.
        grounding_loss_weight: Weight of the loss of attending to the prompt object most similar to the picked
            one, where there is one.
        num_prompt_queries: Prompt objects that the pick attends to at once.
        num_index_embeddings: Prompt images, and steps, with an embedding of their index; later ones share the
            last.
    """

    appearance_loss_weight: float = 0.5
    grounding_loss_weight: float = 0.5
    num_prompt_queries: int = 2
    num_index_embeddings: int = 16


@dataclass(frozen=True, slots=True)
class CorrespondenceConfig:
    """Sizes of the attention between objects of two images.

    Args:
        hidden_width: Width of the hidden layer that reads the differences.
        num_heads: Objects that each object is compared with, such as the latest and the earliest similar one.
        within_view: Compare the objects in view with each other, too.
    """

    hidden_width: int = 192
    num_heads: int = 2
    within_view: bool = True


@dataclass(frozen=True, slots=True)
class AttributeConfig:
    """Sizes of the projections in which objects are compared by one attribute.

    Args:
        hidden_width: Width of the hidden layer.
        width: Length of a projection.
        exclusive: Whether objects are compared by nothing else where a prompt selects attributes: the decoder
            sees no sizes of boxes, and correspondence is that of the selected attributes, not of appearance.
    """

    hidden_width: int = 128
    width: int = 32
    exclusive: bool = False


@dataclass(frozen=True, slots=True)
class PointerConfig:
    """Sizes of a pointer model.

    Args:
        images: The object encoder, with fused views and an appearance embedding.
        prompt: The prompt encoder.
        decoder: The decoder.
        head: Where actions come from: objects in view, or place candidates.
        action_width: Width of the features of each part of a past action.
        correspondence: Attention between objects of different images; None for none.
        coreference: Words attend to the images that followed the same word before: "This is a wug {image}.
            Put the wug …"
        attributes: Comparison by the attributes that a prompt names: "the same texture as {image}".
            Contrastive pretraining fits them; None for none.
    """

    architecture: ClassVar[str] = "pointer"
    images: ObjectEncoderConfig
    prompt: PromptEncoderConfig
    decoder: AnyDecoderConfig
    head: ObjectHeadConfig | CandidateHeadConfig
    action_width: int = 64
    correspondence: CorrespondenceConfig | None = None
    coreference: bool = False
    attributes: AttributeConfig | None = None

    @property
    def inputs(self) -> InputLayout:
        """Input format: how images are tokenized."""
        return InputLayout("objects")


def nano() -> PointerConfig:
    """2.2 M parameters: trains on two cores within minutes."""
    images = ObjectEncoderConfig(
        ConvConfig(width=32, output_width=128),
        box_width=64,
        width=128,
        fuse_views=True,
        appearance_width=128,
        crop_dropout=0.5,
    )
    decoder = DecoderConfig(width=128, num_layers=2, num_self_heads=4, num_cross_heads=4)
    return PointerConfig(images, SIZES["nano"].prompt, decoder, ObjectHeadConfig())


def small() -> PointerConfig:
    """7.3 M parameters: place candidates, correspondence, coreference in the prompt, attributes."""
    text = TextEncoderConfig(width=192, num_layers=3, num_heads=6, head_width=32, hidden_width=384)
    images = ObjectEncoderConfig(
        ConvConfig(width=32, output_width=192, place_channels=32, last_kernel=1),
        box_width=64,
        width=192,
        fuse_views=True,
        appearance_width=128,
        crop_dropout=0.35,
        rotation_bins=72,
    )
    return PointerConfig(
        images,
        PromptEncoderConfig(text, image_width=192, vocabulary_size=VOCABULARY_SIZE),
        DecoderConfig(width=192, num_layers=3, num_self_heads=6, num_cross_heads=6, initial_std=0.05),
        CandidateHeadConfig(),
        correspondence=CorrespondenceConfig(),
        coreference=True,
        attributes=AttributeConfig(exclusive=True),
    )
