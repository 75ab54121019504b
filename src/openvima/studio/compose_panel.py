"""*Compose*: a scene and a sentence of one's own, changed one thing at a time."""

import math
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import viser

from openvima.catalog import OBJECTS, TEXTURES
from openvima.env.composition import Composition, parse_goals, shelf
from openvima.env.episode_code import python_code, shell_command
from openvima.env.episode_file import load_episode, save_episode
from openvima.env.photos import read_photo
from openvima.errors import OpenVimaError, SceneError
from openvima.evaluation.session import EpisodeSession
from openvima.scene import END_EFFECTORS, Placement, Pose
from openvima.studio.browser_session import BrowserSession
from openvima.studio.table import hit_of, move

_GIZMO, _REFUSED = "/compose/gizmo", "/compose/refused"
_GIZMO_M = 0.12
_REFUSED_RGB = (220, 30, 30)
_FIRST = Composition((), "Put the {a} into the {b}.", goals=(("in", "a", "b"),))
_FIRST_OBJECTS = (("block", "red"), ("bowl", "green"))
_NONE = "none"


class ComposePanel:
    """The tab *Compose*; the episode in view is the composition until another one is opened.

    Args:
        session: The browser's session.
    """

    def __init__(self, session: BrowserSession) -> None:
        self.session = session
        self._scene: Composition | None = None
        self._episode: EpisodeSession | None = None  # of the composition
        self._gizmo: viser.TransformControlsHandle | None = None
        self._shelf: list[viser.GlbHandle] = []
        gui = session.gui
        with session.tabs.add_tab("Compose", viser.Icon.CUBE_PLUS):
            start = gui.add_button_group("", ("edit this episode", "new scene", "play"))
            self._edits = gui.add_checkbox("clicks select objects", True, hint="else they act, as in You")
            self._edits.on_update(session.callback(self._follow))
            with gui.add_folder("Object"):
                self._add_object_fields(gui)
            with gui.add_form("Sentence") as sentence:
                self._add_sentence_fields(gui)
            sentence.on_submit(session.callback(self._rewrite))
            with gui.add_folder("Picture for a {placeholder}", expand_by_default=False):
                self._add_picture_fields(gui)
            with gui.add_folder("File", expand_by_default=False):
                self._path = gui.add_text("file", "scene.yaml")
                file = gui.add_button_group("", ("save", "load"))
                copy = gui.add_button_group("copy as", ("Python", "command"))
        actions = {"edit this episode": self._take_over, "new scene": self._begin, "play": self._play}
        actions |= {"save": self._save, "load": self._load}
        actions |= {"Python": lambda: self._copy(python_code), "command": lambda: self._copy(shell_command)}
        for group in (start, file, copy):
            group.on_click(session.callback(lambda g=group: actions[g.value]()))
        session.client.scene.on_click()(self._clicked)
        session.on_drag(self._object_dragged)
        session.on_change(self._follow)

    def _add_object_fields(self, gui: viser.GuiApi) -> None:
        self._object = gui.add_dropdown("shape", [*OBJECTS], initial_value="heart")
        self._texture = gui.add_dropdown("texture", [*TEXTURES], initial_value="red swirl")
        change = gui.add_button_group("", ("add", "replace", "remove"))
        self._selected = gui.add_dropdown("selected", [_NONE])
        self._pose = gui.add_vector3("x, y (m), turn (°)", (0.5, 0.0, 0.0), step=0.005)
        self._scale = gui.add_slider("size", 0.5, 2.0, 0.05, 1.0)
        self._texture.on_update(self.session.callback(self._show_shelf))
        changes = {"add": self._add, "replace": self._replace, "remove": self._remove}
        change.on_click(self.session.callback(lambda: changes[change.value]()))
        self._selected.on_update(self.session.callback(self._show_selected))
        self._pose.on_update(self.session.callback(lambda: self._move(self._pose.value)))
        self._scale.on_update(self.session.callback(lambda: self._change_selected(scale=self._scale.value)))

    def _add_sentence_fields(self, gui: viser.GuiApi) -> None:
        self._prompt = gui.add_text("prompt", "", hint="{a} shows object a; Enter applies")
        self._goals = gui.add_text("goals", "", hint="[in, a, b], [at, a, [0.5, 0.1]], [rotated, a, 60]")
        self._tool = gui.add_dropdown("tool", END_EFFECTORS)
        self._steps = gui.add_number("steps", 10, min=1, max=1000, step=1)
        gui.add_button("apply").on_click(self.session.callback(self._rewrite))

    def _add_picture_fields(self, gui: viser.GuiApi) -> None:
        self._slot = gui.add_text("placeholder", "c", hint="a name for the picture, without braces")
        kinds = gui.add_button_group("shows", ("shape above", "scene as it is"))
        upload = gui.add_upload_button("PNG file …", mime_type="image/png")
        kinds.on_click(self.session.callback(lambda: self._picture(kinds.value)))
        upload.on_upload(self.session.callback(lambda: self._upload(upload.value.content)))

    def _use(self, new: Composition, selected: str | None = None) -> None:
        """Put a composition in place of the present one; if it is impossible, nothing changes but a message.

        Raises:
            OpenVimaError: It is impossible.
        """
        try:
            episode = new.episode(self.session.assets)
        except OpenVimaError:
            if self._scene is not None:
                self._show(self._selected.value)  # what the fields said before
            raise
        old, self._scene = self._scene, new
        self.session.open(episode, self.session.policy)
        self._episode = self.session.current
        self._follow()
        if old is None or (old.prompt, old.goals) != (new.prompt, new.goals):  # else it may be half typed
            self._prompt.value, self._goals.value = new.prompt, new.goals_text
        self._tool.value, self._steps.value = new.end_effector, episode.max_steps
        self._show(self._selected.value if selected is None else selected)

    def _take_over(self) -> None:
        current = self.session.current
        if current is None:
            raise SceneError("no episode is in view; begin a new scene.")
        self._use(Composition.of(current.episode))

    def _begin(self) -> None:
        scene = _FIRST
        for name, texture in _FIRST_OBJECTS:
            scene = scene.added(name, texture, self.session.assets)
        self._use(scene)

    def _present(self) -> Composition:
        if self._scene is None:
            self._begin()
        assert self._scene is not None  # as begun
        return self._scene

    def _add(self, name: str = "", position: tuple[float, float] | None = None) -> None:
        name, texture = name or self._object.value, self._texture.value
        new = self._present().added(name, texture, self.session.assets, position=position)
        self._use(new, new.objects[-1].name)

    def _replace(self) -> None:
        self._change_selected(object=self._object.value, texture=self._texture.value)

    def _remove(self) -> None:
        self._use(self._present().removed(self._selected.value), _NONE)

    def _change_selected(self, **fields: Any) -> None:  # Any: fields of `SceneObject`
        self._use(self._present().changed(self._selected.value, **fields))

    def _move(self, pose: Sequence[float]) -> None:
        """Move the selected object, or show in red where it cannot be."""
        x, y, yaw_deg = pose
        name, scene = self._selected.value, self._present()
        new = scene.moved(name, (x, y), yaw_deg)
        try:
            self._use(new)
        except SceneError:
            refused = replace(new, objects=(new[name],), prompt="-", images={}, goals=())
            self._show_refused(refused)
            raise

    def _show_refused(self, scene: Composition) -> None:
        try:
            (placement,) = scene.episode(self.session.assets).problem.scene.placements
        except SceneError:  # it is outside, which one sees
            return
        self.session.table.add_ghost(_REFUSED, placement, colour=_REFUSED_RGB, opacity=0.6, grow=1.02)

    def _rewrite(self) -> None:
        new = replace(
            self._present(),
            prompt=self._prompt.value,
            goals=parse_goals(self._goals.value),
            max_steps=int(self._steps.value),
            end_effector=self._tool.value,
        )
        used = {name: image for name, image in new.images.items() if f"{{{name}}}" in new.prompt}
        self._use(replace(new, images=used))

    def _picture(self, kind: str) -> None:
        scene = self._present()
        shape = (self._object.value, self._texture.value)
        self._insert(shape if kind == "shape above" else scene.scene_image())

    def _upload(self, content: bytes) -> None:
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder, "photo.png")
            file.write_bytes(content)
            self._insert(read_photo(file))

    def _insert(self, image: object) -> None:
        """Show a picture at a placeholder, which is added to the prompt if it is not there."""
        scene, slot = self._present(), self._slot.value.strip()
        prompt = self._prompt.value if f"{{{slot}}}" in self._prompt.value else f"{scene.prompt} {{{slot}}}"
        self._use(replace(scene, prompt=prompt, images={**scene.images, slot: image}))

    def _play(self) -> None:
        self._present()
        self._show(_NONE)
        self.session.back(0)
        self.session.run()

    def _save(self) -> None:
        path = save_episode(self._present().episode(self.session.assets), self._path.value)
        self.session.client.add_notification("Saved", str(path.resolve()), auto_close_seconds=6.0)

    def _load(self) -> None:
        self._use(Composition.of(load_episode(self._path.value, assets=self.session.assets)))

    def _copy(self, written: Callable[..., str]) -> None:
        """Show the episode in view as text."""
        current = self.session.current
        if current is None:
            return
        text = written(current.episode, env_config=self.session.config.env_config)
        with self.session.gui.add_modal("Copy") as modal:
            self.session.gui.add_markdown(f"```\n{text}```")
            self.session.gui.add_button("close").on_click(lambda _: modal.close())

    def _clicked(self, event: viser.SceneClickEvent) -> None:
        if self.session.editing:
            self.session.submit(lambda: self._select(event))

    def _select(self, event: viser.SceneClickEvent) -> None:
        current, scene = self.session.current, self._scene
        if current is None or scene is None:
            return
        hit = hit_of(event, current.scene.placements, self.session.assets)
        ids = [placement.id for placement in current.scene.placements]
        self._show(scene.objects[ids.index(hit.object_id)].name if hit and hit.object_id in ids else _NONE)

    def _follow(self) -> None:
        """Stop editing while the composition is played, or when another episode is in view."""
        current = self.session.current
        is_at_start = current is not None and current is self._episode and current.num_steps == 0
        self.session.editing = is_at_start and self._edits.value
        if self.session.editing and not self._shelf:
            self._show_shelf()
        for node in (*self._shelf, *([self._gizmo] if self._gizmo else ())):
            node.visible = self.session.editing

    def _show_shelf(self) -> None:
        """Show the catalogue before the table, in the chosen texture, to be dragged from."""
        for node in self._shelf:
            node.remove()
        self._shelf = []
        for placement in shelf(self._texture.value, self.session.assets):
            node = self.session.table.add_object(f"shelf/{placement.id}", placement)
            node.on_drag()(partial(self._taken, placement))
            self._shelf.append(node)

    def _taken(self, placement: Placement, event: viser.SceneNodeDragEvent) -> None:
        """Move an object out of the shelf, and add it where it is let go."""
        hit = hit_of(event, (), self.session.assets)
        if hit is None or event.phase == "start":
            return
        x, y, _ = hit.point
        is_dropped = event.phase == "end"
        move(event.target, placement.pose if is_dropped else Pose.planar(x, y, z=placement.pose.z))
        if is_dropped:
            self.session.interrupt(lambda: self._add(placement.object, (x, y)))

    def _object_dragged(self, object_id: int, event: viser.SceneNodeDragEvent) -> None:
        """Move an object of the scene by dragging it."""
        hit, scene, current = hit_of(event, (), self.session.assets), self._scene, self.session.current
        if not self.session.editing or hit is None or scene is None or current is None:
            return
        ids = [placement.id for placement in current.scene.placements]
        chosen = scene.objects[ids.index(object_id)]
        pose = (hit.point[0], hit.point[1], chosen.yaw_deg)
        if event.phase == "start":
            self.session.submit(lambda: self._show(chosen.name))
        else:
            self._drag_to(pose, is_end=event.phase == "end")

    def _show(self, selected: str) -> None:
        """Select an object."""
        names = [each.name for each in self._present().objects]
        self._selected.options = [*names, _NONE]
        self._selected.value = selected if selected in names else _NONE
        self._show_selected()

    def _show_selected(self) -> None:
        """Show the selected object's fields, and the gizmo at it."""
        self.session.client.scene.remove_by_name(_REFUSED)
        if self._gizmo is not None:
            self._gizmo.remove()
            self._gizmo = None
        if self._selected.value == _NONE or self._scene is None:
            return
        chosen = self._scene[self._selected.value]
        (x, y), half_rad = chosen.position, math.radians(chosen.yaw_deg) / 2
        self._object.value, self._texture.value = chosen.object, chosen.texture
        self._pose.value, self._scale.value = (x, y, chosen.yaw_deg), chosen.scale
        self._gizmo = self.session.client.scene.add_transform_controls(
            _GIZMO,
            scale=_GIZMO_M,
            active_axes=(True, True, False),
            position=(x, y, 0.05),
            wxyz=(math.cos(half_rad), 0.0, 0.0, math.sin(half_rad)),
            depth_test=False,
        )
        self._gizmo.on_update(self._dragged)

    def _dragged(self, event: viser.TransformControlsEvent) -> None:
        """Move the object with the gizmo, and compose the scene when it is let go."""
        w, x, y, z = event.target.wxyz
        yaw_rad = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        position = event.target.position
        pose = float(position[0]), float(position[1]), math.degrees(yaw_rad)
        self._drag_to(pose, is_end=event.phase == "end")

    def _drag_to(self, pose: tuple[float, float, float], *, is_end: bool) -> None:
        if is_end:
            self.session.interrupt(lambda: self._move(pose))
        else:
            self.session.submit(lambda: self._preview(pose))

    def _preview(self, pose: tuple[float, float, float]) -> None:
        scene, current = self._scene, self.session.current
        if scene is None or current is None or current is not self._episode:
            return
        index = [each.name for each in scene.objects].index(self._selected.value)
        placement = current.scene.placements[index]
        x, y, yaw_deg = pose
        moved = Pose.planar(x, y, math.radians(yaw_deg), z=placement.pose.z)
        move(self.session.table.objects[placement.id], moved)
