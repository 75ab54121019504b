"""Writes small data sets of the form of the published one, in both of its generations.

Classes that the files name live in modules that exist only while something is pickled.
"""

import contextlib
import enum
import functools
import io
import pickle
import sys
import types
import typing
import zipfile
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

VIEWS = ("front", "top")
ZIP_TIME = (2022, 8, 1, 0, 0, 0)


@dataclass(frozen=True)
class Generation:
    """What differs between the published files and those of today's generator."""

    package: str
    num_coordinates: int
    has_run_config: bool


PUBLISHED = Generation("vimasim", num_coordinates=3, has_run_config=True)
TODAY = Generation("vima_bench", num_coordinates=2, has_run_config=False)


@dataclass
class MadeEpisode:
    """The content of one episode, to be written in one of the two forms."""

    seed: int = 7
    prompt: str = "Put the {dragged_obj_1} into the {base_obj}."
    end_effector: str = "suction"
    num_steps: int = 1
    picks: list[tuple[float, float]] = field(default_factory=lambda: [(0.4, 0.1)])
    objects: dict[int, tuple[str, str]] = field(
        default_factory=lambda: {5: ("bowl", "red swirl"), 6: ("letter A", "wooden")}
    )
    # In the order of registration, which is not that of the text.
    images: dict[str, tuple[str, list[tuple[int, str, str]]]] = field(
        default_factory=lambda: {
            "base_obj": ("object", [(0, "bowl", "red swirl")]),
            "dragged_obj_1": ("object", [(0, "letter A", "wooden")]),
        }
    )

    def frames(self) -> dict[str, np.ndarray]:
        """Smooth images, so that JPEG keeps them nearly; shape (T + 1, 128, 256, 3)."""
        row, column = np.mgrid[:128, :256]
        stack = [
            np.stack([row + 10 * step, column // 2, 255 - row], axis=-1) + self.seed
            for step in range(self.num_steps + 1)
        ]
        return {
            view: np.clip(np.array(stack) + index, 0, 255).astype(np.uint8)
            for index, view in enumerate(VIEWS)
        }

    def segmentation(self) -> dict[str, np.ndarray]:
        """Discs of the second object where the tool goes down, one of the first elsewhere."""
        first, second, *_ = self.objects
        images = np.zeros((self.num_steps + 1, 128, 256), np.uint8)
        images[:, 10:20, 10:20] = first
        for step, (x, y) in enumerate(self.picks):
            row, column = round(63 + 250.98 * (x - 0.5)), round(128 + 250.98 * y)
            images[step, row - 3 : row + 4, column - 3 : column + 4] = second
        return {"top": images, "front": images[:, ::-1].copy()}

    def files(self, generation: Generation = TODAY, protocol: int = 4) -> dict[str, bytes]:
        """Path within the episode's folder to content."""
        values = self.values(generation)
        contents = {f"{name}.pkl": pickled(value, protocol) for name, value in values.items()}
        for view, frames in self.frames().items():
            for number, frame in enumerate(frames):
                contents[f"rgb_{view}/{number}.jpg"] = jpeg(frame)
        return contents

    def values(self, generation: Generation = TODAY) -> dict[str, Any]:
        """What the three pickles hold."""
        return {
            "obs": {
                "segm": self.segmentation(),
                "ee": np.full(self.num_steps + 1, self.end_effector == "spatula", np.int64),
            },
            "action": self.actions(generation.num_coordinates),
            "trajectory": self.trajectory(generation),
        }

    def actions(self, num_coordinates: int) -> dict[str, np.ndarray]:
        upright = np.tile(np.array([0, 0, 0, 1], np.float32), (self.num_steps, 1))
        pose0 = np.array([(*pick, 0.03) for pick in self.picks], np.float32)
        return {
            "pose0_position": pose0[:, :num_coordinates],
            "pose0_rotation": upright,
            "pose1_position": (pose0 + np.float32([0.1, 0.05, 0]))[:, :num_coordinates],
            "pose1_rotation": upright[:, [0, 1, 3, 2]],
        }

    def trajectory(self, generation: Generation) -> dict[str, Any]:
        low, high = np.float32([0.25, -0.5, 0]), np.float32([0.75, 0.5, 0.32])
        modalities: Any = ["rgb", "segm"]
        if generation.has_run_config:
            modalities = _classes(generation.package)["ListConfig"](modalities)
        return {
            "end_effector_type": self.end_effector,
            "n_objects": len(self.objects),
            "difficulty": "easy",
            "views": list(VIEWS),
            "modalities": modalities,
            "seed": self.seed,
            "action_bounds": {
                "low": low[: generation.num_coordinates],
                "high": high[: generation.num_coordinates],
            },
            "robot_components": [2, 3, 4],
            "obj_id_to_info": {
                number: _object_info(generation.package, *names) for number, names in self.objects.items()
            },
            "prompt": self.prompt,
            "prompt_assets": {
                name: _prompt_asset(number, kind, shown)
                for number, (name, (kind, shown)) in enumerate(self.images.items())
            },
            "steps": self.num_steps,
            "success": True,
            "failure": False,
        }


def write_folder(root: Path, episodes: dict[str, dict[str, bytes]]) -> Path:
    """Write episodes (folder such as "rotate/000001" to files) below a folder."""
    for folder, files in episodes.items():
        for name, content in files.items():
            path = root / folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)
        (root / folder).parent.joinpath("metadata.pkl").write_bytes(pickled({"n_steps_min": 1}))
    return root


def write_zip(path: Path, episodes: dict[str, dict[str, bytes]], root: str = "vima_v6/") -> Path:
    """Write episodes into one archive, with entries for folders and other things in between."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:

        def write(name: str, content: bytes = b"") -> None:
            archive.writestr(_entry(name), content)

        for folder, files in episodes.items():
            write(f"{root}{folder}/")
            for name, content in files.items():
                write(f"{root}{folder}/{name}", content)
            write(f"__MACOSX/{root}{folder}/._obs.pkl", b"x")
        for task in dict.fromkeys(folder.partition("/")[0] for folder in episodes):
            write(f"{root}{task}/metadata.pkl", pickled({"n_steps_min": 1}))
    return path


def _entry(name: str) -> zipfile.ZipInfo:
    entry = zipfile.ZipInfo(name, ZIP_TIME)
    entry.compress_type = zipfile.ZIP_DEFLATED
    return entry


def jpeg(frame: np.ndarray) -> bytes:
    """An image as Pillow writes it by default."""
    sink = io.BytesIO()
    Image.fromarray(frame).save(sink, "JPEG")
    return sink.getvalue()


def pickled(value: object, protocol: int = 4) -> bytes:
    """A pickle in which classes of this file go by the names that the published files use."""
    sink = io.BytesIO()
    with _as_modules():
        _Pickler(sink, protocol).dump(value)
    return sink.getvalue()


class _Pickler(pickle.Pickler):
    """Names the functions that restore arrays as NumPy did before version 2."""

    def __init__(self, sink: io.BytesIO, protocol: int) -> None:
        super().__init__(sink, protocol)
        self._protocol = protocol

    def reducer_override(self, value: object) -> Any:
        if type(value) is not np.ndarray:
            return NotImplemented
        made = value.__reduce_ex__(self._protocol)
        return _frombuffer if made[0].__name__ == "_frombuffer" else _reconstruct, *made[1:]


def _reconstruct(*args: object) -> None:
    raise AssertionError(args)


_reconstruct.__module__ = "numpy.core.multiarray"


def _frombuffer(*args: object) -> None:
    raise AssertionError(args)


_frombuffer.__module__ = "numpy.core.numeric"


def _object_info(package: str, name: str, texture: str) -> dict[str, Any]:
    classes = _classes(package)
    return {
        "obj_name": name,
        "obj_assets": "kitting/object-template.urdf",
        "obj_size_range": classes["SizeRange"]((0.1, 0.1, 0.02), (0.2, 0.1, 0.02)),
        "obj_from_template": True,
        "obj_replace_fn": functools.partial(classes["_kit_obj_common"], fname="a.obj"),
        "obj_pose_transform_fn": None,
        "obj_alias": None,
        "obj_novel_name": ["zone"],
        "obj_template_file": None,
        "obj_symmetry": 2 * np.pi,
        "obj_profile": classes["ProfilePedia"].UNDEFINED,
        "texture_name": texture,
        "texture_color_value": None,
        "texture_texture_asset": "/home/somebody/assets/textures/wood.png",
        "texture_alias": None,
        "texture_novel_name": None,
    }


def _prompt_asset(number: int, kind: str, shown: list[tuple[int, str, str]]) -> dict[str, Any]:
    views = VIEWS if kind == "object" else VIEWS[::-1]
    info = [{"obj_id": n, "obj_name": name, "obj_color": texture} for n, name, texture in shown]
    ground = 255 if kind == "object" else 0
    segm = np.full((128, 256), ground, np.uint8)
    segm[40:60, 40:60] = shown[0][0]
    rgb = np.full((3, 128, 256), 30 * number, np.uint8)
    rgb[:, 40:60, 40:60] = np.uint8([200, 100, 50])[:, None, None]
    return {
        "rgb": {view: rgb + np.uint8(view == "top") for view in views},
        "segm": {**dict.fromkeys(views, segm), "obj_info": info if kind == "scene" else info[0]},
        "placeholder_type": kind,
    }


@functools.cache
def _classes(package: str) -> dict[str, Any]:
    """Classes and functions under the names that the files give them."""
    module = f"{package}.tasks.components.encyclopedia"

    class SizeRange(typing.NamedTuple):
        low: tuple[float, ...]
        high: tuple[float, ...]

    class ProfilePedia(enum.Enum):
        UNDEFINED = -1
        SQUARE_LIKE = 0
        CIRCLE_LIKE = 1

        def __reduce_ex__(self, protocol: int) -> tuple[type, tuple[int]]:
            return self.__class__, (self.value,)  # as published files do; Python 3.11.2 has `getattr` there

    def _kit_obj_common(fname: str) -> None:
        raise AssertionError(fname)

    class ContainerMetadata:
        def __init__(self) -> None:
            self.object_type, self.key_type, self.ref_type = list, int, typing.Any
            self.resolver_cache = defaultdict(dict)

    class Metadata:
        def __init__(self) -> None:
            self.ref_type, self.flags = typing.Any, {}

    class AnyNode:
        def __init__(self, value: object, parent: object) -> None:
            self._metadata, self._parent, self._val = Metadata(), parent, value

    class DictConfig:
        def __init__(self, content: dict[str, object]) -> None:
            self._metadata, self._parent = ContainerMetadata(), None
            self._content = {key: AnyNode(value, self) for key, value in content.items()}

    class ListConfig:
        def __init__(self, content: list[object]) -> None:
            run = {"num_episodes_per_task": 50000, "success_only": True, "save_path": "/data", "seed": 0}
            self._metadata, self._parent = ContainerMetadata(), DictConfig(run)
            self._content = [AnyNode(value, self) for value in content]
            self._parent._content["modalities"] = self

    homes = {
        f"{module}.definitions": [SizeRange],
        f"{module}.profiles": [ProfilePedia],
        f"{module}.replace_fns": [_kit_obj_common],
        "omegaconf.base": [ContainerMetadata, Metadata],
        "omegaconf.nodes": [AnyNode],
        "omegaconf.dictconfig": [DictConfig],
        "omegaconf.listconfig": [ListConfig],
    }
    for home, members in homes.items():
        for member in members:
            member.__module__, member.__qualname__ = home, member.__name__
    return {member.__name__: member for members in homes.values() for member in members}


@contextlib.contextmanager
def _as_modules() -> Iterator[None]:
    """Let pickle find the classes where they say that they live."""
    fakes: dict[str, types.ModuleType] = {}
    for package in (PUBLISHED.package, TODAY.package):
        for member in [*_classes(package).values(), _reconstruct, _frombuffer]:
            home = member.__module__
            for end in [i for i, letter in enumerate(home) if letter == "."] + [len(home)]:
                if home[:end] != "numpy":
                    fakes.setdefault(home[:end], types.ModuleType(home[:end]))
            # Both packages share the classes of omegaconf by name; those of the first one are found.
            fakes[home].__dict__.setdefault(member.__name__, member)
    before = {name: sys.modules.get(name) for name in fakes}
    sys.modules.update(fakes)
    try:
        yield
    finally:
        for name, module in before.items():
            if module is None:
                del sys.modules[name]
            else:
                sys.modules[name] = module
