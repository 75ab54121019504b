"""What limits a policy: nearest appearance, attributes that separate, and success with forced choices.

    python benchmarks/bounds.py --policy RUN [--tasks T,…] [--levels L3,…] [--episodes N] [--forced N]
                                [--ways W,…] [--attribute NAME] [--seed S] [--assets PACK] [--json FILE]

At the start of each episode, for policies with an appearance embedding:

- `appearance`: all prompt images of objects on the table are nearest to the right object, that is one of the
  same shape, texture and scale; gray images count by shape. `images` is the same over single images.
- `texture`, `profile`: in `same_texture` and `same_shape`, all right objects are more similar to the base in
  that attribute than all wrong ones. Policies without attributes are measured by appearance.

Played, with `--forced N`, on the first N episodes, in each of `--ways`: `free`, the policy's own choices;
`picks`, objects that no open goal is about are excluded from the picks; `places`, objects in view that the
picked object's goal is not relative to, and all other places, are excluded from the places, if the goal is
relative to one; both; and `guess`, which reads no prompt: any object that can be moved goes to any that
cannot, without rotation.

Intervals are Wilson's at 95 %. `confused` lists what was wanted, and what was nearer.
"""

import argparse
import json
import os
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from operator import attrgetter, itemgetter
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import torch

from openvima.catalog.packs import load_assets
from openvima.catalog.textures import NEUTRAL_TEXTURE
from openvima.env import TabletopEnv
from openvima.env.config import EnvConfig
from openvima.evaluation.rollout import play
from openvima.evaluation.rollout_policies import PromptedRolloutPolicy
from openvima.evaluation.statistics import wilson_interval
from openvima.perception.objects import ObjectViews, extract_objects, observe_prompt_image
from openvima.perception.preprocessing import extract_observation
from openvima.policies.inference import NetworkPolicy
from openvima.policies.loading import load_policy
from openvima.policies.nn.actions import DecodingStrategy
from openvima.policies.pointer.config import ATTRIBUTES
from openvima.policies.pointer.model import Pointer
from openvima.render.rasteriser import Rasteriser
from openvima.scene import Episode, InOrder, ObjectImage, Placement, SceneImage
from openvima.scene.goal import object_of
from openvima.tasks import sample_episode, task_spec
from sim import circumstances

TASKS = (
    "same_shape,same_texture,pick_in_order_then_restore,visual_manipulation,scene_understanding,novel_noun"
)
COMPARED = {"same_texture": "texture", "same_shape": "profile"}
GUESS = "guess"
FORCED = ("free", "picks", "places", "picks+places", GUESS)
NUM_CONFUSED = 12  # most frequent ones that are listed
BATCH = 10  # episodes that are played together

Row = dict[str, Any]  # JSON
Answer = tuple[bool, str, str]  # whether it is right, what was wanted, what was found


class Embedding:
    """Embeds the objects of images, by appearance or by one attribute if the network has attributes."""

    def __init__(self, network: Pointer, attribute: str | None = None) -> None:
        self._network, self._attributes = network, network.attributes
        self.name = attribute if attribute and self._attributes is not None else "appearance"

    @torch.inference_mode()
    def __call__(self, views: ObjectViews) -> torch.Tensor:
        """Return unit vectors, shape (N, A)."""
        features_VNF = self._network.encode_images(torch.from_numpy(views.crops))
        masks_VN = torch.from_numpy(views.masks)
        boxes_VN4 = torch.from_numpy(views.boxes)
        if self.name == "appearance":
            return self._network.embed_appearance(features_VNF, boxes_VN4, masks_VN)
        assert self._attributes is not None
        projected_NPW = self._attributes(features_VNF, boxes_VN4, masks_VN)
        return projected_NPW[:, ATTRIBUTES.index(self.name)]


def in_scene(episode: Episode, rasteriser: Rasteriser) -> tuple[list[Placement], ObjectViews]:
    """Return the visible objects of an episode's first scene, and their views."""
    placements, images = episode.problem.scene.placements, rasteriser.scene(episode.problem.scene)
    views = extract_objects(
        {name: image.rgb for name, image in images.items()},
        {name: image.segm for name, image in images.items()},
        [placement.id for placement in placements],
    )
    return [placements[slot] for slot in np.flatnonzero(views.visible())], views.select(views.visible())


def in_prompt(episode: Episode, rasteriser: Rasteriser) -> tuple[list[Placement], ObjectViews]:
    """Return the visible objects of an episode's prompt images, and their views."""
    prompt, placements, views = episode.problem.prompt, [], []
    rendered = rasteriser.prompt(prompt)
    for name, fill in prompt.images:
        seen = observe_prompt_image(rendered.images[name])
        if isinstance(fill, ObjectImage):
            placements += [fill.placement] * len(seen)
        elif isinstance(fill, SceneImage):
            placements += [fill.scene[object_id] for object_id in seen.ids.tolist()]
        views.append(seen)
    return placements, ObjectViews.concatenate(views)


def nearest(
    shown: Sequence[Placement], objects: Sequence[Placement], similarity_MN: torch.Tensor
) -> list[Answer]:
    """For each prompt image of an object on the table: whether the nearest object is right, and both names.

    Args:
        shown: The M objects of prompt images.
        objects: The N objects on the table.
        similarity_MN: How similar they are.
    """
    answers = []
    for wanted, similarity_N in zip(shown, similarity_MN, strict=True):
        if any(is_alike(wanted, each) for each in objects):
            found = objects[int(similarity_N.argmax())]
            names = (f"{each.texture} {each.object}" for each in (wanted, found))
            answers.append((is_alike(wanted, found), *names))
    return answers


def is_alike(wanted: Placement, other: Placement) -> bool:
    """Whether an object is what a prompt image shows: gray ones show a shape."""
    is_same = (wanted.texture, wanted.scale) == (other.texture, other.scale)
    return wanted.object == other.object and (is_same or wanted.texture == NEUTRAL_TEXTURE)


def separated(
    base: Placement,
    goals: set[int | None],
    objects: Sequence[Placement],
    similarity_N: torch.Tensor,
    attribute: str,
) -> list[Answer]:
    """Whether all right objects resemble the base more than all wrong ones; the least right, the most wrong.

    Args:
        base: What they are compared with.
        goals: Ids of the right objects.
        objects: The N objects on the table.
        similarity_N: How similar they are to it.
        attribute: "texture" or "profile", which decides what names the answer has.
    """
    scored = [(s, p) for s, p in zip(similarity_N.tolist(), objects, strict=True) if not p.fixed]
    least = min((each for each in scored if each[1].id in goals), key=itemgetter(0))
    most = max((each for each in scored if each[1].id not in goals), key=itemgetter(0))
    key = attrgetter("texture" if attribute == "texture" else "object")
    return [(least[0] > most[0], f"{key(base)}: {key(least[1])}", key(most[1]))]


def start_row(
    network: Pointer,
    task: str,
    level: str,
    seeds: Iterable[int],
    assets: str,
    compared_in: str | None = None,
) -> Row:
    """Measure the starts of episodes of one task and level, in an attribute or in what the task asks for."""
    pack = load_assets(assets)
    rasteriser, attribute = Rasteriser(pack), COMPARED.get(task)
    embed, found = Embedding(network, compared_in or attribute), []
    for seed in seeds:
        episode = sample_episode(task, level=level, seed=seed, domain="eval", assets=pack)
        (objects, views), (shown, images) = in_scene(episode, rasteriser), in_prompt(episode, rasteriser)
        similarity_MN = embed(images) @ embed(views).mT
        if attribute is None:
            found.append(nearest(shown, objects, similarity_MN))
        else:
            goals = {object_of(goal) for goal in episode.problem.goals}
            found.append(separated(shown[0], goals, objects, similarity_MN[0], attribute))
    answers = [answer for each in found for answer in each]
    confused = Counter(f"{wanted} < {nearer}" for is_right, wanted, nearer in answers if not is_right)
    return {
        **row_of(task, level, embed.name, [all(is_right for is_right, *_ in each) for each in found if each]),
        "images": sum(is_right for is_right, *_ in answers) / max(1, len(answers)),
        "confused": dict(confused.most_common(NUM_CONFUSED)),
    }


class ForcedPolicy(PromptedRolloutPolicy):
    """Plays a policy whose picks or places are restricted to the right ones, or guessed.

    Args:
        policy: Its network points at objects, then at place candidates, of which those in view come first.
        force: One of `FORCED`.
        generator: Draws the guesses.
    """

    def __init__(self, policy: NetworkPolicy, force: str, generator: torch.Generator) -> None:
        super().__init__(policy)
        self._network_policy, self._force, self._generator = policy, force, generator
        self._running: list[tuple[TabletopEnv, list[int]]] = []

    def decide(self, observations: Sequence[Mapping | None]) -> Sequence[Any]:
        """Let the policy act on what is allowed."""
        processor, network = self._network_policy.processor, self._network_policy.network
        self._running = [
            (env, extract_observation(seen, processor.input_kind, processor.extractor).ids.tolist())
            for env, seen in zip(self._envs, observations, strict=True)
            if seen is not None
        ]
        decode_step: Any = network.decode_step

        def restricted(*inputs: Any) -> Any:
            return decode_step(*inputs[:-1], self._restricted(inputs[-1]))

        network.decode_step = restricted  # type: ignore[method-assign]
        try:
            return super().decide(observations)
        finally:
            del network.decode_step

    def _restricted(self, strategy: DecodingStrategy) -> DecodingStrategy:
        choices: list[list[int]] = []  # slots that were picked, places, bins of rotations

        def choose(logits_BTX: torch.Tensor) -> torch.Tensor:
            least = torch.finfo(logits_BTX.dtype).min
            allowed_BTX = torch.zeros_like(logits_BTX, dtype=torch.bool)
            for row, (env, ids) in enumerate(self._running if len(choices) < 2 else ()):
                allowed_BTX[row, :, self._allowed(env, ids, choices[0][row] if choices else None)] = True
            allowed_BTX |= ~allowed_BTX.any(dim=-1, keepdim=True)
            if self._force == GUESS and len(choices) < 2:
                guessed_BTX = torch.rand(logits_BTX.shape, generator=self._generator, dtype=logits_BTX.dtype)
                logits_BTX = guessed_BTX.masked_fill(logits_BTX <= least / 2, least)  # what is not there
            elif self._force == GUESS:
                num_bins = logits_BTX.shape[-1]
                logits_BTX = -torch.arange(num_bins, dtype=logits_BTX.dtype).expand_as(logits_BTX)  # none
            choice = strategy(logits_BTX.masked_fill(~allowed_BTX, least))
            choices.append(choice[:, 0].tolist())
            return choice

        return choose

    def _allowed(self, env: TabletopEnv, ids: list[int], picked_slot: int | None) -> list[int]:
        """Slots of the right objects to pick, or of the right place for the picked one; empty for any."""
        problem, open_goals = env.episode.problem, env.progress.open_goals
        waiting = {index for c in problem.constraints if isinstance(c, InOrder) for index in c.goals}
        stage = problem.stage_of(open_goals[0])
        goals = [
            problem.goals[n] for n in open_goals if n == open_goals[0] or (n in stage and n not in waiting)
        ]
        if self._force == GUESS:
            is_place = picked_slot is not None
            right = {each.id for each in problem.scene.placements if each.fixed == is_place}
        elif picked_slot is None:
            right = {object_of(goal) for goal in goals} if "picks" in self._force else set()
        else:
            mine = [goal for goal in goals if object_of(goal) == ids[picked_slot]]
            right = (
                {getattr(goal, "relative_to", None) for goal in mine} if "places" in self._force else set()
            )
        return [slot for slot, object_id in enumerate(ids) if object_id in right]


def forced_rows(
    policy: NetworkPolicy, task: str, level: str, seeds: Sequence[int], assets: str, ways: Sequence[str]
) -> list[Row]:
    """Play episodes of one task and level, freely and with forced choices."""
    rows = []
    for force in ways:
        outcomes = []
        for first in range(0, len(seeds), BATCH):
            part = seeds[first : first + BATCH]
            envs = [EnvConfig(assets=assets).make(task, level, domain="eval") for _ in part]
            generator = torch.Generator().manual_seed(first)
            outcomes += play(envs, part, ForcedPolicy(policy, force, generator))
        rows.append(row_of(task, level, force, [outcome.success for outcome in outcomes]))
    return rows


def row_of(task: str, level: str, measure: str, is_right: Sequence[bool]) -> Row:
    """Return a rate with its interval."""
    interval = wilson_interval(sum(is_right), len(is_right)) if is_right else (0.0, 1.0)
    return {
        "task": task,
        "level": level,
        "measure": measure,
        "episodes": len(is_right),
        "right": sum(is_right),
        "interval": list(interval),
    }


def main() -> None:
    """Measure one policy and print the rows."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--policy", required=True, help="run folder, checkpoint or bundled policy")
    parser.add_argument("--tasks", default=TASKS, help="names with commas in between")
    parser.add_argument("--levels", default="L1,L2,L3,L4")
    parser.add_argument("--episodes", type=int, default=100, help="starts of each task and level")
    parser.add_argument("--forced", type=int, default=0, help="episodes to play in each way")
    parser.add_argument("--ways", default=",".join(FORCED), help="ways of choosing, with commas in between")
    parser.add_argument("--attribute", choices=ATTRIBUTES, help="compare in it, whatever the task asks for")
    parser.add_argument("--seed", type=int, default=60000, help="first episode")
    parser.add_argument("--assets", default="procedural", help="as of `openvima evaluate`")
    parser.add_argument("--json", type=Path, help="file to write")
    arguments = parser.parse_args()
    policy = load_policy(arguments.policy, dtype=torch.float32)
    if not isinstance(policy, NetworkPolicy) or not isinstance(policy.network, Pointer):
        parser.error(f"--policy is {arguments.policy}; it must be a pointer network, such as nano or small")
    ways = arguments.ways.split(",")
    if unknown := set(ways) - set(FORCED):
        parser.error(f"--ways names {', '.join(sorted(unknown))}; allowed: {', '.join(FORCED)}")
    seeds = range(arguments.seed, arguments.seed + arguments.episodes)
    rows: list[Row] = []
    for task in arguments.tasks.split(","):
        for level in sorted(set(arguments.levels.split(",")) & set(task_spec(task).levels)):
            new = [start_row(policy.network, task, level, seeds, arguments.assets, arguments.attribute)]
            if arguments.forced:
                new += forced_rows(policy, task, level, seeds[: arguments.forced], arguments.assets, ways)
            for row in new:
                low, high = (100 * end for end in row["interval"])
                rate = 100 * row["right"] / max(1, row["episodes"])
                print(
                    f"{task:<27}{level:<4}{row['measure']:<13}{rate:>6.1f} ({low:.0f} to {high:.0f})", end=""
                )
                print(
                    f"  {', '.join(f'{k} {v}' for k, v in list(row.get('confused', {}).items())[:3])}",
                    flush=True,
                )
            rows += new
            if arguments.json:
                settings = {name: str(value) for name, value in vars(arguments).items() if name != "json"}
                record = {**circumstances(), "settings": settings, "rows": rows}
                arguments.json.write_text(json.dumps(record, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
