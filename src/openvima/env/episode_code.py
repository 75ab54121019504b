"""Episodes as arguments of `compose`, as Python and as a command: to change and to repeat them."""

import math
import shlex
from collections.abc import Mapping, Sequence
from pprint import pformat
from typing import Any  # arguments of `compose`

from openvima.catalog import object_spec
from openvima.env.composed_objects import FIXED_OBJECTS, SCALES
from openvima.env.composing import compose
from openvima.env.config import DEFAULT_ENV_CONFIG, EnvConfig
from openvima.env.episode_file import episode_values, yaml_text
from openvima.errors import OpenVimaError, SceneError
from openvima.scene import COMPOSED, AtPose, Episode, ObjectImage, PhotoImage, Placement, PromptFill

POLICY = "openvima-small"
_LETTERS = "abcdefghijklmnopqrstuvwxyz"
_DECIMALS = 6  # of positions and angles that `compose` was given, which come back exactly
_JOIN = ",\n    "


def compose_values(episode: Episode) -> dict[str, Any]:
    """Return the arguments of `compose` for an episode, to change one thing and play it again.

    Composed episodes come back exactly, but for handles that the prompt does not show, and photos, which stay
    `PhotoImage`. Of sampled ones the objects come back at their positions with the proportions of the
    catalogue, and the goals; constraints and stages have no composed form and are left out.

    Args:
        episode: A composed or sampled episode.

    Returns:
        `objects` by handle, `prompt`, `images`, `goals`, `max_steps` and `end_effector`.

    Raises:
        SceneError: A goal has no composed form.
    """
    problem = episode.problem
    placements, fills = problem.scene.placements, problem.prompt.images
    handles = _handles(placements, fills)
    images = {}
    for slot, fill in fills:
        shown = _shown(fill, placements)
        if shown is None:
            images[slot] = _image(fill)
        elif handles[shown] != slot:
            images[slot] = handles[shown]
    return {
        "objects": {handles[p.id]: _object(p) for p in placements},
        "prompt": problem.prompt.text,
        "images": images,
        "goals": [_goal(goal, episode, handles, number) for number, goal in enumerate(problem.goals)],
        "max_steps": episode.max_steps,
        "end_effector": problem.scene.end_effector,
    }


def python_code(episode: Episode, *, policy: str = POLICY, env_config: EnvConfig = DEFAULT_ENV_CONFIG) -> str:
    """Return a Python program that plays an episode.

    Args:
        episode: A sampled or composed episode.
        policy: Name of the policy.
        env_config: Settings that it was sampled with.
    """
    assets = "" if env_config.assets == "procedural" else f", assets={env_config.assets!r}"
    if _is_sampled(episode, env_config):
        config = {"assets": env_config.assets, "compat": env_config.compat, "prompts": env_config.prompts}
        published = {"assets": "procedural", "compat": False, "prompts": "multimodal"}
        options = {"level": episode.level, "seed": episode.seed, "domain": episode.domain}
        options |= {name: value for name, value in config.items() if value != published[name]}
        options |= env_config.options(episode.task)
        arguments = ", ".join([repr(episode.task), *(f"{name}={value!r}" for name, value in options.items())])
        head = "import openvima\nfrom openvima.tasks import sample_episode\n"
        made = f"sample_episode({arguments})"
    elif values := _repeatable(episode, env_config):
        given = {name: value for name, value in values.items() if name not in ("objects", "prompt") and value}
        lines = [_formatted(values["objects"]), repr(values["prompt"])]
        lines += [f"{name}={_formatted(value)}" for name, value in given.items()]
        lines += [assets[2:]] if assets else []
        head, made = "import openvima\n", f"openvima.compose(\n    {_JOIN.join(lines)},\n)"
    else:
        head = "import openvima\nfrom openvima.env.episode_file import episode_from_values\n"
        made = f"episode_from_values(\n    {_formatted(episode_values(episode))}\n)"
    compat = ", compat=True" if env_config.compat else ""
    played = f"result = openvima.play(episode, {policy!r}{assets}{compat})\nprint(result.outcome)\n"
    return f"{head}\nepisode = {made}\n{played}"


def shell_command(
    episode: Episode, *, policy: str = POLICY, env_config: EnvConfig = DEFAULT_ENV_CONFIG
) -> str:
    """Return a shell command that records a video of an episode, and writes the episode to a file if need be.

    Args:
        episode: A sampled or composed episode.
        policy: Name of the policy.
        env_config: Settings that it was sampled with.
    """
    options = ["--policy", policy]
    if env_config.assets != "procedural":
        options += ["--assets", env_config.assets]
    options += ["--compat"] if env_config.compat else []
    if episode.domain == "user" and _is_sampled(episode, env_config):
        options += [] if env_config.prompts == "multimodal" else ["--prompts", env_config.prompts]
        options += ["--task-options", env_config.task_options] if env_config.task_options else []
        start = [episode.task, "--level", episode.level, "--seed", str(episode.seed)]
        return shlex.join(["openvima", "demo", *start, *options, "--out", f"{episode.task}.mp4"]) + "\n"
    values = _repeatable(episode, env_config)
    text = yaml_text(episode_values(episode) if values is None else _plain(values))
    command = ["openvima", "demo", "--episode", "episode.yaml", *options, "--out", "episode.mp4"]
    return f"cat > episode.yaml <<'END'\n{text}END\n{shlex.join(command)}\n"


def _is_sampled(episode: Episode, env_config: EnvConfig) -> bool:
    """Whether the task samples the episode for its seed."""
    if episode.task == COMPOSED:
        return False
    try:
        return episode == env_config.sample(episode.task, episode.level, episode.seed, domain=episode.domain)
    except OpenVimaError:
        return False


def _repeatable(episode: Episode, env_config: EnvConfig) -> dict[str, Any] | None:
    """Return arguments of `compose` that give this very episode, if any in plain values do."""
    try:
        values = compose_values(episode)
        is_same = compose(**values, assets=env_config.assets) == episode
    except OpenVimaError:
        return None
    has_photo = any(isinstance(image, PhotoImage) for image in values["images"].values())
    return values if is_same and not has_photo else None


def _plain(value: Any) -> Any:
    """Return arguments of `compose` as a file holds them, without empty ones."""
    if isinstance(value, Mapping):
        return {key: _plain(entry) for key, entry in value.items() if entry not in ({}, [])}
    return [_plain(entry) for entry in value] if isinstance(value, tuple | list) else value


def _formatted(value: Any) -> str:
    return pformat(value, width=100, sort_dicts=False).replace("\n", "\n    ")


def _handles(placements: Sequence[Placement], fills: Sequence[tuple[str, PromptFill]]) -> dict[int, str]:
    """Name each object: by the first placeholder that shows it, or by a letter."""
    names: dict[int, str] = {}
    for slot, fill in fills:
        shown = _shown(fill, placements)
        if shown is not None:
            names.setdefault(shown, slot)
    slots = {slot for slot, _ in fills}
    labels = [*_LETTERS, *(f"object{n}" for n in range(len(_LETTERS), len(_LETTERS) + len(placements)))]
    free = iter([label for label in labels if label not in slots])
    return {p.id: names.get(p.id) or next(free) for p in placements}


def _shown(fill: PromptFill, placements: Sequence[Placement]) -> int | None:
    """Id of the object of the scene that an image shows."""
    if not isinstance(fill, ObjectImage):
        return None
    key = fill.placement.id, fill.placement.object, fill.placement.texture
    return next((p.id for p in placements if (p.id, p.object, p.texture) == key), None)


def _image(fill: PromptFill) -> Any:
    if isinstance(fill, ObjectImage):
        return fill.placement.object, fill.placement.texture
    return fill if isinstance(fill, PhotoImage) else [_object(p) for p in fill.scene.placements]


def _object(placement: Placement) -> Any:
    """An object as `compose` takes it, in its short form if that says all."""
    spec, pose = object_spec(placement.object), placement.pose
    position = round(pose.x, _DECIMALS), round(pose.y, _DECIMALS)
    yaw_deg = round(math.degrees(pose.yaw_rad), _DECIMALS)
    sizes = zip(placement.size, placement.scale, spec.size_max, strict=True)
    factors = [size * scale / largest for size, scale, largest in sizes if largest]  # some are flat
    scale = round(min(max(sum(factors) / len(factors), SCALES[0]), SCALES[1]), 3)
    extra: dict[str, Any] = {} if scale == 1 else {"scale": scale}
    if placement.fixed != (placement.object in FIXED_OBJECTS or spec.container):
        extra["fixed"] = placement.fixed
    if extra:
        named = {"object": placement.object, "texture": placement.texture, "position": position}
        return {**named, "yaw_deg": yaw_deg, **extra}
    heading = (yaw_deg,) if yaw_deg else ()
    return placement.object, placement.texture, position, *heading


def _goal(goal: object, episode: Episode, handles: Mapping[int, str], number: int) -> tuple[Any, ...]:
    """A goal by name."""
    scene = episode.problem.scene
    object_id, relative_to = getattr(goal, "object_id", None), getattr(goal, "relative_to", None)
    if object_id is None or object_id not in handles or not hasattr(goal, "relative_to"):
        raise SceneError(f"goal {number} is a {type(goal).__name__}, which has no composed form.")
    if not isinstance(goal, AtPose):
        if relative_to is None:
            raise SceneError(f"goal {number} has a zone that is no object's, which has no composed form.")
        return "swept_into", handles[object_id], handles[relative_to]
    if relative_to == object_id:
        turn_deg = math.degrees(scene[object_id].pose.yaw_rad - goal.target.yaw_rad)
        return "rotated", handles[object_id], round(math.remainder(turn_deg, 360), _DECIMALS)
    if relative_to is not None:
        return "in", handles[object_id], handles[relative_to]
    position = round(goal.target.x, _DECIMALS), round(goal.target.y, _DECIMALS)
    is_turned = goal.tolerance.yaw_rad is not None
    heading = (round(math.degrees(goal.target.yaw_rad), _DECIMALS),) if is_turned else ()
    return "at", handles[object_id], position, *heading
