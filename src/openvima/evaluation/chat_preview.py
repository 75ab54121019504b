"""What an evaluation would ask a vision-language model: its first message as a page, and what it costs."""

from collections.abc import Sequence
from io import BytesIO
from pathlib import Path

from PIL import Image

from openvima.atomic_io import atomic_write_file
from openvima.data.chat import Tokens, Turn, family_of
from openvima.data.records import rollout_oracle
from openvima.detector.plugins import plugged_extractor
from openvima.errors import ConfigError
from openvima.evaluation.chat import shot_turns
from openvima.evaluation.config import EvaluationConfig, cells
from openvima.html import render_page
from openvima.perception.objects import GROUND_TRUTH
from openvima.serving.chat import SEGMENTATION

PAGE_NAME = "first_message.html"
_CHARACTERS_PER_TOKEN = 4


def write_preview(config: EvaluationConfig) -> tuple[Path, str]:
    """Write the first message of the first vision-language model as a page; no server is asked.

    Args:
        config: The evaluation.

    Returns:
        The page in `config.out`, and an estimate for that model.

    Raises:
        ConfigError: No policy is vlm:MODEL.
    """
    models = [source.ref.model for source in config.sources if source.kind == "vlm"]
    if not models:
        raise ConfigError("a dry run shows what a vision-language model is asked; name a policy vlm:MODEL.")
    form, tokens = config.vlm.format_of(models[0]), family_of(models[0]).image_tokens
    boxes, shots = config.vlm.options.boxes, config.vlm.options.shots
    extractor = GROUND_TRUTH if boxes == SEGMENTATION else plugged_extractor(boxes) if boxes else None
    first: tuple[Turn, ...] = ()
    requests = image_tokens = text_tokens = 0
    for task, level in cells(config):
        env = config.env_config.make(task, level, domain="eval")
        observation, _ = env.reset(seed=config.seed)
        begin = (
            *shot_turns(env, shots, form, extractor),
            form.first_turn(env.prompt, observation, extractor),
        )
        first = first or begin
        steps = len(rollout_oracle(env, config.seed).actions)
        later = steps * (steps - 1) // 2  # messages after the first, in all requests of an episode
        images, text = _count(begin, tokens)
        more_images, more_text = _count([form.next_turn(observation, extractor)], tokens)
        requests += config.episodes * steps
        image_tokens += config.episodes * (steps * images + later * more_images)
        text_tokens += config.episodes * (steps * text + later * more_text)
    estimate = (
        f"{requests:,} requests, {image_tokens:,} tokens of images and {text_tokens:,} of text, if episodes "
        "take as many steps as the oracle; failures take more, and answers come on top"
    )
    page = render_page("chat", model=models[0], turns=first, estimate=estimate, points=form.points)
    return atomic_write_file(config.out / PAGE_NAME, page), estimate


def _count(turns: Sequence[Turn], tokens: Tokens) -> tuple[int, int]:
    """Return the tokens of the images and of the text."""
    parts = [part for turn in turns for part in turn.parts]
    sizes = [Image.open(BytesIO(part)).size for part in parts if isinstance(part, bytes)]
    images = sum(tokens(width, height) for width, height in sizes)
    return images, sum(len(part) for part in parts if isinstance(part, str)) // _CHARACTERS_PER_TOKEN
