"""Tabs of the episode in view. *Play*: step through it; *You*: act by clicks; *Why*: explanations."""

import math
import re
from dataclasses import replace

import numpy as np
import viser

from openvima.catalog.packs import ASSET_PACKS
from openvima.catalog.partitions import LEVELS
from openvima.data.user_demonstrations import check_recordable, record_demonstration
from openvima.errors import DatasetError, echo
from openvima.evaluation.session import EpisodeSession, first_difference
from openvima.policies.naming import BUNDLED, SMALL
from openvima.render.rasteriser import Rasteriser, front_above_top
from openvima.render.raycast import TABLE, Hit
from openvima.scene import WORKSPACE_HIGH, WORKSPACE_LOW, Action, Pose
from openvima.scene.action import pose_after
from openvima.scene.explanation import Explanation
from openvima.studio.browser_session import YOU, BrowserSession, Table, clicked_action
from openvima.tasks import list_tasks, task_spec
from openvima.tasks.sampling import MAX_SEED
from openvima.video.explanation import (
    HEAT_COLOURS,
    LEAST_SHOWN,
    PICK,
    attention_rows,
    draw_panel,
    heat_opacity,
)
from openvima.video.prompt_strip import Colour, percent

_FIRST_TASK = "rearrange"
_OTHER = "other …"


class PlayPanel:
    """The tab *Play*."""

    def __init__(self, session: BrowserSession) -> None:
        self.session = session
        gui = session.gui
        with session.tabs.add_tab("Play", viser.Icon.ROBOT):
            self._task = gui.add_dropdown("task", list_tasks(), initial_value=_FIRST_TASK)
            self._level = gui.add_dropdown("level", LEVELS, initial_value="train")
            self._seed = gui.add_number("seed", 0, min=0, max=2**53, step=1)
            packs = dict.fromkeys((session.config.env_config.assets, *ASSET_PACKS))
            self._assets = gui.add_dropdown("assets", [*packs])
            names = (*BUNDLED, "oracle", "random", YOU, *session.config.policies, _OTHER)
            self._name = gui.add_dropdown("policy", names, initial_value=SMALL)
            hint = "run folder, FILE.py:FUNCTION, ws://HOST:PORT, id on the Hub"
            self._source = gui.add_text("source", "", hint=hint, visible=False)
            self._outcome = gui.add_markdown("")
            works = {"step": session.step, "play": session.run, "pause": session.pause}
            session.add_buttons("", {**works, "next seed": self._next_seed})
            self._time = gui.add_slider("after step", 0, 1, 1, 0)
            self._speed = gui.add_slider("speed", 0.25, 8.0, 0.25, 1.0)
            self._views = gui.add_image(np.zeros((1, 1, 3), np.uint8), label="what the policy sees")
        session.next_seed = self._next_seed
        session.on_update(self._open, self._task, self._level, self._seed, self._assets)
        session.on_update(self._choose_policy, self._name, self._source)
        session.on_update(lambda: session.back(self._time.value), self._time)
        self._speed.on_update(lambda _: setattr(session, "speed", self._speed.value))
        session.on_change.append(self._show)
        session.submit(self._open)

    def _choose_policy(self) -> None:
        self._source.visible = self._name.value == _OTHER
        session, name = self.session, self._name.value
        name = self._source.value.strip() if name == _OTHER else name
        if name and name != session.policy_name:
            session.policy, session.policy_name = session.load_policy(name), name
            if session.current is not None:
                session.current.policy = session.policy
                session.changed()

    def _open(self) -> None:
        """Show the episode before the policy, which takes longer to load."""
        task = self._task.value  # fields can change meanwhile; another call then follows
        levels, level = task_spec(task).levels, self._level.value
        level = level if level in levels else levels[0]
        self._level.options, self._level.value = levels, level
        self.session.choose_assets(self._assets.value)
        seed = min(int(self._seed.value), MAX_SEED)
        episode = self.session.env_config.sample(task, level, seed, domain="user")
        self.session.open(episode, self.session.policy)
        self._choose_policy()

    def _next_seed(self) -> None:
        self._seed.value = int(self._seed.value) + 1
        self._open()

    def _show(self) -> None:
        """Show the camera views, how far the episode is, and how it ended."""
        current = self.session.current
        if current is None:
            return
        self._views.image = front_above_top(Rasteriser(self.session.assets).scene(current.scene))
        self._time.max = max(1, current.num_steps)
        self._time.value = current.num_steps
        self._outcome.content = current.summary()


_GHOST, _START = "you/ghost", "/you/start"
_START_RGB, _START_M = (220, 120, 0), 0.008
_TURN_DEG = 15  # of the key T
_HELP = {
    "suction": "Click an **object**, then the **place** to put it, or drag it. The ghost shows its turn.",
    "spatula": "Click a **block**, or where to begin, then where the **sweep** ends; or drag a block there.",
}


class UserPanel:
    """The tab *You*, and the clicks into the scene."""

    def __init__(self, session: BrowserSession) -> None:
        self.session = session
        self._first: Hit | None = None
        self._episode: EpisodeSession | None = None
        self._recorded = ""  # what was said of it
        self._nodes: list[viser.SceneNodeHandle] = []
        gui = session.gui
        with session.tabs.add_tab("You", viser.Icon.HAND_CLICK):
            self._help = gui.add_markdown("")
            self._turn = gui.add_slider("turn (degrees)", -180, 180, 5, 0)
            works = {"turn in place": self._turn_in_place, "cancel": self._forget}
            session.add_buttons("", {**works, "next seed": lambda: session.next_seed()})
            self._record = gui.add_markdown("")
        session.on_update(self._preview, self._turn)
        gui.add_command(f"turn by {_TURN_DEG}°", hotkey="T").on_trigger(lambda _: self._turn_by(_TURN_DEG))
        back = gui.add_command(f"turn by -{_TURN_DEG}°", hotkey="T", modifier="shift")
        back.on_trigger(lambda _: self._turn_by(-_TURN_DEG))
        session.client.scene.on_click()(self._clicked)
        session.on_drag.append(self._dragged)
        session.on_change.append(self._show)

    def _clicked(self, event: viser.SceneClickEvent) -> None:
        if not self.session.editing:
            self.session.submit(lambda: self._click(event))

    def _dragged(self, object_id: int, event: viser.SceneNodeDragEvent) -> None:
        """Act from where an object was grabbed to where it is let go."""
        if event.phase == "end" and not self.session.editing:
            self.session.submit(lambda: self._drop(Hit(object_id, event.start_position), event))

    def _drop(self, first: Hit, event: viser.SceneNodeDragEvent) -> None:
        current = self.session.current
        if current is None or current.outcome is not None:
            return
        others = [p for p in current.scene.placements if p.id != first.object_id]
        if (hit := self.session.hit(event, others)) is not None:
            self._act(first, hit)

    def _click(self, event: viser.SceneClickEvent) -> None:
        """Take the first click, or act with the second."""
        current = self.session.current
        if current is None or current.outcome is not None:
            return
        hit = self.session.hit(event, current.scene.placements)
        if hit is None:
            return
        if self._first is not None:
            self._act(self._first, hit)
        else:
            if current.scene.end_effector == "suction":
                clicked_action(current.scene, hit, hit)  # refuses what cannot be picked
            self._first = hit
            self._preview()

    def _act(self, first: Hit, second: Hit) -> None:
        current = self.session.current
        assert current is not None  # it was clicked
        turn_rad = math.radians(self._turn.value)
        action = clicked_action(current.scene, first, second, turn_rad=turn_rad)
        self._forget()
        self._turn.value = 0
        self.session.step(action)

    def _turn_by(self, degrees: int) -> None:
        self._turn.value = (self._turn.value + degrees + 180) % 360 - 180
        self.session.interrupt(self._preview)

    def _turn_in_place(self) -> None:
        if self._first is not None:
            self._act(self._first, self._first)

    def _preview(self) -> None:
        """Mark the first click, and show the picked object as it will be turned."""
        first, current = self._first, self.session.current
        for node in self._nodes:
            node.remove()
        self._nodes = []
        if current is not None:
            self._help.content = _HELP[current.scene.end_effector]
        if first is None or current is None:
            return
        scene = self.session.client.scene
        self._nodes = [scene.add_icosphere(_START, _START_M, color=_START_RGB, position=first.point)]
        if first.object_id != TABLE and current.scene.end_effector == "suction":
            placement = current.scene[first.object_id]
            action = clicked_action(current.scene, first, first, turn_rad=math.radians(self._turn.value))
            pose = pose_after(placement.pose, action)
            self._help.content = f"Picked {current.scene.describe(placement.id)}. Now click its **place**."
            self._nodes.append(self.session.table.add_ghost(_GHOST, placement, pose, grow=1.05))

    def _forget(self) -> None:
        self._first = None
        self._preview()

    def _show(self) -> None:
        current = self.session.current
        if current is not self._episode:
            self._episode, self._recorded = current, ""
        self._forget()
        if current is not None:
            self._record.content = self._recording(current)

    def _recording(self, current: EpisodeSession) -> str:
        """Record a success that is all the user's own, and say what is recorded."""
        folder, config = self.session.config.record, self.session.env_config
        if folder is None:
            return "Start the studio with `--record-demonstrations DIR` to keep what you solve."
        try:
            check_recordable(current.episode, env_config=config)
        except DatasetError as error:
            return f"Nothing is recorded: {error}"
        actions = [step.action for step in current.steps]
        solved = current.outcome is not None and current.outcome.success
        is_own = all(step.action is not step.proposal.action for step in current.steps)
        if solved and is_own and not self._recorded:
            count = record_demonstration(folder, current.episode, actions, env_config=config)
            self._recorded = f"**Recorded**: {count} demonstration{'s' * (count > 1)} in `{folder}`."
        hint = f"What you solve without a policy is recorded in `{folder}`."
        return self._recorded if solved and self._recorded else hint


_NOBODY = "nobody"
_MAX_PLACES = 6  # ghosts shown at once
_ARROW_Z_M = 0.09
_LABEL_Z_M = 0.08
_HEAT_Z_M = 0.002


class WhyPanel:
    """The tab *Why*."""

    def __init__(self, session: BrowserSession) -> None:
        self.session = session
        self._nodes: list[viser.SceneNodeHandle] = []
        gui = session.gui
        with session.tabs.add_tab("Why", viser.Icon.QUESTION_MARK):
            self._shown = gui.add_checkbox("show why", False, hint="what the policy considers next")
            names = (_NOBODY, *BUNDLED, "oracle", "random", *session.config.policies)
            self._other = gui.add_dropdown("compare with", names, hint="on the same episode, in lockstep")
            self._text = gui.add_markdown("")
            blank = np.full((1, 1, 3), 255, np.uint8)
            self._images = [gui.add_image(blank, visible=False) for _ in range(2)]
        session.on_update(session.changed, self._shown)
        session.on_update(self._choose_other, self._other)
        session.on_change.append(self._show)

    def _choose_other(self) -> None:
        name = self._other.value
        self.session.compare(None if name == _NOBODY else self.session.load_policy(name))

    def _show(self) -> None:
        """Show what is considered at the step in view."""
        for node in self._nodes:
            self.session.client.scene.remove_by_name(node.name)  # if it did not go with its object
        self._nodes.clear()
        self.session.prompt_weights = []
        lines, panels = [], []
        runs = self.session.runs()
        for (table, run), name in zip(runs, (self.session.policy_name, self._other.value), strict=False):
            if len(runs) > 1:
                lines.append(f"**{name}**: {run.summary()}")
                self._add_label(table, "name", name, (0.82, 0.0))
            if not self._shown.value:
                continue
            proposal = run.propose()
            if proposal.error is not None:
                lines.append(f"**{name}**: {proposal.error}")
            if proposal.action is not None:
                self._add_arrow(table, "action", proposal.action)
            if (why := proposal.explanation) is not None:
                if why.words:
                    # As it is, without letting it write Markdown.
                    said = re.sub(r"([\\`*_{}\[\]<>()#+!|])", r"\\\1", echo(why.words, 2000))
                    lines.append(f"{name} said:\n\n> {said}")
                elif why.bins and not why.objects:
                    self._add_heat_maps(table, why)
                else:
                    self._explain(table, run, why)
                panels.append(draw_panel(run.scene, self.session.assets, why))
                self.session.prompt_weights = self.session.prompt_weights or attention_rows(why)
            elif proposal.action is not None:
                lines.append(f"{name} explains nothing; the arrow is its action.")
        if len(runs) > 1:
            lines.append(self._compared(runs[0][1], runs[1][1]))
        self._text.content = "\n\n".join(lines)
        for number, image in enumerate(self._images):
            image.visible = number < len(panels)
            if image.visible:
                image.image = panels[number]

    def _add_heat_maps(self, table: Table, explanation: Explanation) -> None:
        """Tint the table by the probabilities of picking and placing at its points."""
        low, size = np.array(WORKSPACE_LOW), np.subtract(WORKSPACE_HIGH, WORKSPACE_LOW)
        for height_m, (pose, colour) in zip((_HEAT_Z_M, 2 * _HEAT_Z_M), HEAT_COLOURS.items(), strict=True):
            opacity = heat_opacity(explanation.heat_map(pose)).T  # rows are y, columns are x
            image = np.empty((*opacity.shape, 4), np.uint8)
            image[..., :3], image[..., 3] = colour, np.rint(255 * opacity)
            at = np.array([*(low + size / 2), height_m])
            name = f"{table.root}/why/{pose}"
            node = self.session.client.scene.add_image(name, image, *size, format="png", position=at)
            self._nodes.append(node)

    def _explain(self, table: Table, run: EpisodeSession, explanation: Explanation) -> None:
        """Tint objects by the probability of picking them; show the picked one where it may be placed."""
        placements = {placement.id: placement for placement in run.scene.placements}
        for each in explanation.objects:
            placement = placements.get(each.object_id)
            if placement is not None and each.probability >= LEAST_SHOWN:
                style = {"colour": PICK, "opacity": 0.15 + 0.6 * each.probability, "grow": 1.04}
                name = f"objects/{placement.id}/why"  # moves with the object
                self._nodes.append(table.add_ghost(name, placement, Pose((0.0, 0.0, 0.0)), **style))
                xy = placement.pose.x, placement.pose.y
                self._add_label(table, f"pick{placement.id}", percent(each.probability), xy)
        picked = max(explanation.objects, key=lambda each: each.probability, default=None)
        placement = placements.get(picked.object_id) if picked else None
        action = Action.from_arrays(explanation.action)
        for number, place in enumerate(explanation.distinct_places()[:_MAX_PLACES]):
            if place.probability < LEAST_SHOWN:
                break
            self._add_label(table, f"place{number}", percent(place.probability), place.position)
            if placement is not None and run.scene.end_effector == "suction":
                moved = replace(action, pose1_position=place.position)
                pose, opacity = pose_after(placement.pose, moved), 0.12 + 0.4 * place.probability
                ghost = table.add_ghost(f"why/{number}", placement, pose, opacity=opacity)
                self._nodes.append(ghost)

    def _add_label(self, table: Table, name: str, text: str, position: tuple[float, float]) -> None:
        at, name = (*position, _LABEL_Z_M), f"{table.root}/why/label_{name}"
        label = self.session.client.scene.add_label(name, text, position=at, anchor="bottom-center")
        self._nodes.append(label)

    def _add_arrow(self, table: Table, name: str, action: Action, colour: Colour = (255, 255, 255)) -> None:
        points = [[(*point, _ARROW_Z_M) for point in (action.pose0_position, action.pose1_position)]]
        arrow = self.session.client.scene.add_arrows(
            f"{table.root}/why/{name}",
            np.array(points),
            colour,
            shaft_radius=0.004,
            head_radius=0.012,
            head_length=0.03,
        )
        self._nodes.append(arrow)

    def _compared(self, one: EpisodeSession, other: EpisodeSession) -> str:
        """Mark the first step at which two policies differ, by an arrow on each table, and say it."""
        index = first_difference(one.steps, other.steps)
        if index is None:
            return "No difference so far."
        for table, run in self.session.runs():
            self._add_arrow(table, "difference", run.steps[index].action, PICK)
        return f"The **first difference** is step {index + 1}: the orange arrows."
