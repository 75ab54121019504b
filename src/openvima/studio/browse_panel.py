"""*Browse*: demonstrations of a data folder, and episodes of an evaluation, which are played again live."""

from functools import partial
from pathlib import Path

import numpy as np
import viser

from openvima.catalog import LEVELS, OBJECTS, TEXTURES
from openvima.data import Dataset, Demonstration
from openvima.data.manifest import MANIFEST_NAME
from openvima.data.query import DemonstrationQuery, find_demonstrations
from openvima.env.tabletop import VideoFrame
from openvima.errors import DatasetError, PolicyError
from openvima.evaluation.evaluated_episode import EvaluatedEpisode, evaluated_episode
from openvima.evaluation.results import FILE_NAME, EpisodeOutcome, Results
from openvima.render import channels_last
from openvima.sim.ur5 import HOME
from openvima.studio.browser_session import BrowserSession

_ALL = "any"
_MOST_STEPS = 20
_MOST_LISTED = 500  # episodes of a cell in the list
_NOTHING = np.full((1, 1, 3), 255, np.uint8)


class BrowsePanel:
    """The tab *Browse*.

    Args:
        session: The browser's session.
    """

    def __init__(self, session: BrowserSession) -> None:
        self.session = session
        self._results: tuple[Path, Results] | None = None
        self._cell = ("", "")  # task and level
        self._rows: list[viser.GuiButtonGroupHandle] = []
        self._dataset: Dataset | None = None
        self._found = np.zeros(0, np.int64)
        self._demo: Demonstration | None = None
        gui = session.gui
        with session.tabs.add_tab("Browse", viser.Icon.FOLDER_SEARCH):
            with gui.add_form(None) as form:
                hint = "results folder or data folder; Enter opens it"
                self._path = gui.add_text("folder", str(session.config.path or ""), hint=hint)
            form.on_submit(session.callback(self.open))
            self._title = gui.add_markdown("Open the folder of an evaluation or of demonstrations.")
            self._results_folder = gui.add_folder("Evaluation", visible=False)
            self._data_folder = gui.add_folder("Demonstrations", visible=False)
        with self._results_folder:
            self._add_results_fields(gui)
        with self._data_folder:
            self._add_data_fields(gui)

    def _add_results_fields(self, gui: viser.GuiApi) -> None:
        self._policy = gui.add_dropdown("policy", ["—"])
        self._ablation = gui.add_dropdown("ablation", ["—"])
        self._matrix = gui.add_folder("Success in % by task and level")
        self._failures = gui.add_checkbox("failures only", True)
        self._outcome = gui.add_dropdown("episode", ["—"])
        self._source = gui.add_text("weights", "", hint="run folder; empty: found by the hash of its weights")
        replay = gui.add_button_group("play again", ("live", "recorded actions"))
        self._reason = gui.add_markdown("")
        for choice in (self._policy, self._ablation):
            choice.on_update(self.session.callback(self._show_matrix))
        self._failures.on_update(self.session.callback(self._show_cell))
        self._outcome.on_update(self.session.callback(self._replay))
        works = {"live": self._replay, "recorded actions": self._replay_recorded}
        replay.on_click(self.session.callback(lambda: works[replay.value]()))

    def _add_data_fields(self, gui: viser.GuiApi) -> None:
        self._task = gui.add_dropdown("task", [_ALL])
        self._level = gui.add_dropdown("level", [_ALL, *LEVELS])
        self._object = gui.add_dropdown("object", [_ALL, *OBJECTS])
        self._texture = gui.add_dropdown("texture", [_ALL, *TEXTURES])
        self._steps = gui.add_multi_slider("steps", 0, _MOST_STEPS, 1, (0, _MOST_STEPS))
        self._count = gui.add_markdown("")
        self._number = gui.add_slider("demonstration", 0, 1, 1, 0)
        self._step = gui.add_slider("after step", 0, 1, 1, 0)
        self._caption = gui.add_markdown("")
        self._views = gui.add_image(_NOTHING, label="front, top")
        for choice in (self._task, self._level, self._object, self._texture, self._steps):
            choice.on_update(self.session.callback(self._find))
        self._number.on_update(self.session.callback(self._load))
        self._step.on_update(self.session.callback(self._scrub))

    def open(self) -> None:
        """Open what the path names.

        Raises:
            DatasetError: It is neither a results folder nor a data folder.
        """
        folder = Path(self._path.value).expanduser()
        if (folder / FILE_NAME).is_file() or folder.suffix == ".json":
            self._results, self._dataset = (folder, Results.read(folder)), None
        elif (folder / MANIFEST_NAME).is_file():
            self._results, self._dataset = None, Dataset(folder)
        else:
            raise DatasetError(
                f"{folder} holds neither {FILE_NAME} nor {MANIFEST_NAME}; give another folder."
            )
        self._results_folder.visible = self._results is not None
        self._data_folder.visible = self._dataset is not None
        if self._results is not None:
            results = self._results[1]
            self._title.content = f"`{folder}`: {sum(row.episodes for row in results.rows):,} episodes"
            self._policy.options = results.policy_names()
            self._ablation.options = list(dict.fromkeys(row.ablation or "—" for row in results.rows))
            self._show_matrix()
        if self._dataset is not None:
            self._title.content = f"`{folder}`: {len(self._dataset):,} demonstrations"
            self._task.options = [_ALL, *self._dataset.manifest["tasks"]]
            self._find()

    def _rows_of_choice(self) -> dict[tuple[str, str], float]:
        """Success rate by task and level, of the chosen policy and ablation."""
        assert self._results is not None  # as opened
        chosen = self._policy.value, self._ablation.value
        rows = self._results[1].rows
        return {(r.task, r.level): r.rate for r in rows if (r.policy, r.ablation or "—") == chosen}

    def _show_matrix(self) -> None:
        """Show a row of buttons for each task, one for each level."""
        for group in self._rows:
            group.remove()
        rates, self._rows = self._rows_of_choice(), []
        with self._matrix:
            for task in dict.fromkeys(task for task, _ in rates):
                levels = {
                    f"{level} {100 * rate:.0f}": level for (t, level), rate in rates.items() if t == task
                }
                group = self.session.gui.add_button_group(task.replace("_", " "), list(levels))
                chosen = partial(self._choose_cell, task, levels, group)
                group.on_click(self.session.callback(chosen))
                self._rows.append(group)
        if rates:
            self._cell = next(iter(rates))
            self._show_cell()

    def _choose_cell(self, task: str, levels: dict[str, str], group: viser.GuiButtonGroupHandle) -> None:
        self._cell = task, levels[group.value]
        self._show_cell()

    def _show_cell(self) -> None:
        """List the episodes of a cell."""
        listed = [
            f"{outcome.seed}: {'solved' if outcome.success else outcome.reason}"
            for outcome in self._outcomes()
            if not (outcome.success and self._failures.value)
        ]
        self._outcome.options = listed[:_MOST_LISTED] or ["—"]
        task, level = self._cell
        self._reason.content = f"**{task}, {level}**: {len(listed)} episodes" + (
            " failed." if self._failures.value else "."
        )

    def _outcomes(self) -> tuple[EpisodeOutcome, ...]:
        assert self._results is not None  # as opened
        row = self._results[1].row(self._policy.value, *self._cell, self._chosen_ablation)
        return () if row is None else row.outcomes

    @property
    def _chosen_ablation(self) -> str:
        return "" if self._ablation.value == "—" else self._ablation.value

    def _evaluated(self) -> EvaluatedEpisode:
        """Return the chosen episode.

        Raises:
            DatasetError: None is chosen.
        """
        seed = self._outcome.value.partition(":")[0]
        if self._results is None or not seed.isdigit():
            raise DatasetError("no episode is chosen; choose a cell and an episode.")
        return evaluated_episode(
            self._results[0],
            self._policy.value,
            *self._cell,
            int(seed),
            ablation=self._chosen_ablation,
            source=self._source.value.strip() or None,
            trust_code=self.session.config.trust_code,
        )

    def _replay(self) -> None:
        """Play an episode again with its policy, or with its recorded actions where nobody has the policy."""
        found = self._evaluated()
        self._show_outcome(found)
        try:
            policy = found.load_policy()
        except PolicyError as error:
            self.session.warn(str(error))
            self._replay_recorded()
            return
        self.session.open(found.sample(), policy, compat=found.batch.env_config.compat)
        self.session.run()

    def _replay_recorded(self) -> None:
        found = self._evaluated()
        self._show_outcome(found)
        if found.actions is None:
            raise DatasetError("the evaluation kept no actions; name the policy's weights to play it again.")
        self.session.open(found.sample(), None, compat=found.batch.env_config.compat)
        for action in found.actions:
            if self.session.is_paused() or not self.session.step(action):
                return

    def _show_outcome(self, found: EvaluatedEpisode) -> None:
        outcome, batch = found.outcome, found.batch
        ended = "solved" if outcome.success else f"not solved: {outcome.reason}"
        steps = f"{outcome.steps} step{'s' * (outcome.steps != 1)}"
        self._reason.content = f"**{batch.task}, {batch.level}, seed {batch.first_seed}**: {ended} ({steps})."

    def _find(self) -> None:
        """Find the demonstrations that the fields ask for."""
        assert self._dataset is not None  # as opened
        chosen = {"task": self._task, "level": self._level, "object": self._object, "texture": self._texture}
        fields = {name: field.value for name, field in chosen.items() if field.value != _ALL}
        fewest, most = (int(value) for value in self._steps.value)
        query = DemonstrationQuery(
            **fields, min_steps=fewest, max_steps=None if most == _MOST_STEPS else most
        )
        self._found = find_demonstrations(self._dataset, query)
        self._count.content = f"{len(self._found):,} of {len(self._dataset):,} found"
        self._number.max = max(1, len(self._found) - 1)
        self._number.value = 0
        self._load()

    def _load(self) -> None:
        """Read the chosen demonstration."""
        number = int(self._number.value)
        if self._dataset is None or number >= len(self._found):
            self._demo, self._caption.content = None, ""
            self._views.image = _NOTHING
            return
        demo = self._demo = self._dataset[int(self._found[number])]
        self._step.max = max(1, demo.num_steps)
        self._step.value = 0
        self._scrub()

    def _scrub(self) -> None:
        """Show the scene after some steps."""
        demo = self._demo
        if demo is None:
            return
        step = min(int(self._step.value), demo.num_steps)
        self._views.image = np.concatenate([channels_last(images[step]) for images in demo.rgb.values()])
        ended = "solved" if demo.outcome.success else f"not solved: {demo.outcome.reason}"
        self._caption.content = (
            f"**{demo.task}**, {demo.level}, {demo.domain} seed {demo.seed}: "
            f"step {step} of {demo.num_steps}, {ended}"
        )
        if self.session.current is not None:
            self.session.close_episode()
            self.session.changed()
        self.session.show_prompt(demo.prompt)
        if demo.scenes:
            joints = demo.joint_paths[step - 1][-1] if step and demo.joint_paths else HOME
            self.session.table.show(VideoFrame(demo.scenes[step], joints))
