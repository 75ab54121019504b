"""`openvima evaluate`: score policies on levels."""

import json
import sys
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from tyro.conf import OmitArgPrefixes

from openvima.cli.terminal import (
    DEFAULT_ENVIRONMENT,
    Environment,
    Json,
    parse_list,
    parse_shard_range,
    print_left_out,
    print_table,
    progress_bar,
    rich_table,
)
from openvima.data.chat_settings import DEFAULT_OPTIONS, ChatView, VlmOptions

if TYPE_CHECKING:
    from openvima.evaluation import Results


@dataclass(frozen=True, slots=True)
class AblationOptions:
    """Input ablations.

    Args:
        ablations: Input ablations to evaluate besides, comma-separated. "all" stands for no_prompt,
            other_prompt_images, scrambled_words, shuffled_objects, random, oracle, and with --boxes
            detected_boxes. Others: held_out_phrasings, swapped_attribute, shuffled_prompt_objects,
            masked_words:0.2, swapped_words:0.2, gibberish_words, noisy_boxes:3, text_prompts,
            paraphrased_prompts, num_distractors:2 (the numbers are examples), in_context, and
            oracle_demonstration. "+" joins several to one. docs/evaluation.md describes each.
        in_context: In-context evaluation: also prompt with an example, "Follow this motion: …". For twist,
            follow_motion and follow_order, of policies trained without these tasks.
        boxes: Detector of detected_boxes, which it implies: "detector" for the bundled one,
            detector=FOLDER for one that `openvima detector train` made, or MODULE:FUNCTION or
            FILE.py:FUNCTION, which makes an ObjectExtractor.
    """

    ablations: str = ""
    in_context: bool = False
    boxes: str | None = None


@dataclass(frozen=True, slots=True)
class RecordingOptions:
    """Report and videos.

    Args:
        videos: Solved episodes to record, and failures, of each trained policy, task and level; failures
            first, at most 40 times as many in all, after the table is printed. 0 records none.
        record_video: Further episodes to record, of every policy, comma-separated: TASK/SEED or
            TASK/LEVEL/SEED.
        report: Whether to record videos and write report.html.
    """

    videos: int = 1
    record_video: str = ""
    report: bool = True


@dataclass(frozen=True, slots=True)
class NetworkOptions:
    """Where and how networks compute.

    Args:
        batch: Episodes that are run together, with batched inference.
        device: Where networks compute: cpu, in float64, or cuda, in float32.
        precision: Of networks: float64, float32 or bfloat16. In the last two rounding may decide an episode;
            such episodes are listed as near_ties.
        python: The Python of LeRobot's own environment, which LeRobot policies run in; see docs/lerobot.md.
        trust_code: Run the code that run folders name, as those of learners of your own do. Code named on the
            command line needs no such trust.
    """

    batch: int = 40
    device: str = "cpu"
    precision: Literal["float64", "float32", "bfloat16"] | None = None
    python: str | None = None
    trust_code: bool = False


@dataclass(frozen=True, slots=True)
class JobOptions:
    """Clusters and job arrays.

    Args:
        engine: processes of this machine, or ray.
        address: Ray cluster as HOST:PORT; by default Ray is started on this machine and stopped at the end.
        shard_range: Play only these of the batches that --list-shards numbers, as a:b without b itself; for
            job arrays with one --out. The last job writes results.json and the report.
        list_shards: Print the batches, one a line: number, policy, task, level, first seed, episodes. Play
            nothing.
    """

    engine: Literal["processes", "ray"] = "processes"
    address: str | None = None
    shard_range: str | None = None
    list_shards: bool = False


@dataclass(frozen=True, slots=True)
class ChatOptions:
    """Servers of vision-language models.

    Args:
        base_url: Address of the OpenAI-compatible server of models vlm:MODEL, such as
            http://127.0.0.1:8000/v1; by default that of OPENAI_BASE_URL, else OpenAI's own. The key is that
            of OPENAI_API_KEY; see docs/vlms.md.
        view: Camera that they see, and in whose picture they point; top+front shows both.
        dry_run: Write the first message that a model would get as a page, and estimate what the evaluation
            costs. Nothing is sent.
    """

    base_url: str | None = None
    view: ChatView = "top"
    dry_run: bool = False


def main(
    *,
    policy: str,
    tasks: str = "all",
    levels: str = "L1,L2,L3,L4",
    episodes: int = 200,
    seed: int = 0,
    workers: int | None = None,
    out: Path = Path("evaluation"),
    force: bool = False,
    as_json: Json = False,
    environment: Environment = DEFAULT_ENVIRONMENT,
    ablation: OmitArgPrefixes[AblationOptions] = AblationOptions(),
    recording: OmitArgPrefixes[RecordingOptions] = RecordingOptions(),
    network: OmitArgPrefixes[NetworkOptions] = NetworkOptions(),
    jobs: OmitArgPrefixes[JobOptions] = JobOptions(),
    chat: OmitArgPrefixes[ChatOptions] = ChatOptions(),
    vlm: VlmOptions = DEFAULT_OPTIONS,
) -> None:
    """Score policies on tasks and levels, and write results.json and report.html.

    The numbers depend on neither the number of workers nor the machine's load. An interrupted evaluation
    resumes.

    Example: openvima evaluate --policy mine=runs/first --ablations all --levels L1,L2 --workers 2

    Args:
        policy: One or more of openvima-small and openvima-vima (bundled), oracle, random, untrained,
            untrained:PRESET (random weights), folders of training runs, FILE.py:FUNCTION or MODULE:FUNCTION
            that makes a policy of your own, published files, OWNER/NAME[@REVISION] on the Hub, policy servers
            (ws://HOST:PORT, see `openvima serve`), LeRobot policies (lerobot:PATH or
            lerobot:OWNER/NAME[@REVISION], see --python) and vision-language models (vlm:MODEL, see
            --base-url), with commas in between; NAME=FOLDER, NAME=FILE.py:FUNCTION and so on give another
            name.
        tasks: Names of tasks with commas in between; all; or heldout, the four tasks of L4 that training
            does not see. A level that does not hold a task leaves it out.
        levels: Levels with commas in between: train, L1 to L8; from L5 on they are beyond the benchmark.
        episodes: Episodes for each policy, task and level; 200 as in published tables.
        seed: Number of the first episode; evaluation episodes never occur in training.
        workers: Processes; by default one for each CPU, fewer for less than two batches each, and one with
            --device cuda. With --address, all CPUs of the Ray cluster.
        out: Folder to write to.
        force: Overwrite the results of another evaluation in that folder.
        as_json: Print the rows as JSON instead of a table.
        environment: Tasks, prompts and control.
        ablation: Input ablations.
        recording: Report and videos.
        network: Where and how networks compute.
        jobs: Clusters and job arrays.
        chat: Servers of vision-language models.
        vlm: How these models are asked.
    """
    from openvima.env import EnvConfig
    from openvima.errors import ConfigError, LimitReachedError
    from openvima.evaluation import EvaluationConfig, Results, evaluate
    from openvima.evaluation.ablations import IN_CONTEXT
    from openvima.evaluation.config import plan
    from openvima.evaluation.results import FILE_NAME
    from openvima.evaluation.runner import evaluate_range, finished_part
    from openvima.multiprocess import num_cpus
    from openvima.report.videos import VideoSelection, check_report, report_on
    from openvima.serving.chat import VlmConfig

    config = EvaluationConfig(
        policies=parse_list(policy),
        tasks=parse_list(tasks),
        levels=parse_list(levels),
        episodes=episodes,
        seed=seed,
        workers=workers,
        out=out,
        env_config=EnvConfig(**asdict(environment)),
        force=force,
        ablations=parse_list(ablation.ablations) + (IN_CONTEXT,) * ablation.in_context,
        boxes=ablation.boxes,
        engine=jobs.engine,
        address=jobs.address,
        vlm=VlmConfig(chat.base_url, chat.view, vlm),
        **asdict(network),
    )
    if chat.dry_run:
        from openvima.evaluation.chat import write_preview

        page, estimate = write_preview(config)
        print(f"About {estimate}.")
        print(page)
        return
    if workers is None and jobs.engine == "processes" and network.device == "cpu":
        config = replace(config, workers=max(1, min(num_cpus(), len(plan(config)) // 2)))
    print_left_out(config.tasks, environment.prompts, config.levels)
    selection = VideoSelection(recording.videos, parse_list(recording.record_video))
    if recording.record_video and not recording.report:
        raise ConfigError("--record-video needs the report; drop --no-report.")
    if jobs.list_shards:
        for number, shard in enumerate(plan(config)):
            names = (" ".join(filter(None, (shard.policy, shard.ablation))), shard.task, shard.level)
            print(number, *names, shard.first_seed, shard.episodes, sep="\t")
        return
    if shards := parse_shard_range(jobs.shard_range):
        with progress_bar("evaluation") as bar:
            is_last = evaluate_range(config, shards, bar)
        if not is_last:
            what = "is finished" if (out / FILE_NAME).exists() else "lacks batches of other ranges"
            print(f"{out} {what}.", file=sys.stderr)
            return
    if recording.report:
        check_report(config, selection)
    try:
        with config.served() as served:
            with progress_bar("evaluation") as bar:
                path = evaluate(served, bar)
            _print_scores(Results.read(path), path, as_json=as_json)
            if recording.report:
                with progress_bar("evaluation") as bar:
                    report_on(served, selection, bar, policies=config.policies)
    except LimitReachedError:
        if (finished := finished_part(config)) is not None:
            print_results(finished)
        raise
    print(
        f"Results: {path}" + (f"   Report: {path.with_name('report.html')}" if recording.report else ""),
        file=sys.stderr,
    )


def _print_scores(results: "Results", path: Path, *, as_json: bool) -> None:
    """Print results that lie in a file, and on standard error what to know about them."""
    if as_json:
        print(json.dumps(json.loads(path.read_text(encoding="utf-8"))["rows"]))
    else:
        print_results(results)
    for count, cause, found in (
        ("invalid", "an invalid action", results.invalid_actions()),
        ("raised", "an error of the policy", results.policy_errors()),
    ):
        for each in found:
            of = f"{each[count]} of {each['episodes']} episodes of {each['policy']}"
            print(f"Warning: {of} ended by {cause}; {each['first']}", file=sys.stderr)
    if unneeded := results.unneeded_prompts():
        print(f"Warning: {unneeded}", file=sys.stderr)
    for name, what in results.policies.items():
        if seen := what.get("held_out_data"):
            print(
                f"Warning: {name} was trained on held-out demonstrations: {', '.join(seen)}.", file=sys.stderr
            )
    if num_near := sum(len(row.near_ties) for row in results.rows):
        print(
            "Episodes with two choices of nearly equal score, which another machine may decide otherwise: "
            f"{num_near} (near_ties in {path.name}).",
            file=sys.stderr,
        )


def print_results(results: "Results") -> None:
    """Print success rates as a table, a row a task and level, a column a policy; then the ablations."""
    from openvima.report.tables import ablation_tables, result_table

    print_table(rich_table(result_table(results)), num_heads=2)
    for table in ablation_tables(results):
        print_table(rich_table(table))
