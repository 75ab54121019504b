"""The Gymnasium environment: one task, one arm, one table."""

import copy
import inspect
from collections import UserDict
from collections.abc import Iterable, Iterator, Mapping
from functools import cached_property
from pathlib import Path
from typing import Any  # observations and infos are nested dictionaries

import gymnasium
import numpy as np
from gymnasium import spaces

from openvima.catalog.geometry import Assets
from openvima.catalog.packs import load_assets
from openvima.env.episode_file import episode_from_values, load_episode
from openvima.env.running_episode import (
    RUNS,
    PrimitiveRun,
    ToolRun,
    VideoFrame,
)
from openvima.errors import ConfigError, EpisodeError, unknown_name
from openvima.html import notebook_html
from openvima.render.camera import VIEWS, View
from openvima.render.rasteriser import Image, Rasteriser, front_above_top
from openvima.scene import (
    ACTION_SHAPES,
    END_EFFECTORS,
    WORKSPACE_HIGH,
    WORKSPACE_LOW,
    Action,
    Episode,
    Outcome,
    RenderedPrompt,
    Scene,
)
from openvima.scene.action import (
    COMMAND_HIGH,
    COMMAND_LOW,
    CONTROL_HZ,
    END_EFFECTOR,
    PRIMITIVES,
    ToolCommand,
    check_control,
    steps_per_primitive,
)
from openvima.sim.arm_view import arm_drawables
from openvima.sim.ur5 import JOINT_LIMITS
from openvima.tasks import goals, sample_episode, task_spec
from openvima.tasks.goals import Progress
from openvima.tasks.oracle import OracleDecision, oracle_action
from openvima.tasks.sampling import check_text_form, checked_seed, make_rng

IMAGE_SHAPE = (128, 256)  # rows, columns; the cameras are tuned for this size
MODALITIES = ("rgb", "segm", "depth", "joints")
DEFAULT_MODALITIES = ("rgb", "segm")
_TOOL_LOW = np.array([0.0, -1.0, 0.0, -4 * np.pi, 0.0], np.float32)
_TOOL_HIGH = np.array([1.0, 1.0, 0.5, 4 * np.pi, 1.0], np.float32)
_LARGEST_SEED = 2**31  # of the seeds that a reset without one draws


class TabletopEnv(gymnasium.Env[dict[str, Any], Any]):
    """A UR5 arm at a table, with a multimodal prompt, two cameras, and pick-and-place or sweep actions.

    **Observation** — a dictionary; the cameras `front` and `top` are fixed. `ee` and what `modalities` names:

    | key | shape, dtype | meaning |
    |---|---|---|
    | `rgb` / view | (3, 128, 256) uint8 | red, green, blue; row 0 on top |
    | `segm` / view | (128, 256) uint8 | object id of each pixel: 0 floor, 1 table sheet, 255 nothing |
    | `depth` / view | (128, 256) float32 | metres from the camera plane, along the optical axis |
    | `joints` | (6,) float32 | joint angles of the arm, base to wrist, radians |
    | `ee` | int | 0 suction cup, 1 spatula |

    **Action** — a dictionary; all four keys, float32 (any floating-point dtype is taken).

    | key | shape | range |
    |---|---|---|
    | `pose0_position`, `pose1_position` | (2,) | x 0.25 … 0.75 m, y −0.5 … 0.5 m |
    | `pose0_rotation`, `pose1_rotation` | (4,) | quaternion xyzw, each −1 … 1; only its yaw matters |

    With the suction cup a step picks at pose0 and places at pose1, the object turned by the difference of
    yaw. With the spatula it sweeps in a straight line from pose0 to pose1. An invalid action raises
    `ActionError` and changes nothing.

    With control "end_effector" a step is 0.1 s, and an action five numbers; see `control` below.

    **Reward** — 1.0 on the step that solves the task, else 0.0.

    **End** — `terminated` on success or failure; `truncated` after `episode.max_steps` steps otherwise, with
    control "end_effector" after 10 s for each of them.

    **Info** — after `reset` and `step`: `prompt` (text with a `{placeholder}` for each image),
    `prompt_ambiguous` (descriptions in it fit objects that the replaced images differ from), `success`,
    `failure`, `reason` (why it ended, or empty), `progress` (`goals_met`, a fraction of those required, and
    `distance_m` and `angle_rad` of the nearest goal that can be met next, infinite if goals state none),
    `grasped` (id of the object that the last step lifted, or 0), `num_steps`, `joints` (as in observations),
    `task`, `level`, `domain`, `seed`, `end_effector`, and `objects` (id to the names of object and texture).
    The images of the prompt are in `prompt`, an attribute.

    **Start** — `reset(seed=k)` starts episode k of the environment's domain, task and level: always
    the same bytes. `reset()` draws the next number from the environment's generator.
    `reset(options={"episode": episode})` loads a sampled or composed episode, or a file of one.

    Version history:
        v1: Sweeps leave bodies out of reach out of the physics and carry aligned ones farther, for speed:
            swept bodies end elsewhere by 1.1 mm in the median. The suction cup grasps a free body up to 2 mm
            beside it before it reaches the fixed body below, as VIMA-Bench's does. Episodes are sampled, and
            all other actions executed, as in v0.
        v0: First version.

    Args:
        task: Name of the task, such as "rotate".
        level: one of `openvima.catalog.LEVELS`: generalization level. By default
            "train", or the only level of a task held out for L4.
        domain: "train", "eval" or "user"; equal seeds of two domains are unrelated.
        assets: "procedural", the folder of the original asset pack, MODULE:FUNCTION or FILE.py:FUNCTION that
            registers assets of your own, or an object with shapes and textures.
        compat: Reproduce VIMA-Bench's quirks: objects hover at the start, ids follow the order of
            spawning, the oracle picks any visible point.
        prompts: "multimodal", as published; "text": a description such as "the red swirl letter A" in place
            of each object image; "mixed": in place of each with probability ½. "text,paraphrased" and
            "mixed,paraphrased" use synonyms. Images of scenes stay, and so do prompts of episodes that
            `reset` is given.
        hide_arm: Leave arm and tool out of the images, as in all published data; else they are ids 2 to 4.
        realtime: Record `frames`, 30 a second, while a step runs.
        render_mode: None, or "rgb_array": `render` returns both views, front above top, for videos with
            `metadata["render_fps"]` frames a second: 10 with control "end_effector", the true rate, else 1.
        modalities: What observations hold besides `ee`: of "rgb", "segm", "depth" and "joints".
        control: "primitives", or "end_effector": a step is 0.1 s, an action a float32 array of five numbers,
            dx, dy, dz in metres, dyaw in radians, and above 0.5 for suction, or the spatula's contact.
            Observations hold `tool` too: x, y, z, yaw, and 1 while it holds; see docs/end_effector.md.
        **task_options: Arguments of the task.

    Raises:
        UnknownTaskError: There is no such task.
        ConfigError: The task is not defined at the level.
        ConfigError: The domain, the prompts, the render mode, a modality, the control or an option of the
            task is invalid, or the task has no text form.
    """

    # `render` shows the end of a step: at one a second a video of primitives can be followed.
    metadata = {"render_modes": ["rgb_array"], "render_fps": 1}  # noqa: RUF012  as in the base

    def __init__(
        self,
        task: str,
        *,
        level: str | None = None,
        domain: str = "user",
        assets: str | Path | Assets = "procedural",
        compat: bool = False,
        prompts: str = "multimodal",
        hide_arm: bool = True,
        realtime: bool = False,
        render_mode: str | None = None,
        modalities: Iterable[str] = DEFAULT_MODALITIES,
        control: str = PRIMITIVES,
        **task_options: Any,
    ) -> None:
        modes = self.metadata["render_modes"]
        if render_mode is not None and render_mode not in modes:
            raise ConfigError(f"render_mode is {render_mode!r}; allowed are None and {', '.join(modes)}.")
        self.task = task
        self.level = task_spec(task).checked_level(level)
        parameters = inspect.signature(TabletopEnv.__init__).parameters.values()
        others = [each.name for each in parameters if each.kind is each.KEYWORD_ONLY]
        task_spec(task).check_options(task_options, others)
        make_rng(domain, task, self.level, 0, purpose="scene")  # checks the domain
        self.domain = domain
        self.assets = load_assets(assets)
        self.compat = compat
        check_text_form(task, prompts)
        self.prompts = prompts
        self.hide_arm = hide_arm
        self.realtime = realtime
        self.render_mode = render_mode
        self.task_options = task_options
        check_control(control)
        self.control = control
        if control == END_EFFECTOR:
            self.metadata = {**self.metadata, "render_fps": CONTROL_HZ}
        self.modalities = modalities
        self.action_space = _action_space(control)
        self._rasteriser = Rasteriser(self.assets)
        self._run: PrimitiveRun | None = None
        self._prepared: tuple[dict[str, Any], PrimitiveRun] | None = None  # what it depends on, and itself

    def __repr__(self) -> str:
        run = self._run
        state = "no episode" if run is None else f"seed {run.episode.seed}, step {run.num_steps}"
        return f"TabletopEnv({self.task!r}, level={self.level!r}, domain={self.domain!r}; {state})"

    def _repr_html_(self) -> str | None:
        facts, run = [self.task, f"level {self.level}"], self._run
        if run is None:
            facts.append("no episode: call reset()")
            return notebook_html("environment", facts=facts, prompt=None)
        over = run.outcome.reason or ("solved" if run.outcome.success else "")
        facts += [f"{run.episode.domain} seed {run.episode.seed}", f"step {run.num_steps}", over]
        views = {view: image.rgb for view, image in self._images().items()}
        return notebook_html("environment", facts=facts, prompt=self.prompt, views=views)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Start an episode.

        Args:
            seed: The episode's number; None draws one from the environment's generator.
            options: May hold "episode", to load instead of sampling one: an `Episode`, a YAML or JSON file of
                one, or the values of such a file.

        Returns:
            The first observation, and the info.

        Raises:
            SamplingError: The task finds no start for this seed; no episode is running then.
            InputFileError, SceneError: The episode's file or values are not valid.
            ConfigError: An option is unknown, or the seed is not an integer from 0 to 2**63 - 1.
        """
        seed = None if seed is None else checked_seed(seed)
        given = _episode_option(options, self.assets)
        super().reset(seed=seed)
        self._run = None  # no running episode should the rest fail
        prepared, self._prepared = self._prepared, None
        if given is None:
            seed = _draw_seed(self.np_random) if seed is None else seed
            settings = self._settings(seed)
            self._run = prepared[1] if prepared and prepared[0] == settings else self._build(settings)
        else:
            self._run = RUNS[self.control](given, self.assets, self.compat)
        return self.observe(), self._info()

    def prepare(self, seed: int | None = None) -> None:
        """Build an episode ahead of the `reset` that starts it, for use of idle time.

        Only the duration of that `reset` changes. If the next one starts another episode, or settings of
        the environment are assigned in between, the episode is discarded.

        Args:
            seed: The seed that `reset` will get.

        Raises:
            SamplingError: The task finds no start for this seed.
            ConfigError: The seed is not an integer from 0 to 2**63 - 1.
        """
        seed = _draw_seed(copy.deepcopy(self.np_random)) if seed is None else checked_seed(seed)
        settings = self._settings(seed)
        self._prepared = settings, self._build(settings)

    def step(
        self, action: Mapping[str, Any] | Action | np.ndarray | ToolCommand
    ) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """Execute one primitive and let all objects come to rest; or follow one command for 0.1 s.

        Args:
            action: The four arrays, or an `Action`; with control "end_effector" the five numbers, or a
                `ToolCommand`.

        Returns:
            Observation, reward, terminated, truncated, info; see the class.

        Raises:
            EpisodeError: No episode is running.
            ActionError: The action is invalid; nothing was moved.
        """
        after = self.advance(action)
        return self.observe(), *after

    def advance(
        self, action: Mapping[str, Any] | Action | np.ndarray | ToolCommand
    ) -> tuple[float, bool, bool, dict[str, Any]]:
        """Step without rendering, where nobody reads the observation; `observe` returns it.

        Args:
            action: As for `step`.

        Returns:
            Reward, terminated, truncated, info.

        Raises:
            EpisodeError, ActionError: As for `step`.
        """
        run = self._going_on()
        run.step(run.checked(action))
        return self._after_step(run)

    def perform(self, action: Action) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """Execute a primitive under either control: as one step, or as the commands that it consists of.

        Args:
            action: The primitive.

        Returns:
            As for `step`; `joint_path` and `frames` are those of the whole primitive.

        Raises:
            EpisodeError: No episode is running.
        """
        run = self._going_on()
        run.perform(action)
        return self.observe(), *self._after_step(run)

    def commands(self, action: Action) -> Iterator[ToolCommand]:
        """Yield the commands of a primitive, each to be executed by `step` before the next; none at the end.

        Raises:
            ConfigError: The control is not "end_effector".
            EpisodeError: No episode is running.
        """
        return self._tool_run().commands(action)

    def _going_on(self) -> PrimitiveRun:
        run = self._running()
        if run.outcome.is_over or run.is_out_of_steps:
            raise EpisodeError(f"the episode ended at step {run.num_steps}; reset() starts the next one.")
        run.realtime = self.realtime
        return run

    def _after_step(self, run: PrimitiveRun) -> tuple[float, bool, bool, dict[str, Any]]:
        terminated = run.outcome.is_over
        truncated = run.is_out_of_steps and not terminated
        reward = 1.0 if run.outcome.success else 0.0
        return reward, terminated, truncated, self._info()

    def observe(self) -> dict[str, Any]:
        """Return the current observation, rendered anew.

        Raises:
            EpisodeError: There is no episode yet.
        """
        seen = {name for name in self._modalities if name != "joints"}
        images = self._images(depth="depth" in seen) if seen else {}
        values = {
            name: {view: getattr(images[view], name) for view in VIEWS} if name in seen else self.joints
            for name in self._modalities
        }
        tool = self._running().observed_tool()
        return {**values, **tool, "ee": END_EFFECTORS.index(self.scene.end_effector)}

    def render(self) -> np.ndarray | None:  # type: ignore[override]  # Gymnasium leaves the type open
        """Return both views, front above top, shape (256, 256, 3), uint8; None without a render mode.

        Raises:
            EpisodeError: There is no episode yet.
        """
        if self.render_mode is None:
            return None
        return front_above_top(self._images())

    def close(self) -> None:
        """Free the simulation; `reset` starts it again."""
        self._run = self._prepared = None

    def oracle_decision(self) -> OracleDecision:
        """Return the next action of the scripted oracle, from the scene when it was last at rest.

        Raises:
            EpisodeError: There is no episode yet.
            OracleError: The oracle has no action.
        """
        run = self._running()
        return oracle_action(
            run.episode.problem,
            run.progress,
            run.scene_at_rest,
            assets=self.assets,
            rng=run.oracle_rng,
            compat=self.compat,
        )

    def oracle_command(self) -> ToolCommand:
        """Return the oracle's next command, for control "end_effector".

        It continues the path of its primitive as long as its commands are executed; from any other state it
        plans a path anew, so it labels the states of a policy too.

        Raises:
            ConfigError: The control is another.
            EpisodeError, OracleError: As for `oracle_decision`.
        """
        return self._tool_run().oracle_command(self.oracle_decision)

    @property
    def oracle_max_steps(self) -> int:
        """Step limit of the oracle, in steps of this control."""
        return self.episode.oracle_max_steps * steps_per_primitive(self.control)

    @property
    def modalities(self) -> tuple[str, ...]:
        """What observations hold besides `ee`; `observation_space` follows what is assigned.

        Raises:
            ConfigError: A modality is unknown.
        """
        return self._modalities

    @modalities.setter
    def modalities(self, names: Iterable[str]) -> None:
        names = (names,) if isinstance(names, str) else tuple(names)
        if unknown := [name for name in names if name not in MODALITIES]:
            raise ConfigError(unknown_name("modality", unknown[0], MODALITIES))
        self._modalities = tuple(name for name in MODALITIES if name in names)
        self.__dict__.pop("observation_space", None)

    @cached_property
    def observation_space(self) -> spaces.Dict:  # type: ignore[override]  # computed when it is asked for
        """Space of the observations; an evaluation spent 4 % of its time on building the bounds of images."""
        return _observation_space(self._modalities, self.control)

    @property
    def episode(self) -> Episode:
        """The running episode."""
        return self._running().episode

    @property
    def prompt(self) -> RenderedPrompt:
        """The prompt: text and rendered images; `prompt.sequence()` interleaves them."""
        run = self._running()
        if run.prompt is None:
            run.prompt = self._rasteriser.prompt(run.episode.problem.prompt)
        return run.prompt

    @property
    def scene(self) -> Scene:
        """The current scene, privileged information that a policy must not use."""
        return self._running().world.scene

    @property
    def progress(self) -> Progress:
        """Open goals and violated constraints."""
        return self._running().progress

    @property
    def outcome(self) -> Outcome:
        """Success, failure, or neither yet."""
        return self._running().outcome

    @property
    def joints(self) -> np.ndarray:
        """Joint angles of the arm, base to wrist, shape (6,), float32, radians."""
        return self._running().world.joints.astype(np.float32)

    @property
    def tool(self) -> np.ndarray:
        """The tool, for control "end_effector": x, y, z in metres, yaw in radians, and 1 while it holds.

        Raises:
            ConfigError: The control is another.
        """
        return self._tool_run().observed_tool()["tool"]

    @property
    def joint_path(self) -> np.ndarray:
        """Waypoints of the arm in the last step, shape (W, 6), float32, radians."""
        return self._running().joint_path

    @property
    def frames(self) -> tuple[VideoFrame, ...]:
        """Video frames of the last step, 30 a second; empty unless `realtime`."""
        return tuple(self._running().frames)

    def _running(self) -> PrimitiveRun:
        if self._run is None:
            raise EpisodeError("there is no episode yet; call reset() first.")
        return self._run

    def _tool_run(self) -> ToolRun:
        run = self._running()
        if not isinstance(run, ToolRun):
            raise ConfigError(f"control is {self.control!r}; commands need control {END_EFFECTOR!r}.")
        return run

    def _settings(self, seed: int) -> dict[str, Any]:
        """All that the start of an episode depends on."""
        names = ("task", "level", "domain", "assets", "compat", "prompts", "control")
        options = copy.deepcopy(self.task_options)
        return {"seed": seed, **{name: getattr(self, name) for name in names}, **options}

    def _build(self, settings: dict[str, Any]) -> PrimitiveRun:
        sampling = {name: value for name, value in settings.items() if name != "control"}
        return RUNS[self.control](sample_episode(**sampling), self.assets, self.compat)

    def _images(self, *, depth: bool = False) -> dict[View, Image]:
        world = self._running().world
        scene = world.scene
        arm = () if self.hide_arm else arm_drawables(world.joints, scene.end_effector)
        return self._rasteriser.scene(scene, extra=arm, depth=depth)

    def _info(self) -> dict[str, Any]:
        run = self._running()
        episode, problem = run.episode, run.episode.problem
        return {
            "prompt": problem.prompt.text,
            "prompt_ambiguous": problem.prompt.is_ambiguous,
            "success": run.outcome.success,
            "failure": run.outcome.failure,
            "reason": run.outcome.reason,
            "progress": goals.measure(problem, run.progress, run.world.scene),
            "grasped": run.grasped or 0,  # never None: vector environments collect numbers in arrays
            "num_steps": run.num_steps,
            "joints": self.joints,
            "task": episode.task,
            "level": episode.level,
            "domain": episode.domain,
            "seed": episode.seed,
            "end_effector": problem.scene.end_effector,
            # Not a dictionary: Gymnasium's vector environments split those and require string keys.
            "objects": UserDict(
                {p.id: {"object": p.object, "texture": p.texture} for p in problem.scene.placements}
            ),
        }


def _observation_space(modalities: tuple[str, ...], control: str) -> spaces.Dict:
    images = {
        "rgb": spaces.Box(0, 255, (3, *IMAGE_SHAPE), np.uint8),
        "segm": spaces.Box(0, 255, IMAGE_SHAPE, np.uint8),
        "depth": spaces.Box(0, np.inf, IMAGE_SHAPE, np.float32),
    }
    limits = JOINT_LIMITS.astype(np.float32)
    known: dict[str, spaces.Space] = {
        **{name: spaces.Dict(dict.fromkeys(VIEWS, space)) for name, space in images.items()},
        "joints": spaces.Box(-limits, limits, dtype=np.float32),
    }
    ee = spaces.Discrete(len(END_EFFECTORS))
    tool = {"tool": spaces.Box(_TOOL_LOW, _TOOL_HIGH, dtype=np.float32)} if control == END_EFFECTOR else {}
    return spaces.Dict({**{name: known[name] for name in modalities}, **tool, "ee": ee})


def _action_space(control: str) -> spaces.Space:
    if control == END_EFFECTOR:
        return spaces.Box(np.array(COMMAND_LOW, np.float32), np.array(COMMAND_HIGH, np.float32))
    position = (np.array(WORKSPACE_LOW, np.float32), np.array(WORKSPACE_HIGH, np.float32))
    rotation = (np.full(4, -1, np.float32), np.full(4, 1, np.float32))
    bounds = {"position": position, "rotation": rotation}
    return spaces.Dict(
        {key: spaces.Box(*bounds[key.split("_")[1]], dtype=np.float32) for key in ACTION_SHAPES}
    )


def _draw_seed(rng: np.random.Generator) -> int:
    return int(rng.integers(_LARGEST_SEED))


def reset_option(options: object, name: str) -> Any:
    """Return the one option that a reset takes, or None.

    Args:
        options: None, or a mapping with the option or nothing.
        name: The option.

    Raises:
        ConfigError: The options are no mapping, or there is another one.
    """
    if not isinstance(options, Mapping | None):
        raise ConfigError(f"options is a {type(options).__name__}; give None or a mapping with {name!r}.")
    if unknown := set(options or ()) - {name}:
        raise ConfigError(f"reset has no option {', '.join(sorted(map(str, unknown)))}; it takes {name!r}.")
    return (options or {}).get(name)


def _episode_option(options: object, assets: Assets) -> Episode | None:
    episode = reset_option(options, "episode")
    if isinstance(episode, str | Path):
        return load_episode(episode, assets=assets)
    if isinstance(episode, Mapping):
        return episode_from_values(episode, assets=assets)
    if not isinstance(episode, Episode | None):
        raise ConfigError(f"option 'episode' is {episode!r}; give an Episode, a file or the values of one.")
    return episode
