"""Sections of the report, each a function from results to HTML."""

from collections.abc import Sequence

from openvima.evaluation.results import LevelMean, Results
from openvima.html import data_uri
from openvima.report.curves import Chart
from openvima.report.figures import curve_chart, level_chart
from openvima.report.markup import DOT, section
from openvima.report.text import (
    LEVEL_MEANINGS,
    LEVEL_NAMES,
    counted,
    listed,
    percent,
    prose,
    role,
    series_colours,
    span,
)
from openvima.video.clips import Clip


def measured(results: Results) -> str:
    """Counts of policies, tasks, levels and episodes as a sentence."""
    episodes = sorted({row.episodes for row in results.rows})
    each = f"{episodes[0]:,} to " * (len(episodes) > 1) + counted(episodes[-1], "episode")
    return (
        f"{counted(len(results.policy_names()), 'policy').replace('policys', 'policies')}, "
        f"{counted(len(results.tasks()), 'task')}, {counted(len(results.levels()), 'level')}, {each} each; "
        f"{counted(sum(row.episodes for row in results.rows), 'episode')} in all, on seeds that training "
        "never uses."
    )


def policy_cards(results: Results) -> str:
    """Level means of each policy, as bars."""
    colours = series_colours(results)
    means = [mean for mean in results.level_means() if not mean.ablation]
    cards = []
    for policy in results.policy_names():
        meters = "".join(_meter(mean) for mean in means if mean.policy == policy)
        cards.append(
            f'<article class="card policy" style="--series:var({colours[policy]})">'
            f"<h3>{DOT}{prose(policy)}</h3><p>{prose(role(results, policy))}</p>"
            f"<div>{meters}</div></article>"
        )
    return section(
        "overview",
        "Overview",
        "Success rates, averaged over the tasks of each level. Higher levels are further from the training "
        "distribution.",
        f'<div class="grid">{"".join(cards)}</div>',
    )


def level_charts(results: Results) -> str:
    """The same numbers as dots with interval bars."""
    colours = series_colours(results)
    legend = "".join(
        f'<li style="--series:var({variable})">{DOT}{prose(policy)}</li>'
        for policy, variable in colours.items()
    )
    panels = "".join(
        f'<figure class="card"><h3>{prose(level)} · {prose(LEVEL_NAMES.get(level, level))}</h3>'
        f"{level_chart(results, level, colours)}</figure>"
        for level in results.levels()
    )
    return section(
        "chart",
        "Confidence intervals",
        "Success rates with 95 % intervals. Overlapping intervals do not rule out a difference: the paired "
        "comparison below has more power.",
        f'<ul class="legend">{legend}</ul><div class="grid wide">{panels}</div>',
    )


def clip_cards(clips: Sequence[Clip]) -> str:
    """Videos of single episodes, each with its prompt."""
    if not clips:
        return ""
    return section(
        "videos",
        "Videos",
        "Episodes of the evaluation in real time, from the front camera, each with its prompt.",
        f'<div class="grid wide">{"".join(_clip_card(clip) for clip in clips)}</div>',
    )


def training_charts(charts: Sequence[Chart]) -> str:
    """Curves over training steps.

    Args:
        charts: As read from the records of training runs.
    """
    drawn = (
        curve_chart(chart.curves, title=chart.title, name=f"curve-{number}", percent=chart.percent)
        for number, chart in enumerate(charts)
    )
    figures = "".join(f'<figure class="card">{svg}</figure>' for svg in drawn)
    if not figures:
        return ""
    return section(
        "training",
        "Training",
        "Metrics of the training run over its steps.",
        f'<div class="grid wide">{figures}</div>',
    )


def level_meanings(results: Results) -> str:
    """What each level tests."""
    entries = "".join(
        f"<dt>{level} · {LEVEL_NAMES[level]}</dt><dd>{prose(meaning)}{_tasks_of(results, level)}</dd>"
        for level, meaning in LEVEL_MEANINGS.items()
        if level != "train" or level in results.levels()
    )
    return section(
        "levels",
        "Levels",
        "Each level removes one more thing to which a policy could have overfitted.",
        f'<div class="card"><dl class="levels">{entries}</dl></div>',
    )


def reproduction(results: Results, command: str) -> str:
    """The command that gives the same numbers, and the versions that it depends on."""
    versions = "".join(
        f"<li>{prose(name)} <b>{prose(text)}</b></li>" for name, text in results.versions.items()
    )
    weights = "".join(
        f"<li>{prose(policy)} weights <b>{prose(what['sha256'][:12])}</b></li>"
        for policy, what in results.policies.items()
        if "sha256" in what
    )
    return section(
        "repeat",
        "Reproduction",
        "The same command gives the same results with any number of workers.",
        f'<div class="card"><pre><code>{prose(command)}</code></pre>'
        '<p class="note">results.json contains the outcome of every episode. Objects are cropped '
        "by the segmentation of the simulator, as in most published results, except in the ablation "
        "“detected boxes”.</p>"
        f'<ul class="versions">{versions}{weights}</ul></div>',
    )


def _meter(mean: LevelMean) -> str:
    text = f"{mean.level}: {percent(mean.mean)}, 95 % interval {span(mean.interval)}"
    return (
        f'<div class="meter" title="{prose(text)}"><span>{prose(mean.level)}</span>'
        f'<span class="track"><i style="width:{100 * mean.mean:.1f}%"></i></span>'
        f"<b>{percent(mean.mean)}</b></div>"
    )


def _clip_card(clip: Clip) -> str:
    prompt = " ".join(_prompt_part(part) for part in clip.prompt)
    for mark in ".,;:":
        prompt = prompt.replace(f" {mark}", mark)
    outcome = (
        f'<span class="badge good">✓ solved in {counted(clip.steps, "step")}</span>'
        if clip.success
        else f'<span class="badge bad">✗ {prose(clip.reason)}</span>'
    )
    label = f"{clip.policy} on {clip.task}, level {clip.level}, seed {clip.seed}"
    return (
        f'<article class="card clip"><video controls autoplay muted loop playsinline '
        f'aria-label="{prose(label)}" poster="{data_uri(clip.poster)}" '
        f'src="{data_uri(clip.video, "video/mp4")}"></video><div class="text"><p class="prompt">{prompt}</p>'
        f'<div class="meta">{outcome}<span>{prose(clip.policy)}</span><span>{prose(clip.task)}</span>'
        f"<span>{prose(clip.level)}</span><span>seed {clip.seed}</span></div></div></article>"
    )


def _prompt_part(part: str | bytes) -> str:
    if isinstance(part, str):
        return prose(part)
    return f'<img src="{data_uri(part)}" alt="[image]">'


def _tasks_of(results: Results, level: str) -> str:
    tasks = results.tasks(level)
    if not tasks:
        return ' <span class="note">Not part of this evaluation.</span>'
    return f' <span class="note">Here: {prose(listed(tasks))}.</span>'
