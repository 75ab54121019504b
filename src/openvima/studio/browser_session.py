"""What one browser sees and does: the table in 3D, the episode in view, and a thread that works on it."""

import logging
import threading
import time
from collections.abc import Callable, Coroutine, Iterable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any  # of coroutines and fields

import numpy as np
import viser

from openvima.catalog.geometry import Assets
from openvima.catalog.packs import load_assets
from openvima.env.config import DEFAULT_ENV_CONFIG, EnvConfig
from openvima.env.running_episode import VideoFrame
from openvima.errors import OpenVimaError, SceneError
from openvima.evaluation.config import DEFAULT_DEVICE
from openvima.evaluation.rollout_policies import RolloutPolicy, load_own_rollout_policy
from openvima.evaluation.session import EpisodeSession
from openvima.render.gltf import Shape, coloured_glb, object_glb
from openvima.render.rasteriser import SHEET_RGB, SHEET_SIZE
from openvima.render.raycast import TABLE, Hit, first_hit
from openvima.scene import Action, EndEffector, Episode, Placement, Pose, RenderedPrompt, Scene
from openvima.sim.arm_view import arm_parts
from openvima.sim.primitive_state import FRAMES_PER_SECOND
from openvima.sim.ur5 import link_frames
from openvima.tasks.pushes import Push
from openvima.video.explanation import PLACE
from openvima.video.prompt_strip import Colour, draw_prompt_strip


def clicked_action(scene: Scene, first: Hit, second: Hit, *, turn_rad: float = 0.0) -> Action:
    """Return the action of two clicks.

    Args:
        scene: The scene that was clicked.
        first: What to pick. With the spatula: the block to sweep, behind which the sweep then starts, or the
            point of the table where it starts.
        second: Where to place, or where the sweep ends.
        turn_rad: Rotation of the picked object, counter-clockwise seen from above; sweeps have none.

    Raises:
        SceneError: The first click of a pick is on no object, or on one that is fixed to the table.
    """
    start, end = first.point[:2], second.point[:2]
    if scene.end_effector == "spatula":
        if first.object_id != TABLE and not scene[first.object_id].fixed:
            pose = scene[first.object_id].pose
            start = Push.between((pose.x, pose.y), end).behind()
        return Action.planar(start, end)
    if first.object_id == TABLE:
        raise SceneError(f"there is no object at ({start[0]:.3f}, {start[1]:.3f}); click an object to pick.")
    if scene[first.object_id].fixed:
        raise SceneError(f"{scene.describe(first.object_id)} is fixed to the table; click another object.")
    return Action.planar(start, end, turn_rad)


SECOND_TABLE_Y_M = 1.15  # beside the first
VIEW = (1.24, 0.0, 0.98), (0.4, 0.0, 0.06)  # camera and where it looks at; near that of the front camera
VIEW_OF_BOTH = (1.59, SECOND_TABLE_Y_M / 2, 1.39), (0.4, SECOND_TABLE_Y_M / 2, 0.06)
_BENCH_RGB, _BENCH_M, _BENCH_AT_M = (228, 229, 232), (1.16, 1.12, 0.002), (0.4, 0.0, -0.0035)
_LIGHT_M = (-50.0, 30.0, 100.0)  # direction of the light of all images
_AMBIENT, _DIRECTIONAL = 1.2, 2.3  # such that colours are those of the front camera, by eye


class Table:
    """Table, objects and arm in the scene of one browser; a frame changes nothing but poses.

    Args:
        scene: The scene graph of the browser.
        assets: Asset pack.
        root: Name of the node that all others are below.
        offset_y_m: How far to the left of the robot's usual place all is shown.
        on_drag: Called with id and event whenever an object is dragged; None: none can be.
    """

    def __init__(
        self,
        scene: viser.SceneApi,
        assets: Assets,
        *,
        root: str = "/first",
        offset_y_m: float = 0.0,
        on_drag: Callable[[int, viser.SceneNodeDragEvent], None] | None = None,
    ) -> None:
        self.scene_api, self.assets, self.root, self._on_drag = scene, assets, root, on_drag
        self.objects: dict[int, viser.GlbHandle] = {}
        self.shown: VideoFrame | None = None
        self._shapes: dict[int, Shape] = {}
        self._arm: tuple[EndEffector, list[viser.FrameHandle]] | None = None
        scene.configure_default_lights(enabled=False)
        scene.configure_environment_map(hdri=None)
        scene.add_light_ambient("/lights/ambient", intensity=_AMBIENT)
        scene.add_light_directional("/lights/sun", intensity=_DIRECTIONAL, position=_LIGHT_M)
        self._node = scene.add_frame(root, show_axes=False, position=(0.0, offset_y_m, 0.0))
        size, position = (*SHEET_SIZE, 0.002), (0.5, 0.0, -0.0011)
        scene.add_box(f"{root}/table", SHEET_RGB, size, position=position)
        scene.add_box(f"{root}/bench", _BENCH_RGB, _BENCH_M, position=_BENCH_AT_M)  # for arm and shelf

    def show(self, frame: VideoFrame) -> None:
        """Show a scene and the arm; objects that are shown already are moved only."""
        self._show_objects(frame.scene)
        for node, pose in zip(self._links(frame.scene.end_effector), link_frames(frame.joints), strict=True):
            move(node, pose)
        self.shown = frame

    def remove(self) -> None:
        """Take all out of the scene."""
        self._node.remove()

    def add_ghost(
        self,
        name: str,
        placement: Placement,
        pose: Pose,
        *,
        colour: Colour = PLACE,
        opacity: float = 0.3,
        grow: float = 1.0,
    ) -> viser.MeshHandle:
        """Add a translucent copy of an object at a pose, below the table's root."""
        mesh = self.assets.geometry(placement.object, placement.size, placement.scale).visual
        centre = mesh.vertices.reshape(-1, 3).mean(axis=0)
        vertices = (mesh.vertices.reshape(-1, 3) - centre) * grow + centre
        node = self.scene_api.add_mesh_simple(
            f"{self.root}/{name}",
            vertices,
            np.arange(len(vertices)).reshape(-1, 3),
            color=colour,
            opacity=opacity,
            flat_shading=True,
            cast_shadow=False,
            receive_shadow=False,
        )
        move(node, pose)
        return node

    def _show_objects(self, scene: Scene) -> None:
        placements = {placement.id: placement for placement in scene.placements}
        for object_id in [*self.objects]:
            placement = placements.get(object_id)
            if placement is None or self._shape(placement) != self._shapes[object_id]:
                self.objects.pop(object_id).remove()
        for object_id, placement in placements.items():
            if object_id not in self.objects:
                self._shapes[object_id] = self._shape(placement)
                node = self.objects[object_id] = self.add_object(f"objects/{object_id}", placement)
                if self._on_drag is not None:
                    node.on_drag()(partial(self._on_drag, object_id))
            move(self.objects[object_id], placement.pose)

    def add_object(self, name: str, placement: Placement) -> viser.GlbHandle:
        """Add a node with an object, which need not be one of the scene."""
        data = object_glb(*self._shape(placement))
        node = self.scene_api.add_glb(f"{self.root}/{name}", data, cast_shadow=False, receive_shadow=False)
        move(node, placement.pose)
        return node

    def _shape(self, placement: Placement) -> Shape:
        return self.assets, placement.object, placement.texture, placement.size, placement.scale

    def _links(self, end_effector: EndEffector) -> list[viser.FrameHandle]:
        if self._arm is None or self._arm[0] != end_effector:
            for node in self._arm[1] if self._arm else ():
                node.remove()
            nodes = [
                self.scene_api.add_frame(f"{self.root}/arm/{link}", show_axes=False) for link in range(8)
            ]
            for number, (link, _, rgb, mesh) in enumerate(arm_parts(end_effector)):
                name = f"{self.root}/arm/{link}/{number}"
                self.scene_api.add_glb(name, coloured_glb(mesh, rgb), cast_shadow=False, receive_shadow=False)
            self._arm = (end_effector, nodes)
        return self._arm[1]


def move(node: viser.SceneNodeHandle, pose: Pose) -> None:
    """Pose a node; viser sends nothing where nothing changed."""
    x, y, z, w = pose.quaternion
    node.position, node.wxyz = pose.position, (w, x, y, z)


_LOG = logging.getLogger(__name__)
YOU = "you"  # the policy that is none: a user acts
_PANEL_WIDTH, _PROMPT_WIDTH = 400, 560  # pixels


@dataclass(frozen=True, slots=True)
class StudioConfig:
    """Settings of a studio.

    Args:
        path: Results folder or data folder that is opened first.
        policies: Policies to offer besides the bundled ones, "oracle", "random" and "you".
        record: Folder that demonstrations of users are written to; None: none are recorded.
        env_config: Settings of the environments.
        device: Where networks compute.
        trust_code: Run the code that run folders name, and results as their detector.
        port: TCP port; 0 takes a free one.
    """

    path: Path | None = None
    policies: tuple[str, ...] = ()
    record: Path | None = None
    env_config: EnvConfig = DEFAULT_ENV_CONFIG
    device: str = DEFAULT_DEVICE
    trust_code: bool = False
    port: int = 0


class BrowserSession:
    """What one browser sees and does; its work runs in a thread of its own, in order.

    Panels read `current`, the episode in view, and change it by `open`, `step` and `back`, inside of
    `submit`. The functions in `on_change` are called, in that thread, whenever it has changed, those in
    `on_drag` with id and event whenever an object on the table is dragged.
    """

    def __init__(self, client: viser.ClientHandle, config: StudioConfig) -> None:
        self.client, self.gui, self.config, self.env_config = client, client.gui, config, config.env_config
        self.assets = load_assets(self.env_config.assets)
        self.table = Table(client.scene, self.assets, on_drag=self._dragged)
        self.current: EpisodeSession | None = None
        self.compared: EpisodeSession | None = None  # the same episode by another policy, in lockstep
        self.policy: RolloutPolicy | None = None  # the chosen one
        self.policy_name, self.speed = YOU, 1.0
        self._running = self._newest = threading.Event()  # set to end the work submitted with it
        self.editing = False  # whether clicks select objects to edit, instead of acting
        self.prompt_weights: list[tuple[Colour, np.ndarray]] = []  # attention to draw below the prompt
        self.next_seed: Callable[[], None] = lambda: None  # set by *Play*
        self._other_policy: RolloutPolicy | None = None
        self._other_table: Table | None = None
        self.on_change: list[Callable[[], None]] = []
        self.on_drag: list[Callable[[int, viser.SceneNodeDragEvent], None]] = []
        self._worker = ThreadPoolExecutor(1, thread_name_prefix=f"browser-{client.client_id}")
        client.camera.position, client.camera.look_at = VIEW
        self.gui.main_panel.dock_right()
        self.gui.main_panel.set_width(_PANEL_WIDTH)
        self.tabs = self.gui.add_tab_group()
        window = self.gui.add_panel()
        with window.add_tab("Prompt", viser.Icon.MESSAGE):
            self._prompt = self.gui.add_image(np.full((1, 1, 3), 255, np.uint8))
        window.float(x=12, y=-12, width=_PROMPT_WIDTH)  # messages are shown above

    def submit(self, work: Callable[[], object]) -> "Future[None]":
        """Do work in this browser's thread; what it raises is shown, and the page lives on."""
        stop = self._newest = threading.Event()

        def begin() -> None:
            self._running = stop
            work()

        return self._worker.submit(self._reported, begin)

    def interrupt(self, work: Callable[[], object]) -> "Future[None]":
        """Submit work, and end the animations and runs before it."""
        self.pause()
        return self.submit(work)

    def callback(self, work: Callable[[], object]) -> Callable[[viser.GuiEvent], Coroutine[Any, Any, None]]:
        """Return a callback for a field of viser: it interrupts, unless code has changed the field."""

        async def called(event: viser.GuiEvent) -> None:  # asynchronous ones are called in order
            if event.client is not None:
                self.interrupt(work)

        return called

    def on_update(self, work: Callable[[], object], *fields: Any) -> None:  # viser has no type for all fields
        """Do work, as `callback` does, whenever the user changes one of these fields."""
        for field in fields:
            field.on_update(self.callback(work))

    def add_buttons(
        self, label: str, actions: Mapping[str, Callable[[], object]]
    ) -> viser.GuiButtonGroupHandle:
        """Add a group of buttons by name; each interrupts, and then does its work."""
        group = self.gui.add_button_group(label, [*actions])

        @group.on_click
        async def _(_: viser.GuiEvent) -> None:  # before the next press changes the value
            self.interrupt(actions[group.value])

        return group

    def pause(self) -> None:
        """End the animation or run that is going on."""
        self._running.set()
        self._newest.set()

    def is_paused(self) -> bool:
        """Whether the work that is going on should end."""
        return self._running.is_set()

    def load_policy(self, name: str) -> RolloutPolicy | None:
        """Load a policy for this browser alone; `YOU` gives None."""
        if name == YOU:
            return None
        config = self.config
        return load_own_rollout_policy(name, device=config.device, trust_code=config.trust_code)

    def choose_assets(self, name: str) -> None:
        """Use an asset pack for what is opened from here on."""
        self.assets = self.table.assets = load_assets(name)
        self.env_config = replace(self.env_config, assets=name)

    def open(self, episode: Episode, policy: RolloutPolicy | None, *, compat: bool | None = None) -> None:
        """Start an episode, sampled or composed, and show it."""
        compat = self.env_config.compat if compat is None else compat
        opened = EpisodeSession(episode, policy, assets=self.assets, compat=compat)
        self.close_episode()
        self.current = opened
        self.compare(self._other_policy)

    def compare(self, policy: RolloutPolicy | None) -> None:
        """Show beside the current episode how another policy does it, from the start; None: nothing."""
        if (policy is None) != (self._other_policy is None):
            camera = self.client.camera
            camera.position, camera.look_at = VIEW if policy is None else VIEW_OF_BOTH
        self._other_policy = policy
        if self._other_table is not None:
            self._other_table.remove()
        self.compared = self._other_table = None
        if policy is not None and self.current is not None:
            episode, compat = self.current.episode, self.current.env.compat
            self.compared = EpisodeSession(episode, policy, assets=self.assets, compat=compat)
            scene = self.client.scene
            self._other_table = Table(scene, self.assets, root="/second", offset_y_m=SECOND_TABLE_Y_M)
        self.back(0)

    def step(self, action: Action | None = None) -> bool:
        """Take a step with an action, or the policy's, and show it; return whether there was one."""
        frames = {}
        for table, run in self.runs():
            if run.outcome is not None:
                continue
            step = run.step(action if run is self.current else None)
            if step is not None:
                frames[table] = step.frames
            elif error := run.propose().error:
                self.warn(str(error))
        self._animate(frames)
        self.changed()
        return bool(frames)

    def _animate(self, tables: Mapping[Table, Sequence[VideoFrame]]) -> None:
        """Show the frames of a step by table, 30 a second times the speed; the last at once if paused."""
        start = time.perf_counter()
        for number in range(max(map(len, tables.values()), default=0)):
            wait = start + number / (FRAMES_PER_SECOND * self.speed) - time.perf_counter()
            if self.is_paused():
                break
            if wait < -1 / FRAMES_PER_SECOND and number % 2:
                continue  # late: half of the frames suffice
            time.sleep(max(0.0, wait))
            for table, frames in tables.items():
                if number < len(frames):
                    table.show(frames[number])
        for table, frames in tables.items():
            if frames:
                table.show(frames[-1])

    def run(self) -> None:
        """Step until the episode is over, no action is there, or the user pauses."""
        while not self.is_paused() and self.step():
            pass

    def back(self, num_steps: int) -> None:
        """Go back to the state after some steps."""
        for table, run in self.runs():
            run.back(min(num_steps, run.num_steps))
            table.show(run.frame())
        self.changed()

    def runs(self) -> list[tuple[Table, EpisodeSession]]:
        """Return the tables with their episodes: the current one, and the one that is compared."""
        pairs = ((self.table, self.current), (self._other_table, self.compared))
        return [(table, run) for table, run in pairs if table is not None and run is not None]

    def changed(self) -> None:
        """Tell the panels that the current episode has changed, and show the prompt."""
        for function in self.on_change:
            self._reported(function)
        if self.current is not None:
            self.show_prompt(self.current.prompt)

    def _dragged(self, object_id: int, event: viser.SceneNodeDragEvent) -> None:
        for function in self.on_drag:
            function(object_id, event)

    def show_prompt(self, prompt: RenderedPrompt) -> None:
        """Show a prompt in its window."""
        self._prompt.image = draw_prompt_strip(  # twice as large as shown, to be sharp
            prompt, width=2 * _PROMPT_WIDTH, image_height=128, font_size=38, weights=self.prompt_weights
        )

    def hit(
        self, event: viser.SceneClickEvent | viser.SceneNodeDragEvent, placements: Iterable[Placement]
    ) -> Hit | None:
        """Return what a click, or the end of a drag so far, points at; None: nothing."""
        if isinstance(event, viser.SceneClickEvent):
            return first_hit(placements, event.ray_origin, event.ray_direction, self.assets)
        origin = event.client.camera.position
        ray = np.subtract(event.end_position, origin).tolist()
        return first_hit(placements, origin.tolist(), ray, self.assets)

    def warn(self, message: str) -> None:
        """Show a message over the page."""
        self.client.add_notification("That did not work", message, auto_close_seconds=12.0, color="red")

    def close_episode(self) -> None:
        """Free the current episode."""
        for _, run in self.runs():
            run.close()
        self.current = self.compared = None

    def close(self) -> None:
        """End the session: the browser has gone."""
        self.pause()
        self._worker.submit(self.close_episode)
        self._worker.shutdown(wait=False)

    def _reported(self, work: Callable[[], object]) -> None:
        try:
            work()
        except OpenVimaError as error:
            self.warn(str(error))
        except Exception as error:  # a bug, or a policy's; the page lives on
            _LOG.exception("in the session of browser %s", self.client.client_id)
            self.warn(f"{type(error).__name__}: {error}")
