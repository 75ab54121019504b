"""The published data set as a sequence of demonstrations, from its archive or from unpacked folders."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from openvima.data.published.episode import demonstration_of
from openvima.data.published.folders import EpisodeFolders
from openvima.data.published.names import split_of, todays_task
from openvima.data.published.zip_archive import ZipArchive
from openvima.data.records import Demonstration
from openvima.errors import ConfigError, DatasetError, MemberError, unknown_name
from openvima.input_files import as_path, names_of
from openvima.tasks import task_spec

SPLITS = ("all", "train", "validation")


class EpisodeKey(NamedTuple):
    """Names one episode.

    Args:
        task: Today's name of the task.
        id: Name of the episode's folder, such as "000123".
    """

    task: str
    id: str


@dataclass(frozen=True, slots=True)
class Broken:
    """An episode, or a folder of them, that cannot be read.

    Args:
        member: Its folder, such as "rotate/000123".
        reason: Why.
    """

    member: str
    reason: str


@dataclass(frozen=True, slots=True)
class EpisodePlace:
    """Where an episode lies.

    Args:
        key: Its name.
        folder: Its folder below that of all tasks, such as "same_profile/000123".
        place: For the archive or folder that holds it.
    """

    key: EpisodeKey
    folder: str
    place: Any  # Any: a zip archive has places of another form than folders


class Source(Protocol):
    """An archive, or folders."""

    path: Path

    def digest(self) -> str:
        """Return 32 hexadecimal digits that stand for the content."""
        ...

    def episodes(self) -> Mapping[str, Any]:  # Any: see `EpisodePlace.place`
        """Return the folders of all episodes, and their places."""
        ...

    def files(self, place: Any) -> Mapping[str, bytes]:  # Any: see `EpisodePlace.place`
        """Return the files of an episode."""
        ...


class PublishedData(Sequence[Demonstration]):
    """The data set that the benchmark's authors published, or one that their generator wrote.

    It is read where it is: nothing is unpacked, and nothing in a file is ever run. Both generations are read,
    also side by side: old and new names of tasks and packages, positions with and without height. Objects can
    be sent to other processes: they open files anew.

    Args:
        path: The zip archive, or a folder with unpacked episodes `…/TASK/ID/`.
        tasks: Keep the episodes of these tasks only; None keeps all.
        split: "all", or one of two splits: "train" (twelve thirteenths, by a hash of task and id) or
            "validation".

    Raises:
        DatasetError: There are no episodes, the archive is damaged, or it lacks a task.
        ConfigError: There is no such split.

    Example:
        >>> data = PublishedData("vima.zip")
        >>> data.keys[0]
        EpisodeKey(task='follow_order', id='000000')
        >>> data.read("follow_order", "000000").prompt.text
        'Stack objects in this order {frame_0} {frame_1} {frame_2}.'
    """

    def __init__(
        self, path: str | Path, *, tasks: str | Sequence[str] | None = None, split: str = "all"
    ) -> None:
        if split not in SPLITS:
            raise ConfigError(unknown_name("split", split, SPLITS))
        self.path = as_path(path)
        self.tasks = None if tasks is None else names_of(tasks)
        self.split = split
        self._source = open_source(self.path)
        places, self.broken_folders = _sorted_places(self._source)
        if self.tasks is not None:
            places = _of_tasks(places, self.tasks, self.path)
        self.places = tuple(place for place in places if split in ("all", split_of(*place.key)))
        if not self.places:
            raise DatasetError(
                f"{self.path} holds no episodes; give vima.zip, or the folder it was unpacked to."
            )
        self._index_of: dict[EpisodeKey, int] = {}

    @property
    def keys(self) -> tuple[EpisodeKey, ...]:
        """Task and id of all episodes, sorted."""
        return tuple(place.key for place in self.places)

    def digest(self) -> str:
        """Return 32 hexadecimal digits that stand for the archive, or for the episodes' names in folders."""
        return self._source.digest()

    def __len__(self) -> int:
        return len(self.places)

    def __getitem__(self, index: int) -> Demonstration:  # type: ignore[override]  # no slices
        return self._read(self.places[index])

    def read(self, task: str, episode_id: str) -> Demonstration:
        """Read one episode.

        Args:
            task: Old or new name of the task.
            episode_id: Name of its folder, such as "000123".

        Raises:
            DatasetError: There is no such episode.
            MemberError: It is broken; the message names archive, file and reason.
        """
        if not self._index_of:
            self._index_of = {place.key: index for index, place in enumerate(self.places)}
        key = EpisodeKey(todays_task(task) or task, episode_id)
        if key not in self._index_of:
            raise DatasetError(
                f"{self.path} has no episode {task}/{episode_id}; its ids have gaps, see `keys`."
            )
        return self._read(self.places[self._index_of[key]])

    def demonstrations(
        self, task: str | None = None, on_broken: Callable[[Broken], None] | None = None
    ) -> Iterator[Demonstration]:
        """Read all episodes that are whole.

        Args:
            task: Those of this task only; old or new name.
            on_broken: Called with each one that is not.
        """
        wanted = None if task is None else todays_task(task) or task
        for place in self.places:
            if wanted not in (None, place.key.task):
                continue
            found = read_place(self._source, place)
            if isinstance(found, Demonstration):
                yield found
            elif on_broken is not None:
                on_broken(found)

    def __reduce__(self) -> tuple[Any, ...]:  # Any: what pickle takes
        return _reopened, (self.path, self.tasks, self.split)

    def _read(self, place: EpisodePlace) -> Demonstration:
        found = read_place(self._source, place)
        if isinstance(found, Broken):
            raise MemberError(f"{self.path}: {found.member}: {found.reason}")
        return found


def open_source(path: Path) -> Source:
    """Open a zip archive or a folder.

    Raises:
        DatasetError: It is neither.
    """
    if path.is_dir():
        return EpisodeFolders(path)
    if not path.is_file():
        raise DatasetError(
            f"there is no file or folder {path}; give vima.zip, or the folder it was unpacked to."
        )
    return ZipArchive(path)


def read_place(source: Source, place: EpisodePlace) -> Demonstration | Broken:
    """Read one episode, or say what is wrong with it."""
    try:
        return demonstration_of(source.files(place.place), task=place.key.task, folder=place.folder)
    except MemberError as error:
        return Broken(place.folder, str(error))


def _reopened(path: Path, tasks: tuple[str, ...] | None, split: str) -> PublishedData:
    return PublishedData(path, tasks=tasks, split=split)


def _sorted_places(source: Source) -> tuple[list[EpisodePlace], tuple[Broken, ...]]:
    """All episodes of known tasks by task and id, and the folders of others."""
    places: dict[EpisodeKey, tuple[str, EpisodePlace]] = {}
    todays: dict[str, str | None] = {}
    for path, place in source.episodes().items():
        parent, _, episode_id = path.rpartition("/")
        if parent not in todays:
            todays[parent] = todays_task(parent.rpartition("/")[2])
        task = todays[parent]
        if task is None:
            continue
        key = EpisodeKey(task, episode_id)
        if key in places:
            raise DatasetError(f"{source.path} holds {task} {episode_id} twice: {places[key][0]} and {path}.")
        folder = f"{parent.rpartition('/')[2]}/{episode_id}"
        places[key] = path, EpisodePlace(key, folder, place)
    strange = sorted(parent for parent, task in todays.items() if task is None)
    unknown = "there is no task of that name, so its episodes are left out."
    return [places[key][1] for key in sorted(places)], tuple(Broken(parent, unknown) for parent in strange)


def _of_tasks(places: Sequence[EpisodePlace], tasks: Sequence[str], path: Path) -> list[EpisodePlace]:
    present = {place.key.task for place in places}
    wanted = set()
    for task in tasks:
        name = todays_task(task) or task_spec(task).name
        if name not in present:
            raise DatasetError(
                f"{path} has no episodes of {name}; it has {', '.join(sorted(present)) or 'none'}."
            )
        wanted.add(name)
    return [place for place in places if place.key.task in wanted]
