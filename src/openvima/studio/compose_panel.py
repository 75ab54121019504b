"""*Compose*: a scene and a sentence of one's own, changed one thing at a time."""

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import viser

from openvima.catalog import OBJECTS, TEXTURES
from openvima.env.composing import photo_from_bytes
from openvima.env.episode_file import load_episode, save_episode
from openvima.errors import OpenVimaError, SceneError
from openvima.evaluation.session import EpisodeSession
from openvima.scene import END_EFFECTORS, Placement, Pose
from openvima.studio.browser_session import BrowserSession, move
from openvima.studio.composition import Composition, parse_goals, shelf

_FIRST = Composition((), "Put the {a} into the {b}.", goals=(("in", "a", "b"),))
_FIRST_OBJECTS = (("block", "red"), ("bowl", "green"))
_NONE = "none"


class ComposePanel:
    """The tab *Compose*; the episode in view is the composition until another one is opened."""

    def __init__(self, session: BrowserSession) -> None:
        self.session = session
        self._scene: Composition | None = None
        self._episode: EpisodeSession | None = None  # of the composition
        self._shelf: list[viser.GlbHandle] = []
        gui = session.gui
        with session.tabs.add_tab("Compose", viser.Icon.CUBE_PLUS):
            actions = {"edit this episode": self._take_over, "new scene": self._begin, "play": self._play}
            session.add_buttons("", actions)
            self._edits = gui.add_checkbox("clicks select objects", True, hint="else they act, as in You")
            with gui.add_folder("Object"):
                self._object = gui.add_dropdown("shape", [*OBJECTS], initial_value="heart")
                self._texture = gui.add_dropdown("texture", [*TEXTURES], initial_value="red swirl")
                changes = {"add": self._drop, "replace": self._replace, "remove": self._remove}
                session.add_buttons("", changes)
                self._selected = gui.add_dropdown("selected", [_NONE])
                self._pose = gui.add_vector3("x, y (m), turn (°)", (0.5, 0.0, 0.0), step=0.005)
                self._scale = gui.add_slider("size", 0.5, 2.0, 0.05, 1.0)
            with gui.add_form("Sentence") as sentence:
                self._prompt = gui.add_text("prompt", "", hint="{a} shows object a; Enter applies")
                self._goals = gui.add_text(
                    "goals", "", hint="[in, a, b], [at, a, [0.5, 0.1]], [rotated, a, 60]"
                )
                self._tool = gui.add_dropdown("tool", END_EFFECTORS)
                self._steps = gui.add_number("steps", 10, min=1, max=1000, step=1)
                gui.add_button("apply").on_click(session.callback(self._rewrite))
            with gui.add_folder("Image for a {placeholder}", expand_by_default=False):
                self._slot = gui.add_text("placeholder", "c", hint="a name for the image, without braces")
                shape = lambda: self._insert((self._object.value, self._texture.value))  # noqa: E731
                scene = lambda: self._insert(self._present().scene_image())  # noqa: E731
                session.add_buttons("shows", {"shape above": shape, "scene as it is": scene})
                upload = gui.add_upload_button("PNG file …", mime_type="image/png")
            with gui.add_folder("File", expand_by_default=False):
                self._path = gui.add_text("file", "scene.yaml")
                session.add_buttons("", {"save": self._save, "load": self._load})
        session.on_update(self._follow, self._edits)
        session.on_update(self._show_shelf, self._texture)
        session.on_update(self._show_selected, self._selected)
        session.on_update(lambda: self._move(self._pose.value), self._pose)
        session.on_update(lambda: self._change_selected(scale=self._scale.value), self._scale)
        sentence.on_submit(session.callback(self._rewrite))
        upload.on_upload(session.callback(lambda: self._insert(photo_from_bytes(upload.value.content))))
        session.client.scene.on_click()(self._clicked)
        session.on_drag.append(self._object_dragged)
        session.on_change.append(self._follow)

    def _use(self, new: Composition, selected: str | None = None) -> None:
        """Put a composition in place of the present one; if it is impossible, nothing changes but a message.

        Raises:
            OpenVimaError: It is impossible.
        """
        try:
            episode = new.episode(self.session.assets)
        except OpenVimaError:
            if self._scene is not None and self.session.current is not None:
                self.session.table.show(self.session.current.frame())  # as before
                self._show(self._selected.value)
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

    def _drop(self, name: str = "", position: tuple[float, float] | None = None) -> None:
        """Add an object in the chosen texture, by default of the chosen shape where there is room."""
        name, texture = name or self._object.value, self._texture.value
        new = self._present().added(name, texture, self.session.assets, position=position)
        self._use(new, new.objects[-1].name)

    def _replace(self) -> None:
        self._change_selected(object=self._object.value, texture=self._texture.value)

    def _remove(self) -> None:
        self._use(self._present().removed(self._selected.value), _NONE)

    def _change_selected(self, **fields: Any) -> None:
        self._use(self._present().changed(self._selected.value, **fields))

    def _move(self, pose: Sequence[float]) -> None:
        """Move the selected object."""
        x, y, yaw_deg = pose
        self._use(self._present().moved(self._selected.value, (x, y), yaw_deg))

    def _rewrite(self) -> None:
        """Apply the fields; images whose placeholder is gone are left out."""
        scene, prompt = self._present(), self._prompt.value
        new = replace(
            scene,
            prompt=prompt,
            images={slot: image for slot, image in scene.images.items() if f"{{{slot}}}" in prompt},
            goals=parse_goals(self._goals.value),
            max_steps=int(self._steps.value),
            end_effector=self._tool.value,
        )
        self._use(new)

    def _insert(self, image: object) -> None:
        """Show an image at a placeholder, which is added at the end of the prompt if it is not there."""
        scene, slot, prompt = self._present(), self._slot.value.strip(), self._prompt.value
        prompt += "" if f"{{{slot}}}" in prompt else f" {{{slot}}}"
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

    def _clicked(self, event: viser.SceneClickEvent) -> None:
        if self.session.editing:
            self.session.submit(lambda: self._select(event))

    def _select(self, event: viser.SceneClickEvent) -> None:
        names = self._names()
        if self.session.current is not None:
            hit = self.session.hit(event, self.session.current.scene.placements)
            self._show(names.get(hit.object_id, _NONE) if hit else _NONE)

    def _names(self) -> dict[int, str]:
        """Handles of the objects by id: both are in one order."""
        current = self._episode
        placements = () if current is None else current.scene.placements
        return {p.id: each.name for p, each in zip(placements, self._present().objects, strict=True)}

    def _follow(self) -> None:
        """Stop editing while the composition is played, or when another episode is in view."""
        current = self.session.current
        is_at_start = current is not None and current is self._episode and current.num_steps == 0
        self.session.editing = is_at_start and self._edits.value
        if self.session.editing and not self._shelf:
            self._show_shelf()
        for node in self._shelf:
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
        hit = self.session.hit(event, ())
        if hit is None or event.phase == "start":
            return
        x, y, _ = hit.point
        is_dropped = event.phase == "end"
        move(event.target, placement.pose if is_dropped else Pose.planar(x, y, z=placement.pose.z))
        if is_dropped:
            self.session.interrupt(lambda: self._drop(placement.object, (x, y)))

    def _object_dragged(self, object_id: int, event: viser.SceneNodeDragEvent) -> None:
        """Move an object of the scene by dragging it."""
        hit = self.session.hit(event, ())
        if not self.session.editing or hit is None:
            return
        name = self._names()[object_id]
        if event.phase == "start":
            self.session.submit(lambda: self._show(name))
            return
        pose = (*hit.point[:2], self._present()[name].yaw_deg)
        if event.phase == "end":
            self.session.interrupt(lambda: self._move(pose))
        else:
            self.session.submit(lambda: self._preview(pose))

    def _show(self, selected: str) -> None:
        """Select an object."""
        names = [each.name for each in self._present().objects]
        self._selected.options = [*names, _NONE]
        self._selected.value = selected if selected in names else _NONE
        self._show_selected()

    def _show_selected(self) -> None:
        """Show the selected object's fields."""
        if self._selected.value != _NONE and self._scene is not None:
            chosen = self._scene[self._selected.value]
            self._pose.value, self._scale.value = (*chosen.position, chosen.yaw_deg), chosen.scale

    def _preview(self, pose: tuple[float, float, float]) -> None:
        current, x, y, yaw_deg = self.session.current, *pose
        for object_id, name in self._names().items():
            if name == self._selected.value and current is not None and current is self._episode:
                z = current.scene[object_id].pose.z
                move(self.session.table.objects[object_id], Pose.planar(x, y, math.radians(yaw_deg), z=z))
