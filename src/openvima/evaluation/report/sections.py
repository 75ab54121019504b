"""Sections of the report, each a function from results to HTML."""

import base64
from collections import Counter
from collections.abc import Sequence

from openvima.evaluation.clips import Clip
from openvima.evaluation.report.curves import Chart
from openvima.evaluation.report.figures import curve_chart, level_chart
from openvima.evaluation.report.wording import (
    LEVEL_MEANINGS,
    LEVEL_NAMES,
    counted,
    findings,
    headline,
    listed,
    per_cent,
    prose,
    role,
    series_colours,
    span,
)
from openvima.evaluation.results import LevelMean, Results, Row

_DOT = '<span class="dot"></span>'  # in the colour of its policy


def heading(results: Results) -> str:
    """The page's head: the finding, and what was measured."""
    levels, tasks = results.levels(), results.tasks()
    episodes = sorted({row.episodes for row in results.rows})
    each = str(episodes[0]) if len(episodes) == 1 else f"{episodes[0]} to {episodes[-1]}"
    measured = (
        f"{counted(len(results.policy_names()), 'policy').replace('policys', 'policies')}, "
        f"{counted(len(tasks), 'task')}, {counted(len(levels), 'level')}, {each} episodes each; "
        f"{sum(row.episodes for row in results.rows):,} episodes in all, on seeds that training never uses."
    )
    return (
        '<header><div><div class="eyebrow">openvima evaluation report</div>'
        f"<h1>{prose(headline(results))}</h1>"
        "<p>A robot arm is told what to do by a prompt that mixes words with images. It looks at the table "
        "from two cameras, acts, and an episode counts as solved when the goal is reached within the step "
        "limit.</p>"
        f"<p>{prose(measured)}</p></div></header>"
    )


def policy_cards(results: Results) -> str:
    """Level means of each policy, as bars."""
    colours = series_colours(results)
    means = results.level_means()
    cards = []
    for policy in results.policy_names():
        meters = "".join(_meter(mean) for mean in means if mean.policy == policy)
        cards.append(
            f'<article class="card policy" style="--series:var({colours[policy]})">'
            f"<h3>{_DOT}{prose(policy)}</h3><p>{prose(role(results, policy))}</p>"
            f"<div>{meters}</div></article>"
        )
    return _section(
        "overview",
        "At a glance",
        "Share of solved episodes, averaged over the tasks of each level. The higher the level, the less of "
        "what it shows was seen in training.",
        f'<div class="grid">{"".join(cards)}</div>',
    )


def rate_table(results: Results) -> str:
    """Success of every policy on every task, by level, with 95 % intervals."""
    policies = results.policy_names()
    colours = series_colours(results)
    head = "".join(
        f'<th scope="col" style="--series:var({colours[policy]})">{_DOT}{prose(policy)}</th>'
        for policy in policies
    )
    bodies = "".join(_level_rows(results, level, policies) for level in results.levels())
    return _section(
        "results",
        "Results by task",
        "Solved episodes in per cent; below, the 95 % interval (Wilson) in per cent, and counts.",
        '<div class="card scroll"><table class="rates"><thead><tr><th scope="col">task</th>'
        f"{head}</tr></thead>{bodies}</table></div>",
    )


def level_charts(results: Results) -> str:
    """The same numbers as dots with interval bars."""
    colours = series_colours(results)
    legend = "".join(
        f'<li style="--series:var({variable})">{_DOT}{prose(policy)}</li>'
        for policy, variable in colours.items()
    )
    panels = "".join(
        f'<figure class="card"><h3>{prose(level)} · {prose(LEVEL_NAMES.get(level, level))}</h3>'
        f"{level_chart(results, level, colours)}</figure>"
        for level in results.levels()
    )
    return _section(
        "chart",
        "How sure the numbers are",
        "Each dot is a success rate, each bar its 95 % interval. Bars that do not overlap mean that the "
        "difference is hardly chance.",
        f'<ul class="legend">{legend}</ul><div class="grid wide">{panels}</div>',
    )


def clip_cards(clips: Sequence[Clip]) -> str:
    """Films of single episodes, each with its prompt."""
    if not clips:
        return ""
    return _section(
        "films",
        "Watch it work",
        "Episodes of the evaluation, filmed from the front camera in real time. Below each film stands the "
        "prompt as the policy received it.",
        f'<div class="grid wide">{"".join(_clip_card(clip) for clip in clips)}</div>',
    )


def training_charts(charts: Sequence[Chart]) -> str:
    """Curves over training steps.

    Args:
        charts: As read from the run's record.
    """
    figures = "".join(
        f'<figure class="card">{curve_chart(chart.curves, title=chart.title, percent=chart.percent)}</figure>'
        for chart in charts
    )
    if not figures:
        return ""
    return _section(
        "training",
        "Training",
        "How the policy learned from the demonstrations.",
        f'<div class="grid wide">{figures}</div>',
    )


def failure_table(results: Results) -> str:
    """Why episodes were not solved, by policy."""
    lines = []
    for policy in results.policy_names():
        rows = [row for row in results.rows if row.policy == policy]
        lines += _failure_lines(policy, series_colours(results)[policy], rows)
    return _section(
        "failures",
        "What went wrong",
        "Causes of unsolved episodes, over all levels.",
        '<div class="card scroll"><table><thead><tr><th scope="col">policy</th><th scope="col">cause</th>'
        '<th scope="col" class="num">episodes</th><th scope="col" class="num">share of all</th>'
        f'<th scope="col">tasks</th></tr></thead><tbody>{"".join(lines)}</tbody></table></div>',
    )


def level_meanings(results: Results) -> str:
    """What each level tests."""
    entries = "".join(
        f"<dt>{level} · {LEVEL_NAMES[level]}</dt><dd>{prose(meaning)}{_tasks_of(results, level)}</dd>"
        for level, meaning in LEVEL_MEANINGS.items()
        if level != "train" or level in results.levels()
    )
    return _section(
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
    return _section(
        "repeat",
        "Repeat this",
        "The same command gives the same numbers, with any number of workers.",
        f'<div class="card"><pre><code>{prose(command)}</code></pre>'
        '<p class="note">The outcome of every single episode is in results.json, next to this page.</p>'
        f'<ul class="versions">{versions}{weights}</ul></div>',
    )


def summary_line(results: Results) -> str:
    """The findings as plain text, for search engines and link previews."""
    return prose(findings(results))


def _section(name: str, title: str, lead: str, body: str) -> str:
    return f'<section id="{name}"><h2>{prose(title)}</h2><p>{prose(lead)}</p>{body}</section>'


def _meter(mean: LevelMean) -> str:
    text = f"{mean.level}: {per_cent(mean.mean)}, 95 % interval {span(mean.interval)}"
    return (
        f'<div class="meter" title="{prose(text)}"><span>{prose(mean.level)}</span>'
        f'<span class="track"><i style="width:{100 * mean.mean:.1f}%"></i></span>'
        f"<b>{per_cent(mean.mean)}</b></div>"
    )


def _level_rows(results: Results, level: str, policies: list[str]) -> str:
    name = LEVEL_NAMES.get(level, level)
    rows = [
        f'<tr class="level"><th scope="rowgroup">{prose(level)}</th>'
        f'<td colspan="{len(policies)}">{prose(name)}</td></tr>'
    ]
    for task in results.tasks(level):
        cells = "".join(_rate_cell(results.row(policy, task, level)) for policy in policies)
        rows.append(f'<tr><th scope="row">{prose(_breakable(task))}</th>{cells}</tr>')
    means = {mean.policy: mean for mean in results.level_means() if mean.level == level}
    cells = "".join(_mean_cell(means.get(policy)) for policy in policies)
    rows.append(f'<tr class="mean"><th scope="row">mean of {len(results.tasks(level))}</th>{cells}</tr>')
    return f"<tbody>{''.join(rows)}</tbody>"


def _rate_cell(row: Row | None) -> str:
    if row is None:
        return "<td>–</td>"
    return (
        f'<td class="rate" style="--share:{row.rate:.3f}"><b>{_exact(row.rate)}</b>'
        f"<small>{span(row.interval)} · {row.successes}/{row.episodes}</small></td>"
    )


def _exact(rate: float) -> str:
    """Whole per cent where the rate is, as with 50 or 100 episodes, else one decimal."""
    return per_cent(rate, 0 if round(1000 * rate) % 10 == 0 else 1)


def _mean_cell(mean: LevelMean | None) -> str:
    if mean is None:
        return "<td>–</td>"
    return (
        f'<td class="rate" style="--share:{mean.mean:.3f}"><b>{per_cent(mean.mean, 1)}</b>'
        f"<small>{span(mean.interval)}</small></td>"
    )


def _breakable(name: str) -> str:
    """Let long names break after their underscores."""
    return name.replace("_", "_\u200b")


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


def _failure_lines(policy: str, colour: str, rows: list[Row]) -> list[str]:
    causes: Counter[str] = Counter()
    tasks: dict[str, Counter[str]] = {}
    for row in rows:
        for kind, count in row.failures.items():
            causes[kind] += count
            tasks.setdefault(kind, Counter())[row.task] += count
    total = sum(row.episodes for row in rows)
    name = f'<span class="dot" style="--series:var({colour})"></span>{prose(policy)}'
    if not causes:
        return [f'<tr><td class="name">{name}</td><td colspan="4">every episode was solved</td></tr>']
    return [
        f'<tr><td class="name">{name if index == 0 else ""}</td><td>{prose(kind)}</td>'
        f'<td class="num">{count}</td><td class="num">{per_cent(count / total, 1)}</td>'
        f'<td class="long">{prose(_by_task(tasks[kind]))}</td></tr>'
        for index, (kind, count) in enumerate(sorted(causes.items(), key=lambda item: (-item[1], item[0])))
    ]


def _tasks_of(results: Results, level: str) -> str:
    tasks = results.tasks(level)
    if not tasks:
        return ' <span class="note">Not part of this evaluation.</span>'
    return f' <span class="note">Here: {prose(listed(tasks))}.</span>'


def _data_uri(content: bytes, kind: str) -> str:
    return f"data:{kind};base64,{base64.b64encode(content).decode('ascii')}"


def _by_task(counts: Counter[str]) -> str:
    return ", ".join(f"{task} {count}" for task, count in sorted(counts.items()))
