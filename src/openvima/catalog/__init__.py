"""Objects, textures, partitions and asset packs."""

from openvima.catalog.geometry import (
    Assets,
    CollisionBox,
    CollisionHull,
    CollisionShape,
    Geometry,
    TriangleMesh,
    Vector3,
)
from openvima.catalog.objects import OBJECTS, ObjectKind, ObjectSpec, object_spec
from openvima.catalog.packs import load_assets
from openvima.catalog.partitions import (
    LEVEL_TITLES,
    LEVELS,
    OBJECT_SETS,
    TEXTURE_SETS,
    Level,
    Pool,
    levels_of,
    pool,
    tasks_at,
)
from openvima.catalog.registration import register_object, register_texture
from openvima.catalog.textures import NEUTRAL_TEXTURE, TEXTURES, TextureSpec, texture_spec

__all__ = [
    "LEVELS",
    "LEVEL_TITLES",
    "NEUTRAL_TEXTURE",
    "OBJECTS",
    "OBJECT_SETS",
    "TEXTURES",
    "TEXTURE_SETS",
    "Assets",
    "CollisionBox",
    "CollisionHull",
    "CollisionShape",
    "Geometry",
    "Level",
    "ObjectKind",
    "ObjectSpec",
    "Pool",
    "TextureSpec",
    "TriangleMesh",
    "Vector3",
    "levels_of",
    "load_assets",
    "object_spec",
    "pool",
    "register_object",
    "register_texture",
    "tasks_at",
    "texture_spec",
]
