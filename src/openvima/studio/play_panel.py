"""*Play*: choose an episode and a policy, and step through it."""

import numpy as np
import viser

from openvima.catalog.packs import ASSET_PACKS
from openvima.catalog.partitions import LEVELS
from openvima.policies.bundled import BUNDLED, SMALL
from openvima.render.rasteriser import Rasteriser, front_above_top
from openvima.studio.browser_session import YOU, BrowserSession
from openvima.tasks import list_tasks, sample_episode, task_spec
from openvima.tasks.seeding import MAX_SEED

_FIRST_TASK = "rearrange"
_OTHER = "other …"


class PlayPanel:
    """The tab *Play*."""

    def __init__(self, session: BrowserSession) -> None:
        self.session = session
        gui = session.gui
        with session.tabs.add_tab("Play", viser.Icon.ROBOT):
            self._add_choices(gui)
            self._outcome = gui.add_markdown("")
            self._add_controls(gui)
            self._views = gui.add_image(np.zeros((1, 1, 3), np.uint8), label="what the policy sees")
        session.on_change(self._show)
        session.submit(self._open)

    def _add_choices(self, gui: viser.GuiApi) -> None:
        self._task = gui.add_dropdown("task", list_tasks(), initial_value=_FIRST_TASK)
        self._level = gui.add_dropdown("level", LEVELS, initial_value="train")
        self._seed = gui.add_number("seed", 0, min=0, max=2**53, step=1)
        packs = dict.fromkeys((self.session.config.env_config.assets, *ASSET_PACKS))
        self._assets = gui.add_dropdown("assets", [*packs])
        names = (*BUNDLED, "oracle", "random", YOU, *self.session.config.policies, _OTHER)
        self._name = gui.add_dropdown("policy", names, initial_value=SMALL)
        hint = "run folder, FILE.py:FUNCTION, ws://HOST:PORT, id on the Hub"
        self._source = gui.add_text("source", "", hint=hint, visible=False)
        for choice, work in (
            (self._task, self._open),
            (self._level, self._open),
            (self._seed, self._open),
            (self._assets, self._open),
            (self._name, self._choose_policy),
            (self._source, self._choose_policy),
        ):
            choice.on_update(self.session.callback(work))

    def _add_controls(self, gui: viser.GuiApi) -> None:
        session = self.session
        works = {"step": session.step, "play": session.run, "pause": session.pause}
        session.add_buttons("", {**works, "next seed": self._next_seed})
        session.next_seed = self._next_seed
        self._time = gui.add_slider("after step", 0, 1, 1, 0)
        self._speed = gui.add_slider("speed", 0.25, 8.0, 0.25, 1.0)
        self._time.on_update(session.callback(lambda: session.back(self._time.value)))
        self._speed.on_update(lambda _: setattr(session, "speed", self._speed.value))

    def _choose_policy(self) -> None:
        self._source.visible = self._name.value == _OTHER
        name = self._source.value.strip() if self._source.visible else self._name.value
        if name and name != self.session.policy_name:
            self.session.choose_policy(name)

    def _open(self) -> None:
        """Show the episode before the policy, which takes longer to load."""
        task = self._task.value  # fields can change meanwhile; another call then follows
        levels, level = task_spec(task).levels, self._level.value
        level = level if level in levels else levels[0]
        self._level.options, self._level.value = levels, level
        self.session.choose_assets(self._assets.value)
        config = self.session.env_config
        episode = sample_episode(
            task,
            level=level,
            seed=min(int(self._seed.value), MAX_SEED),
            domain="user",
            assets=self.session.assets,
            compat=config.compat,
            prompts=config.prompts,
            **config.options(task),
        )
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
