"""The table in 3D: meshes and textures of the asset pack, and the arm, as nodes of one browser's scene."""

import time
from collections.abc import Callable, Iterable, Mapping, Sequence

import numpy as np
import viser

from openvima.catalog.geometry import Assets
from openvima.env.running_episode import FRAMES_PER_SECOND, VideoFrame
from openvima.render.gltf import Shape, coloured_glb, object_glb
from openvima.render.rasteriser import SHEET_RGB, SHEET_SIZE
from openvima.render.raycast import Hit, first_hit
from openvima.scene import EndEffector, Placement, Pose, Scene
from openvima.sim.arm_view import arm_parts
from openvima.sim.ur5 import link_frames
from openvima.video.explanation import PLACE
from openvima.video.prompt_strip import Colour

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
    """

    def __init__(
        self, scene: viser.SceneApi, assets: Assets, *, root: str = "/first", offset_y_m: float = 0.0
    ) -> None:
        self.scene_api, self.assets, self.root = scene, assets, root
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
        *,
        pose: Pose | None = None,
        colour: Colour = PLACE,
        opacity: float = 0.3,
        grow: float = 1.0,
    ) -> viser.MeshHandle:
        """Add a translucent copy of an object, where it is or at a pose, below the table's root."""
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
        move(node, placement.pose if pose is None else pose)
        return node

    def _show_objects(self, scene: Scene) -> None:
        placements = {placement.id: placement for placement in scene.placements}
        for object_id in [*self.objects]:
            placement = placements.get(object_id)
            if placement is None or self._shape(placement) != self._shapes[object_id]:
                self.objects.pop(object_id).remove()
                del self._shapes[object_id]
        for object_id, placement in placements.items():
            if object_id not in self.objects:
                self._shapes[object_id] = self._shape(placement)
                self.objects[object_id] = self.add_object(f"objects/{object_id}", placement)
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
            for number, (link, rgb, mesh) in enumerate(arm_parts(end_effector)):
                name = f"{self.root}/arm/{link}/{number}"
                self.scene_api.add_glb(name, coloured_glb(mesh, rgb), cast_shadow=False, receive_shadow=False)
            self._arm = (end_effector, nodes)
        return self._arm[1]


def animate(tables: Mapping[Table, Sequence[VideoFrame]], *, speed: float, stops: Callable[[], bool]) -> None:
    """Show the frames of steps by table, 30 a second times `speed`; the last at once if `stops` says so."""
    start = time.perf_counter()
    for number in range(max(map(len, tables.values()), default=0)):
        wait = start + number / (FRAMES_PER_SECOND * speed) - time.perf_counter()
        if stops():
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


def hit_of(
    event: viser.SceneClickEvent | viser.SceneNodeDragEvent, placements: Iterable[Placement], assets: Assets
) -> Hit | None:
    """Return what a click, or the end of a drag so far, points at; None: nothing."""
    if isinstance(event, viser.SceneClickEvent):
        return first_hit(placements, event.ray_origin, event.ray_direction, assets)
    origin = event.client.camera.position
    return first_hit(placements, origin.tolist(), np.subtract(event.end_position, origin).tolist(), assets)


def move(node: viser.SceneNodeHandle, pose: Pose) -> None:
    """Pose a node; viser sends nothing where nothing changed."""
    x, y, z, w = pose.quaternion
    node.position, node.wxyz = pose.position, (w, x, y, z)
