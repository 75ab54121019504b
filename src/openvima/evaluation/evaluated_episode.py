"""One episode of an evaluation, with the exact settings to play it again live."""

from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from openvima.errors import DatasetError, OpenVimaError, PolicyError, brief_repr, echo
from openvima.evaluation.actions import ACTIONS_NAME, ActionReplay, read_actions
from openvima.evaluation.config import Batch
from openvima.evaluation.results import EpisodeOutcome, Results
from openvima.evaluation.rollout_policies import RolloutPolicy, load_own_rollout_policy
from openvima.evaluation.sources import NAMED_POLICIES, PolicySource, weights_hash
from openvima.evaluation.verification import recorded_config
from openvima.policies.naming import BUNDLED, CHECKPOINTS_FOLDER, UNTRAINED
from openvima.policies.presets import PRESETS
from openvima.scene import Episode
from openvima.scene.action import PRIMITIVES
from openvima.user_code import is_code

_SEED_DOMAIN = "eval"


@dataclass(frozen=True, slots=True)
class EvaluatedEpisode:
    """An episode of an evaluation.

    Args:
        batch: Policy, task, level, seed and all settings that decide the episode.
        outcome: How it ended.
        actions: The recorded actions, shape (steps, 12), float32; None if the evaluation kept none.
    """

    batch: Batch
    outcome: EpisodeOutcome
    actions: np.ndarray | None = field(repr=False)

    __repr__ = brief_repr

    def __str__(self) -> str:
        ended = "solved" if self.outcome.success else f"not solved: {self.outcome.reason}"
        steps = f"{self.outcome.steps} step{'s' * (self.outcome.steps != 1)}"
        return f"{self.batch.task}, {self.batch.level}, seed {self.outcome.seed}: {ended} ({steps})"

    def sample(self) -> Episode:
        """Sample the episode."""
        batch = self.batch
        return batch.env_config.sample(batch.task, batch.level, batch.first_seed, domain=_SEED_DOMAIN)

    def load_policy(self) -> RolloutPolicy:
        """Load the policy, with its input ablation, detector and precision; no other episode shares it.

        Raises:
            PolicyError: Nobody knows where the policy is, or the detector is code, which is not trusted.
            UnknownPolicyError, InputFileError, ServerError: As for `load_own_rollout_policy`.
        """
        if not self.batch.source:
            raise PolicyError(
                f"no folder near the results has the weights of {self.batch.policy!r}; name its run folder. "
                "The recorded actions can be played without."
            )
        if is_code(self.batch.boxes) and not self.batch.trust_code:
            raise PolicyError(
                f"the results name code as their detector, boxes {echo(repr(self.batch.boxes))}; if you "
                "trust it, allow it with --trust-code. The recorded actions can be played without."
            )
        batch = self.batch
        return load_own_rollout_policy(
            batch.source,
            ablation=batch.ablation,
            name=batch.policy,
            boxes=batch.boxes,
            trust_code=batch.trust_code,
            device=batch.device,
            precision=batch.precision,
        )

    def recorded_policy(self) -> RolloutPolicy:
        """Return what repeats the recorded actions, without the policy.

        Raises:
            PolicyError: The evaluation kept none.
        """
        if self.actions is None:
            raise PolicyError("the evaluation kept no actions; name the policy's weights to play it again.")
        return ActionReplay([self.actions])


def evaluated_episode(
    folder: str | Path,
    policy: str,
    task: str,
    level: str,
    seed: int,
    *,
    ablation: str = "",
    source: str | None = None,
    trust_code: bool = False,
) -> EvaluatedEpisode:
    """Return an episode of an evaluation and the settings to play it again.

    Args:
        folder: Folder of the evaluation, with `results.json`.
        policy: Name of the policy in the results.
        task: Name of the task.
        level: Level of the episode.
        seed: Seed of the episode.
        ablation: Input ablation; empty for the plain score.
        source: Where the policy is, as for `openvima evaluate --policy`; None: as `find_source` finds it.
        trust_code: Run the code that a run folder names.

    Raises:
        DatasetError: There are no such results.
        AssetError: The results name a function as their assets, which is not run.
    """
    folder = Path(folder)
    results = Results.read(folder)
    row = results.row(policy, task, level, ablation)
    assert row is not None  # chosen among those that there are, as the seed
    place = [outcome.seed for outcome in row.outcomes].index(seed)
    if (control := results.config.get("control", PRIMITIVES)) != PRIMITIVES:
        raise DatasetError(f"{folder} has control {echo(str(control))}; only primitives are shown.")
    source = (find_source(folder, results, policy) or "") if source is None else source
    config = replace(recorded_config(results), trust_code=trust_code)
    batch = config.batch_of(PolicySource(policy, source), ablation, task, level, seed, 1)
    recorded, actions = folder if folder.is_dir() else folder.parent, None
    if (recorded / ACTIONS_NAME).is_file():
        actions = read_actions(recorded, results.rows)[0][results.rows.index(row)][place]
    return EvaluatedEpisode(batch, row.outcomes[place], actions)


def find_source(folder: Path, results: Results, policy: str) -> str | None:
    """Find the policy that was evaluated: by name where the package has it, else by the hash of its weights.

    Args:
        folder: Folder of the evaluation; folders in and beside it are searched for a training run.
        results: Its results.
        policy: Name of the policy in the results.

    Returns:
        As for `openvima evaluate --policy`; None if it is not found.
    """
    what = results.policies.get(policy, {})
    for key, known, start in (("bundled", BUNDLED, ""), ("preset", PRESETS, f"{UNTRAINED}:")):
        named = what.get(key)
        if isinstance(named, str) and named in known:  # any other name could be that of code, which would run
            return start + named
    if "preset" in what:  # of another version
        return None
    kind, sha256 = what.get("kind"), what.get("sha256")
    if kind in NAMED_POLICIES:
        return str(kind)
    if kind != "run" or not sha256:
        return None
    folder = folder.resolve()
    for place in (folder, folder.parent):
        for run in sorted(path.parent for path in place.glob(f"*/{CHECKPOINTS_FOLDER}")):
            with suppress(OpenVimaError, OSError):
                if weights_hash(run) == sha256:
                    return str(run)
    return None
