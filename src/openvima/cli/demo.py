"""`openvima demo`: record a video of the oracle or of a policy on one task or on an episode from a file."""

from dataclasses import asdict, replace
from pathlib import Path

from openvima.cli.terminal import DEFAULT_ENVIRONMENT, Environment, Task
from openvima.data.chat_settings import DEFAULT_OPTIONS, ChatView, VlmOptions


def main(
    task: Task = None,
    *,
    episode: Path | None = None,
    out: Path = Path("demo.mp4"),
    seed: int = 0,
    level: str | None = None,
    policy: str = "oracle",
    device: str = "cpu",
    boxes: str | None = None,
    trust_code: bool = False,
    explain: bool = False,
    base_url: str | None = None,
    view: ChatView = "top",
    vlm: VlmOptions = DEFAULT_OPTIONS,
    environment: Environment = DEFAULT_ENVIRONMENT,
) -> None:
    """Record one episode: the prompt above, the table and the arm below.

    Example: openvima demo rotate --seed 3 --out rotate.mp4

    Args:
        task: Name of the task; `openvima tasks` lists them. Leave it out with --episode.
        episode: YAML or JSON file of an episode, sampled or composed (see docs/compose.md).
        out: MP4 file to write.
        seed: Number of the episode.
        level: train, L1 to L8; by default the task's first.
        policy: oracle, openvima-small or openvima-vima (bundled), random, untrained, untrained:PRESET (random
            weights), the folder of a training run, FILE.py:FUNCTION or MODULE:FUNCTION that makes a policy of
            your own, a published file, OWNER/NAME[@REVISION] on the Hub, a policy server (ws://HOST:PORT), or
            a vision-language model (vlm:MODEL), whose words are drawn beside the video.
        device: Where a network computes: cpu, in float64, or cuda, in float32.
        boxes: Use the boxes of a detector instead of the true ones: "detector" for the bundled one,
            detector=FOLDER for one that `openvima detector train` made, or MODULE:FUNCTION.
        trust_code: Run the code that a run folder names, as that of a learner of your own does.
        explain: Draw beside the video what the policy considers at each step: probabilities of objects,
            places and rotations, and attention to the prompt. See docs/explain.md for what explains itself.
        base_url: Address of the OpenAI-compatible server of a model vlm:MODEL, such as
            http://127.0.0.1:8000/v1; by default that of OPENAI_BASE_URL, else OpenAI's own.
        view: Camera that it sees, and in whose picture it points; top+front shows both.
        vlm: How it is asked.
        environment: Tasks, prompts and control.
    """
    from openvima.errors import ConfigError
    from openvima.tasks import task_spec

    if (task is None) == (episode is None):
        raise ConfigError("demo takes either a TASK or --episode FILE; `openvima tasks` lists the tasks.")
    of_file = replace(DEFAULT_ENVIRONMENT, assets=environment.assets, compat=environment.compat)
    if episode is not None and (seed, level, environment) != (0, None, of_file):
        raise ConfigError(
            "an episode file is played by primitives and says all of --seed, --level, --prompts and "
            "--task-options; leave these and --control out."
        )
    level = "" if task is None else task_spec(task).checked_level(level)  # before what takes a second to load
    if out.suffix.lower() != ".mp4":
        raise ConfigError(f"--out is {str(out)!r}; videos are MP4 files; give a name that ends in .mp4.")
    if boxes is not None and policy in ("oracle", "random"):
        raise ConfigError(f"--boxes is {boxes!r}, but {policy} uses no boxes; name a trained policy.")
    from openvima.catalog import load_assets
    from openvima.env import EnvConfig, load_episode
    from openvima.evaluation.recording import record_episode
    from openvima.evaluation.rollout_policies import load_own_rollout_policy
    from openvima.policies.naming import ORACLE, PolicyRef
    from openvima.scene import HOST_TASK
    from openvima.serving.chat import VlmConfig
    from openvima.tasks.oracle import require_goals
    from openvima.tasks.sampling import check_task_options

    env_config = EnvConfig(**asdict(environment))
    load_assets(env_config.assets)  # may register objects of the task that is sampled next
    if episode is not None:
        start = load_episode(episode, assets=env_config.assets)
        env = env_config.make(HOST_TASK, "train", domain="user", realtime=True)
        what, title = str(episode), episode.stem
        if policy == ORACLE:
            require_goals(start.problem)
    else:
        assert task is not None  # as checked
        start = seed
        check_task_options((task,), env_config.task_options)
        env = env_config.make(task, level, domain="user", realtime=True)
        what, title = f"{task}, seed {seed}", f"{task} · {level} · seed {seed}"
    explain = explain or PolicyRef.parse(policy).kind == "vlm"
    title = f"{title} · {Path(policy).name}"
    acts = load_own_rollout_policy(
        policy, boxes=boxes or "", trust_code=trust_code, device=device, vlm=VlmConfig(base_url, view, vlm)
    )
    outcome = record_episode(env, acts, start, out, title=title, explain=explain)
    ended = "solved" if outcome.success else f"not solved: {outcome.reason}"
    if not env.episode.problem.goals and not env.outcome.failure:
        ended = outcome.reason
    steps = f"{outcome.steps} step{'s' * (outcome.steps != 1)}"
    print(f"{out}: {what}, by {policy}: {ended}; {steps}")
