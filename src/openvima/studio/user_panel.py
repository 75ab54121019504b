"""*You*: act by clicks, and record own successes as demonstrations."""

import math

import viser

from openvima.data.user_demonstrations import check_recordable, record_demonstration
from openvima.env.clicks import clicked_action, pose_after
from openvima.errors import DatasetError
from openvima.evaluation.session import EpisodeSession
from openvima.render.raycast import TABLE, Hit
from openvima.scene import Action
from openvima.studio.browser_session import BrowserSession
from openvima.studio.table import hit_of

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
        self._grabbed: Hit | None = None
        self._own: list[Action] = []  # actions of the user in the current episode
        self._episode: EpisodeSession | None = None
        self._recorded = ""  # what was said of it
        self._nodes: list[viser.SceneNodeHandle] = []
        gui = session.gui
        with session.tabs.add_tab("You", viser.Icon.HAND_CLICK):
            self._help = gui.add_markdown("")
            self._acts = gui.add_checkbox("act by clicks", True)
            self._turn = gui.add_slider("turn (degrees)", -180, 180, 5, 0)
            works = {"turn in place": self._turn_in_place, "cancel": self._forget, "undo": self._undo}
            session.add_buttons("", {**works, "next seed": lambda: session.next_seed()})
            self._record = gui.add_markdown("")
        self._turn.on_update(session.callback(self._preview))
        gui.add_command(f"turn by {_TURN_DEG}°", hotkey="T").on_trigger(lambda _: self._turn_by(_TURN_DEG))
        back = gui.add_command(f"turn by -{_TURN_DEG}°", hotkey="T", modifier="shift")
        back.on_trigger(lambda _: self._turn_by(-_TURN_DEG))
        session.client.scene.on_click()(self._clicked)
        session.on_drag(self._dragged)
        session.on_change(self._show)

    def _clicked(self, event: viser.SceneClickEvent) -> None:
        if self._acts.value and not self.session.editing:
            self.session.submit(lambda: self._click(event))

    def _dragged(self, object_id: int, event: viser.SceneNodeDragEvent) -> None:
        """Act from where an object was grabbed to where it is let go."""
        if not self._acts.value or self.session.editing:
            return
        if event.phase == "start":
            self._grabbed = Hit(object_id, event.start_position)
        elif event.phase == "end" and (first := self._grabbed) is not None:
            self._grabbed = None
            self.session.submit(lambda: self._drop(first, event))

    def _drop(self, first: Hit, event: viser.SceneNodeDragEvent) -> None:
        current = self.session.current
        if current is None or current.outcome is not None:
            return
        others = [p for p in current.scene.placements if p.id != first.object_id]
        if (hit := hit_of(event, others, self.session.assets)) is not None:
            self._act(first, hit)

    def _click(self, event: viser.SceneClickEvent) -> None:
        """Take the first click, or act with the second."""
        current = self.session.current
        if current is None or current.outcome is not None:
            return
        hit = hit_of(event, current.scene.placements, self.session.assets)
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
        self._own.append(action)
        self.session.step(action)

    def _turn_by(self, degrees: int) -> None:
        self._turn.value = (self._turn.value + degrees + 180) % 360 - 180
        self.session.interrupt(self._preview)

    def _turn_in_place(self) -> None:
        if self._first is not None:
            self._act(self._first, self._first)

    def _undo(self) -> None:
        current = self.session.current
        if current is not None and current.num_steps:
            self.session.back(current.num_steps - 1)

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
            self._nodes.append(self.session.table.add_ghost(_GHOST, placement, pose=pose, grow=1.05))

    def _forget(self) -> None:
        self._first = None
        self._preview()

    def _show(self) -> None:
        current = self.session.current
        if current is not self._episode:
            self._episode, self._own, self._recorded = current, [], ""
        self._forget()
        if current is None:
            return
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
        if solved and self._recorded:
            return self._recorded
        if solved and all(action in self._own for action in actions):
            count = record_demonstration(folder, current.episode, actions, env_config=config)
            self._recorded = f"**Recorded**: {count} demonstration{'s' * (count > 1)} in `{folder}`."
            return self._recorded
        return f"What you solve without a policy is recorded in `{folder}`."
