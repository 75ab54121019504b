"""What a prompt may hold, checked before any of it is encoded."""

from dataclasses import dataclass

from openvima.errors import PromptError
from openvima.scene import RenderedPrompt
from openvima.scene.prompt import PLACEHOLDER


@dataclass(frozen=True, slots=True)
class PromptLimits:
    """The largest prompt of a policy; a policy may state its own as `prompt_limits`.

    The prompts of the benchmark have up to 280 characters, 8 images and 20 objects.

    Args:
        chars: Characters of the text.
        images: Placeholders of the text, and images.
        objects: Objects of all images, hidden ones included.
    """

    chars: int = 4096
    images: int = 64
    objects: int = 256

    def check(self, prompt: RenderedPrompt) -> None:
        """Check a prompt.

        Raises:
            PromptError: It holds more than allowed; the message names the number.
        """
        found = {"chars": len(prompt.text), "images": 0, "objects": 0}
        if found["chars"] <= self.chars:
            found["images"] = max(len(prompt.images), len(PLACEHOLDER.findall(prompt.text)))
            found["objects"] = sum(len(image.objects) for image in prompt.images.values())
        for name, number in found.items():
            if number > (allowed := getattr(self, name)):
                what = "characters" if name == "chars" else name
                raise PromptError(f"the prompt has {number:,} {what}; this policy takes {allowed:,}.")
