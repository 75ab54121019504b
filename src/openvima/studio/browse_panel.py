"""*Browse*: demonstrations of a data folder, and episodes of an evaluation, which are played again live."""

from functools import partial
from pathlib import Path

import numpy as np
import viser

from openvima.catalog import LEVELS, OBJECTS, TEXTURES
from openvima.data import Dataset, Demonstration
from openvima.data.manifest import MANIFEST_NAME
from openvima.data.reader import find_demonstrations
from openvima.env.tabletop import VideoFrame
from openvima.errors import DatasetError, PolicyError
from openvima.evaluation.evaluated_episode import evaluated_episode
from openvima.evaluation.results import FILE_NAME, Results
from openvima.input_files import as_path
from openvima.render import channels_last
from openvima.sim.ur5 import HOME
from openvima.studio.browser_session import BrowserSession

_ALL, _NONE = "any", "—"
_MOST_STEPS = 20
_MOST_LISTED = 500  # episodes of a cell in the list
_NOTHING = np.full((1, 1, 3), 255, np.uint8)


class BrowsePanel:
    """The tab *Browse*."""

    _results: tuple[Path, Results]  # as opened
    _dataset: Dataset

    def __init__(self, session: BrowserSession) -> None:
        self.session = session
        self._cell = ("", "")  # task and level
        self._rows: list[viser.GuiButtonGroupHandle] = []
        self._found = np.zeros(0, np.int64)
        self._demo: Demonstration | None = None
        gui = session.gui
        with session.tabs.add_tab("Browse", viser.Icon.FOLDER_SEARCH):
            with gui.add_form(None) as form:
                hint = "results folder or data folder; Enter opens it"
                self._path = gui.add_text("folder", str(session.config.path or ""), hint=hint)
            form.on_submit(session.callback(self.open))
            self._title = gui.add_markdown("Open the folder of an evaluation or of demonstrations.")
            with gui.add_folder("Evaluation", visible=False) as self._results_folder:
                self._policy = gui.add_dropdown("policy", [_NONE])
                self._ablation = gui.add_dropdown("ablation", [_NONE])
                self._matrix = gui.add_folder("Success in % by task and level")
                self._failures = gui.add_checkbox("failures only", True)
                self._outcome = gui.add_dropdown("episode", [_NONE])
                hint = "run folder; empty: found by the hash of its weights"
                self._source = gui.add_text("weights", "", hint=hint)
                session.add_buttons("play again", {"live": self._replay})
                self._reason = gui.add_markdown("")
            with gui.add_folder("Demonstrations", visible=False) as self._data_folder:
                choices = {"task": (), "level": LEVELS, "object": OBJECTS, "texture": TEXTURES}
                self._choices = {
                    name: gui.add_dropdown(name, [_ALL, *known]) for name, known in choices.items()
                }
                self._steps = gui.add_multi_slider("steps", 0, _MOST_STEPS, 1, (0, _MOST_STEPS))
                self._count = gui.add_markdown("")
                self._number = gui.add_slider("demonstration", 0, 1, 1, 0)
                self._step = gui.add_slider("after step", 0, 1, 1, 0)
                self._caption = gui.add_markdown("")
                self._views = gui.add_image(_NOTHING, label="front, top")
        session.on_update(self._show_matrix, self._policy, self._ablation)
        session.on_update(self._show_cell, self._failures)
        session.on_update(self._replay, self._outcome)
        session.on_update(self._find, *self._choices.values(), self._steps)
        session.on_update(self._load, self._number)
        session.on_update(self._scrub, self._step)

    def open(self) -> None:
        """Open what the path names.

        Raises:
            DatasetError: It is neither a results folder nor a data folder.
        """
        folder = as_path(self._path.value)
        if is_evaluation := (folder / FILE_NAME).is_file() or folder.suffix == ".json":
            results = Results.read(folder)
            self._results = folder, results
            self._title.content = f"`{folder}`: {sum(row.episodes for row in results.rows):,} episodes"
            self._policy.options = results.policy_names()
            self._ablation.options = list(dict.fromkeys(row.ablation or _NONE for row in results.rows))
            self._show_matrix()
        elif (folder / MANIFEST_NAME).is_file():
            dataset = self._dataset = Dataset(folder)
            self._title.content = f"`{folder}`: {len(dataset):,} demonstrations"
            self._choices["task"].options = [_ALL, *dataset.manifest["tasks"]]
            self._find()
        else:
            raise DatasetError(
                f"{folder} holds neither {FILE_NAME} nor {MANIFEST_NAME}; give another folder."
            )
        self._results_folder.visible = is_evaluation
        self._data_folder.visible = not is_evaluation

    def _show_matrix(self) -> None:
        """Show a row of buttons for each task, one for each level."""
        for group in self._rows:
            group.remove()
        rates: dict[str, dict[str, float]] = {}  # by task and level
        for row in self._results[1].rows:
            if (row.policy, row.ablation) == (self._policy.value, self._chosen_ablation):
                rates.setdefault(row.task, {})[row.level] = row.rate
        self._rows = []
        with self._matrix:
            for task, by_level in rates.items():
                cells = {
                    f"{level} {100 * rate:.0f}": partial(self._show_cell, task, level)
                    for level, rate in by_level.items()
                }
                self._rows.append(self.session.add_buttons(task.replace("_", " "), cells))
        if rates:
            task = next(iter(rates))
            self._show_cell(task, next(iter(rates[task])))

    def _show_cell(self, task: str = "", level: str = "") -> None:
        """List the episodes of a cell; by default of that in view."""
        task, level = self._cell = (task, level) if task else self._cell
        row = self._results[1].row(self._policy.value, task, level, self._chosen_ablation)
        outcomes = () if row is None else row.outcomes
        kept = [o for o in outcomes if not (o.success and self._failures.value)]
        listed = [f"{o.seed}: {'solved' if o.success else o.reason}" for o in kept[:_MOST_LISTED]]
        self._outcome.options = listed or [_NONE]
        failed = sum(not outcome.success for outcome in outcomes)
        self._reason.content = f"**{task}, {level}**: {failed} of {len(outcomes)} episodes failed."

    @property
    def _chosen_ablation(self) -> str:
        return "" if self._ablation.value == _NONE else self._ablation.value

    def _replay(self) -> None:
        """Play an episode again, with its policy or with its actions where the policy is not found.

        Raises:
            DatasetError: None is chosen.
        """
        seed = self._outcome.value.partition(":")[0]
        if not seed.isdigit():
            raise DatasetError("no episode is chosen; choose a cell and an episode.")
        found = evaluated_episode(
            self._results[0],
            self._policy.value,
            *self._cell,
            int(seed),
            ablation=self._chosen_ablation,
            source=self._source.value.strip() or None,
            trust_code=self.session.config.trust_code,
        )
        try:
            policy = found.load_policy()
        except PolicyError as error:
            self.session.warn(str(error))
            policy = found.recorded_policy()
        self._reason.content = f"**Recorded**: {found}."
        self.session.choose_assets(found.batch.env_config.assets)
        self.session.open(found.sample(), policy, compat=found.batch.env_config.compat)
        self.session.run()

    def _find(self) -> None:
        """Find the demonstrations that the fields ask for."""
        fields = {name: field.value for name, field in self._choices.items() if field.value != _ALL}
        fewest, most = (int(value) for value in self._steps.value)
        limit = None if most == _MOST_STEPS else most
        self._found = find_demonstrations(self._dataset, **fields, min_steps=fewest, max_steps=limit)
        self._count.content = f"{len(self._found):,} of {len(self._dataset):,} found"
        self._number.max = max(1, len(self._found) - 1)
        self._number.value = 0
        self._load()

    def _load(self) -> None:
        """Read the chosen demonstration."""
        number = int(self._number.value)
        if number >= len(self._found):
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
