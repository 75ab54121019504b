"""Sections of the report, each a function from results to HTML."""

import base64
from collections.abc import Sequence

from openvima.evaluation.results import LevelMean, Results
from openvima.report.curves import Chart
from openvima.report.figures import curve_chart, level_chart
from openvima.report.markup import DOT, section
from openvima.report.text import (
    LEVEL_MEANINGS,
    LEVEL_NAMES,
    counted,
    findings,
    headline,
    listed,
    percent,
    prose,
    role,
    series_colours,
    span,
)
from openvima.video.clips import Clip


def heading(results: Results, notes: Sequence[str] = ()) -> str:
    """The page's head: the finding, what was measured, and what to beware of."""
    levels, tasks = results.levels(), results.tasks()
    episodes = sorted({row.episodes for row in results.rows})
    each = f"{episodes[0]:,} to " * (len(episodes) > 1) + counted(episodes[-1], "episode")
    measured = (
        f"{counted(len(results.policy_names()), 'policy').replace('policys', 'policies')}, "
        f"{counted(len(tasks), 'task')}, {counted(len(levels), 'level')}, {each} each; "
        f"{counted(sum(row.episodes for row in results.rows), 'episode')} in all, on seeds that training "
        "never uses."
    )
    return (
        '<header><div><div class="eyebrow">openvima evaluation report</div>'
        f"<h1>{prose(headline(results))}</h1>"
        "<p>A robot arm is told what to do by a prompt that mixes words with images. It looks at the table "
        "from two cameras, acts, and an episode counts as solved when the goal is reached within the step "
        "limit.</p>"
        f"<p>{prose(measured)}</p>{''.join(f'<p><b>{prose(note)}</b></p>' for note in notes)}</div></header>"
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
        "At a glance",
        "Share of solved episodes, averaged over the tasks of each level. The higher the level, the less of "
        "what it shows was seen in training.",
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
        "How sure the numbers are",
        "Each dot is a success rate, each bar its 95 % interval. Bars that do not overlap mean that the "
        "difference is hardly chance; where they do overlap, comparing episode by episode may still tell.",
        f'<ul class="legend">{legend}</ul><div class="grid wide">{panels}</div>',
    )


def clip_cards(clips: Sequence[Clip]) -> str:
    """Films of single episodes, each with its prompt."""
    if not clips:
        return ""
    return section(
        "films",
        "Watch it work",
        "Episodes of the evaluation, filmed from the front camera in real time. Below each film stands the "
        "prompt as the policy received it.",
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
        "How the policy learned from the demonstrations.",
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
        "What the levels mean",
        "Each level takes away one more thing that the policy could have learned by heart.",
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
        "Repeat this",
        "The same command gives the same numbers, with any number of workers.",
        f'<div class="card"><pre><code>{prose(command)}</code></pre>'
        '<p class="note">The outcome of every single episode is in the results.json of the evaluation. '
        "Objects are cut out along the simulator’s own outlines, as in most published scores; a detector "
        "finds them only where the ablation “detected boxes” says so.</p>"
        f'<ul class="versions">{versions}{weights}</ul></div>',
    )


def summary_line(results: Results) -> str:
    """The findings as plain text, for search engines and link previews."""
    return prose(findings(results))


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
        f'aria-label="{prose(label)}" poster="{_data_uri(clip.poster, "image/png")}" '
        f'src="{_data_uri(clip.video, "video/mp4")}"></video><div class="text"><p class="prompt">{prompt}</p>'
        f'<div class="meta">{outcome}<span>{prose(clip.policy)}</span><span>{prose(clip.task)}</span>'
        f"<span>{prose(clip.level)}</span><span>seed {clip.seed}</span></div></div></article>"
    )


def _prompt_part(part: str | bytes) -> str:
    if isinstance(part, str):
        return prose(part)
    return f'<img src="{_data_uri(part, "image/png")}" alt="[image]">'


def _tasks_of(results: Results, level: str) -> str:
    tasks = results.tasks(level)
    if not tasks:
        return ' <span class="note">Not part of this evaluation.</span>'
    return f' <span class="note">Here: {prose(listed(tasks))}.</span>'


def _data_uri(content: bytes, kind: str) -> str:
    return f"data:{kind};base64,{base64.b64encode(content).decode('ascii')}"
