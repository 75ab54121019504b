"""What is on the table, by id."""

from collections.abc import Iterator, Mapping

from openvima.scene import Scene


class ObjectNames(Mapping[int, dict[str, str]]):
    """The names of object and texture of every placement, by its id; equal to a dictionary with the same.

    It is no dictionary because Gymnasium's vector environments take those apart and expect text as keys.

    Args:
        scene: Whose placements are listed.

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
