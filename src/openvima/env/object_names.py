"""Names of the objects on the table, by id."""

from collections.abc import Iterator, Mapping

from openvima.scene import Scene


class ObjectNames(Mapping[int, dict[str, str]]):
    """Maps the id of every placement to the names of its object and texture.

    Not a dictionary: Gymnasium's vector environments split those and require string keys.

    Args:
        scene: The scene.

    Example:
        >>> info["objects"][5]  # doctest: +SKIP
        {'object': 'letter A', 'texture': 'red swirl'}
    """

    __slots__ = ("_names",)

    def __init__(self, scene: Scene) -> None:
        self._names = {p.id: {"object": p.object, "texture": p.texture} for p in scene.placements}

    def __getitem__(self, object_id: int) -> dict[str, str]:
        return self._names[object_id]

    def __iter__(self) -> Iterator[int]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)

    def __repr__(self) -> str:
        return repr(self._names)
