"""*Why*: what the policy considers, on the table and below the prompt; two policies side by side."""

from dataclasses import replace

import numpy as np
import viser

from openvima.env.clicks import pose_after
from openvima.evaluation.session import EpisodeSession, first_difference
from openvima.policies.bundled import BUNDLED
from openvima.scene import WORKSPACE_HIGH, WORKSPACE_LOW, Action, Pose
from openvima.scene.explanation import Explanation
from openvima.studio.browser_session import BrowserSession
from openvima.studio.table import Table
from openvima.video.explanation import (
    HEAT_COLOURS,
    LEAST_SHOWN,
    PICK,
    PLACE,
    attention_rows,
    draw_panel,
    heat_opacity,
    percent,
)
from openvima.video.prompt_strip import Colour

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
            hint = "0 takes the most probable action; above, actions are sampled"
            self._temperature = gui.add_slider("temperature", 0.0, 2.0, 0.1, 0.0, hint=hint)
            names = (_NOBODY, *BUNDLED, "oracle", "random", *session.config.policies)
            self._other = gui.add_dropdown("compare with", names, hint="on the same episode, in lockstep")
            self._text = gui.add_markdown("")
            blank = np.full((1, 1, 3), 255, np.uint8)
            self._images = [gui.add_image(blank, visible=False) for _ in range(2)]
        self._shown.on_update(session.callback(session.changed))
        self._temperature.on_update(session.callback(self._choose_temperature))
        self._other.on_update(session.callback(self._choose_other))
        session.on_change(self._show)

    def _choose_temperature(self) -> None:
        self.session.temperature = self._temperature.value
        self.session.choose_policy(self.session.policy_name)

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
            proposal = run.propose() if self._shown.value else None
            if len(runs) > 1:
                lines.append(f"**{name}**: {run.summary()}")
                self._add_label(table, "name", name, (0.82, 0.0))
            if proposal is None:
                continue
            if proposal.error is not None:
                lines.append(f"**{name}**: {proposal.error}")
            if proposal.action is not None:
                self._add_arrow(table, "action", proposal.action)
            if proposal.explanation is not None:
                if proposal.explanation.bins:
                    self._add_heat_maps(table, proposal.explanation)
                else:
                    self._explain(table, run, proposal.explanation)
                    lines.append(self._second_choice(table, run, proposal.explanation))
                panels.append(draw_panel(run.scene, self.session.assets, proposal.explanation))
                rows = attention_rows(proposal.explanation)
                self.session.prompt_weights = self.session.prompt_weights or rows
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
                self._nodes.append(table.add_ghost(name, placement, pose=Pose((0.0, 0.0, 0.0)), **style))
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
                ghost = table.add_ghost(f"why/{number}", placement, pose=pose, opacity=opacity)
                self._nodes.append(ghost)

    def _second_choice(self, table: Table, run: EpisodeSession, explanation: Explanation) -> str:
        """Say which action was the second most probable, and draw a thin arrow if its place is known."""
        choice = explanation.second_choice()
        if choice is None or choice[-1] < LEAST_SHOWN:
            return "No other action has a probability of 1 %."
        picked, place, probability = choice
        names = {p.id: f"the {p.texture} {p.object}" for p in run.scene.placements}
        what = names.get(picked.object_id, "an object")
        said = f"Second most probable, {percent(probability)}: pick {what}"
        if place is None:
            return f"{said}."
        self._add_arrow(table, "second", Action.planar(picked.grasp, place.position), PLACE)
        return f"{said}, place it at ({place.position[0]:.2f}, {place.position[1]:.2f}) m: the blue arrow."

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
